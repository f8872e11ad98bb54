"""Numerically stable feature statistics, and the normalisation by them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from torchrl_gn.maths.float64_buffers import Float64Buffers


class Normalizer(Float64Buffers):
    """Scale features to zero mean and unit variance (paper, SM "Data normalization").

    Keeps a float64 count, mean and sum of squared deviations per feature, shared by all nodes or edges, and updates
    them by Chan's parallel formula. (The paper's sum and sum of squares cancel when the mean is large against the
    standard deviation.) A constant feature maps to exactly 0, and back to its mean.

    Args:
        size: number of features ``F``.
        floor: a feature is constant if its standard deviation is at most this, or at most 1e-7 of its absolute mean.
        limit: normalised features are clamped to ``[-limit, limit]``.
        least: lower bounds ``[F]`` on the standard deviations of features that are not constant, for features that
            hardly vary in data but do in a model's own predictions. Default: 0.
    """

    count: Tensor
    mean: Tensor
    m2: Tensor
    std: Tensor
    inverse_std: Tensor

    def __init__(
        self, size: int, *, floor: float = 0.0, limit: float = math.inf, least: Sequence[float] | None = None
    ) -> None:
        super().__init__()
        if not 0 <= floor < math.inf:
            raise ValueError(f"floor={floor} must be a finite standard deviation, 0 or above.")
        if not limit > 0:
            raise ValueError(f"limit={limit} must be above 0.")
        self.size, self.floor, self.limit = size, floor, limit
        for name in ("count", "mean", "m2", "std", "inverse_std"):
            derived = name.endswith("std")
            self.register_buffer(name, torch.zeros(size, dtype=torch.float64), persistent=not derived)
        # Not a buffer: only a checkpoint fills buffers after ``to_empty``, and it does not hold these.
        self.least = (0.0,) * size if least is None else tuple(least)
        if len(self.least) != size:
            raise ValueError(f"least must have {size} numbers, one a feature, not {len(self.least)}.")
        self.register_load_state_dict_post_hook(Normalizer._refresh)

    @property
    def fitted(self) -> bool:
        """True if it has seen data or has no features; waits for the device, so do not read it every step."""
        return self.size == 0 or bool((self.count > 0).any())

    @property
    def constant(self) -> Tensor:
        """``[F]`` bool, True for constant features."""
        return self.std == 0

    @torch.no_grad()
    def reset(self) -> None:
        """Forget all data."""
        for buffer in (self.count, self.mean, self.m2):
            buffer.zero_()
        self._refresh()

    @torch.no_grad()
    def update(self, features: Tensor, mask: Tensor | None = None) -> None:
        """Add a batch ``[..., F]`` where the bool ``mask`` is True.

        Raises:
            ValueError: on a wrong size, NaN or Inf there, or numbers so large that their squares overflow.
        """
        if features.shape[-1] != self.size:
            raise ValueError(f"Normalizer of {self.size} features got {features.shape[-1]} in {tuple(features.shape)}.")
        if features.shape[:-1].numel() == 0 or self.size == 0:
            return
        flat = features.to(torch.float64)
        weight = torch.ones_like(flat) if mask is None else mask.to(torch.float64).expand_as(flat)
        flat, weight = flat.reshape(-1, self.size), weight.reshape(-1, self.size)
        flat = torch.where(weight > 0, flat, torch.zeros_like(flat))
        if not torch.isfinite(flat).all():
            bad = (~torch.isfinite(flat)).any(0).nonzero().flatten().tolist()
            raise ValueError(f"Normalizer got NaN or Inf in features {bad}.")
        count = weight.sum(0)
        mean = flat.sum(0) / count.clamp(min=1)
        m2 = (weight * (flat - mean)).square().sum(0)
        if not torch.isfinite(m2).all():
            bad = (~torch.isfinite(m2)).nonzero().flatten().tolist()
            raise ValueError(
                f"Normalizer got numbers up to {float(flat.abs().max()):.0e} in features {bad}: too large."
            )
        self._combine(count, mean, m2)

    @torch.no_grad()
    def merge(self, other: Normalizer) -> None:
        """Add the statistics of another normaliser."""
        if other.size != self.size:
            raise ValueError(f"Cannot merge a normaliser of {other.size} features into one of {self.size}.")
        self._combine(*(getattr(other, name).to(self.mean.device) for name in ("count", "mean", "m2")))

    def _combine(self, count: Tensor, mean: Tensor, m2: Tensor) -> None:
        # Chan, Golub and LeVeque: weighting the shift of means by counts avoids differences of large sums.
        total = self.count + count
        share = count / total.clamp(min=1)
        shift = mean - self.mean
        self.mean += shift * share
        self.m2 += m2 + shift.square() * self.count * share
        self.count.copy_(total)
        self._refresh()

    @torch.no_grad()
    def _refresh(self, *_) -> None:
        std = (self.m2 / self.count.clamp(min=1)).sqrt()
        # The inverse of a smaller one is infinite in single precision.
        floor = max(self.floor, torch.finfo(torch.float32).tiny)
        constant = (std <= floor) | (std <= 1e-7 * self.mean.abs())
        if any(self.least):
            std = torch.maximum(std, torch.tensor(self.least, dtype=std.dtype, device=std.device))
        # In place: TorchRL's losses keep references to a module's buffers.
        self.std.copy_(torch.where(constant, 0.0, std))
        self.inverse_std.copy_(torch.where(constant, 0.0, 1 / torch.where(constant, 1.0, std)))

    def forward(self, features: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """Normalise ``[..., F]`` in the features' dtype, then cast the result to ``dtype`` if given."""
        normalized = (features - self.mean.to(features.dtype)) * self.inverse_std.to(features.dtype)
        if self.limit < math.inf:
            normalized = normalized.clamp(-self.limit, self.limit)
        return normalized if dtype is None else normalized.to(dtype)

    def inverse(self, normalized: Tensor) -> Tensor:
        """Invert :meth:`forward`, except for the clamping: ``[..., F]`` to ``[..., F]`` in the input's dtype."""
        return normalized * self.std.to(normalized.dtype) + self.mean.to(normalized.dtype)

    def extra_repr(self) -> str:
        return f"{self.size}, floor={self.floor}"


@contextmanager
def unchanged_on_error(*modules: nn.Module) -> Iterator[None]:
    """Restore the statistics of all normalisers in modules, and the modules' own buffers, if the block raises.

    Data that one of several normalisers refuses then leave no trace in the others.
    """
    parts = {part for module in modules for part in module.modules() if isinstance(part, Normalizer)}
    buffers = [buffer for part in {*parts, *modules} for buffer in part.buffers(recurse=False)]
    before = [buffer.clone() for buffer in buffers]
    try:
        yield
    except BaseException:
        with torch.no_grad():
            for buffer, value in zip(buffers, before, strict=True):
                buffer.copy_(value)
        raise
