"""Updates of a model on a GPU as CUDA graphs: loss, gradient, clipping and optimisers in one launch."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.training.optimizers import ScheduledOptimizer


class RecordedUpdates:
    """Run updates of one loss and optimiser, each shape of batch recorded at its third; the first two are torch's.

    Of losses of one scene without noise, without parameters of samples and of a feed-forward model.
    """

    def __init__(self, loss: ForwardModelLoss, optimizer: ScheduledOptimizer) -> None:
        self.loss, self.optimizer = loss, optimizer
        self._seen: dict[tuple, int] = {}
        self._recorded: dict[tuple, _Recorded] = {}

    @classmethod
    def of(cls, loss: nn.Module, optimizer: ScheduledOptimizer, device: torch.device) -> RecordedUpdates | None:
        """Updates of a loss and optimiser that can be recorded on a device; None of others."""
        if device.type != "cuda" or not isinstance(loss, ForwardModelLoss) or loss.noise or loss.residual_weight:
            return None
        if loss.model.parameters_key is not None or loss.model.recurrent or loss.trained.physics is not None:
            return None
        if not all(parameter.device == device for parameter in optimizer.parameters):
            return None
        return cls(loss, optimizer) if optimizer.make_recordable() else None

    def __call__(self, batch: TensorDictBase, step: int, fraction: float) -> float | None:
        """Update on a batch and return the loss; None, and no change, while this shape is to be torch's.

        FloatingPointError, and no change, if the loss or the gradient is not finite.
        """
        entries = [batch.get(key) for key in self.loss.in_keys[:3]]
        key = tuple((entry.shape, entry.dtype) for entry in entries)
        if ("next", "done") in batch.keys(True):
            return None
        if (seen := self._seen.get(key, 0)) < 2:
            self._seen[key] = seen + 1
            return None
        if (recorded := self._recorded.get(key)) is None:
            recorded = self._recorded[key] = _Recorded(self.loss, self.optimizer, batch)
        self.optimizer.set_rates(step, fraction)
        return recorded(entries, step)


class _Recorded:
    """Update on batches of one shape."""

    def __init__(self, loss: ForwardModelLoss, optimizer: ScheduledOptimizer, batch: TensorDictBase) -> None:
        self._batch = batch.select(*loss.in_keys[:3]).clone()
        self._inputs = [self._batch.get(key) for key in loss.in_keys[:3]]
        self._changed = _trained_tensors(optimizer)
        self._before = [torch.empty_like(each) for each in self._changed]
        self._graph = torch.cuda.CUDAGraph()
        optimizer.zero_grad()
        with torch.cuda.graph(self._graph):
            torch._foreach_copy_(self._before, self._changed)  # pyright: ignore
            value = loss.unchecked(self._batch)["loss_forward_model"]
            value.backward()
            gradients = [each.grad for each in optimizer.parameters if each.grad is not None]
            norm = nn.utils.get_total_norm(gradients)
            if optimizer.max_norm < math.inf:
                torch._foreach_mul_(gradients, (optimizer.max_norm / (norm + 1e-6)).clamp(max=1.0))  # pyright: ignore
            for each in optimizer.optimizers:
                each.step()
            self._result = torch.stack((value.detach().double(), norm.double()))

    def __call__(self, entries: list[Tensor], step: int) -> float:
        for static, given in zip(self._inputs, entries, strict=True):
            static.copy_(given)
        self._graph.replay()
        value, norm = self._result.tolist()
        if not (math.isfinite(value) and math.isfinite(norm)):
            with torch.no_grad():
                torch._foreach_copy_(self._changed, self._before)  # pyright: ignore
            what = f"The loss is {value}" if not math.isfinite(value) else "The gradient is not finite"
            raise FloatingPointError(f"{what} at step {step}; lower the learning rate.")
        return value


def _trained_tensors(optimizer: ScheduledOptimizer) -> list[Tensor]:
    """All tensors that an update changes."""
    moments = [
        value
        for each in optimizer.optimizers
        for state in each.state.values()
        for value in state.values()
        if isinstance(value, Tensor)
    ]
    return [*(parameter.data for parameter in optimizer.parameters), *moments]
