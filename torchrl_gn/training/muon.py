"""Muon: momentum with orthogonalised matrix updates, in float32."""

from __future__ import annotations

import contextlib
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.native import NoCompilerError, load_operators
from torchrl_gn.processor import native_threads

# Odd quintics (linear, cubic, quintic), each optimal after the one before for singular values in [0.002, 1] (N. Amsel
# et al., "The Polar Express", 2025). Four of them reach [0.68, 1.32], like five of Muon's usual equal ones.
_POLYNOMIALS = (
    (8.4268, -24.9361, 18.4925),
    (4.1116, -3.0591, 0.57495),
    (3.7146, -2.7781, 0.54292),
    (2.78195, -2.07493, 0.4635),
)


class Muon(torch.optim.Optimizer):
    """Muon for weight matrices (K. Jordan, "Muon: an optimizer for hidden layers", 2024).

    The update is the nearest semi-orthogonal matrix to the Nesterov momentum, times ``lr * sqrt(max(1, rows /
    columns))``. It equals the update of ``torch.optim.Muon`` without weight decay, but in the parameter's float32 or
    float64 (float32 for 16-bit ones) instead of bfloat16. On a CPU with a compiler, updates run in C++ on the threads
    of torch, one thread per matrix.

    Args:
        params: matrices, or parameter groups of them.
    """

    def __init__(self, params: Iterable[Any], lr: float = 1e-2, *, momentum: float = 0.95) -> None:
        if not 0 <= lr < math.inf:
            raise ValueError(f"lr={lr} must be finite and not negative.")
        if not 0 <= momentum < 1:
            raise ValueError(f"momentum={momentum} must be from 0 to below 1.")
        super().__init__(params, {"lr": lr, "momentum": momentum})
        for parameter in (parameter for group in self.param_groups for parameter in group["params"]):
            if parameter.ndim != 2:
                raise ValueError(f"Muon trains matrices, not a parameter of shape {list(parameter.shape)}.")

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # pyright: ignore
        """Update the matrices that have gradients; ``closure`` recomputes the loss, as in ``torch.optim``."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            if not parameters:
                continue
            for parameter in parameters:
                if not self.state[parameter]:
                    self.state[parameter]["momentum_buffer"] = torch.zeros_like(parameter)
            moments = [self.state[parameter]["momentum_buffer"] for parameter in parameters]
            by_torch = list(range(len(parameters)))
            if any(parameter.is_cpu for parameter in parameters):
                with contextlib.suppress(NoCompilerError):
                    by_torch = self._update_natively(parameters, moments, group)
            if by_torch:
                self._update([parameters[i] for i in by_torch], [moments[i] for i in by_torch], group)
        return loss

    def _update_natively(
        self, parameters: Sequence[Tensor], moments: Sequence[Tensor], group: dict[str, Any]
    ) -> list[int]:
        """Update matrices in C++, at half the cost of symmetric products; return indices of those left to torch."""
        operators, polynomials = load_operators(), [number for each in _POLYNOMIALS for number in each]
        remaining, kinds = [], {dtype: [] for dtype in (torch.float32, torch.float64)}
        for index, parameter in enumerate(parameters):
            tensors = (parameter, parameter.grad, moments[index])
            plain = parameter.dtype in kinds and all(_is_plain(each, parameter) for each in tensors)
            (kinds[parameter.dtype] if plain else remaining).append(index)
        for indices in filter(None, kinds.values()):
            changed = [parameters[index] for index in indices]
            gradients, means = [each.grad for each in changed], [moments[index] for index in indices]
            operators.muon_(changed, gradients, means, group["momentum"], group["lr"], polynomials, native_threads())
        return remaining

    def _update(self, parameters: Sequence[Tensor], moments: Sequence[Tensor], group: dict[str, Any]) -> None:
        """Update matrices by torch operations."""
        gradients = [parameter.grad for parameter in parameters]
        torch._foreach_lerp_(moments, gradients, 1 - group["momentum"])  # pyright: ignore
        nesterov = torch._foreach_lerp(gradients, moments, group["momentum"])  # pyright: ignore
        for parameter, update in zip(parameters, _orthogonalize_all(nesterov), strict=True):
            rows, columns = parameter.shape
            rate = group["lr"] * math.sqrt(max(1, rows / columns))
            if isinstance(rate, Tensor):  # a CUDA graph reads it anew each time
                parameter.sub_(update * rate.to(update.dtype))
            else:
                parameter.sub_(update, alpha=rate)


def _is_plain(tensor: Tensor | None, like: Tensor) -> bool:
    """Return True if a tensor is contiguous, non-empty, on the CPU, and of the shape and dtype of ``like``."""
    return (
        tensor is not None
        and tensor.shape == like.shape
        and tensor.dtype == like.dtype
        and tensor.is_cpu
        and tensor.layout == torch.strided
        and tensor.is_contiguous()
        and tensor.numel() > 0
    )


def orthogonalize(matrices: Tensor) -> Tensor:
    """Map the singular values of matrices ``[K, m, n]`` to about 1 (0.7 to 1.3); zero matrices stay zero."""
    if matrices.shape[-2] > matrices.shape[-1]:
        return orthogonalize(matrices.mT).mT
    out = matrices / torch.linalg.matrix_norm(matrices, keepdim=True).clamp(min=1e-7)
    rows, columns = out.shape[-2:]
    if columns < 1.5 * rows:
        for linear, cubic, quintic in _POLYNOMIALS:
            gram = out @ out.mT
            higher = torch.baddbmm(gram, gram, gram, beta=cubic, alpha=quintic)
            out = torch.baddbmm(out, higher, out, beta=linear)
        return out
    # Wide matrices: iterate on the smaller Gram matrix, and apply the product of all polynomials once.
    gram, factor = out @ out.mT, None
    for iteration, (linear, cubic, quintic) in enumerate(_POLYNOMIALS):
        higher = torch.baddbmm(gram, gram, gram, beta=cubic, alpha=quintic)
        if iteration + 1 < len(_POLYNOMIALS):
            half = torch.baddbmm(gram, higher, gram, beta=linear)
            gram = torch.baddbmm(half, half, higher, beta=linear)
        if factor is None:
            factor = higher
            factor.diagonal(dim1=-2, dim2=-1).add_(linear)
        else:
            factor = torch.baddbmm(factor, higher, factor, beta=linear)
    return out if factor is None else factor @ out


def _orthogonalize_all(matrices: Sequence[Tensor]) -> list[Tensor]:
    """Orthogonalise matrices ``[m, n]``, batched by shape, dtype and device."""
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, matrix in enumerate(matrices):
        groups[tuple(matrix.shape), matrix.dtype, matrix.device].append(index)
    out = list(matrices)
    for indices in groups.values():
        batch = torch.stack([matrices[index] for index in indices])
        exact = batch.dtype if batch.dtype in (torch.float32, torch.float64) else torch.float32
        for index, update in zip(indices, orthogonalize(batch.to(exact)).to(batch.dtype), strict=True):
            out[index] = update
    return out
