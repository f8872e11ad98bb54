"""Updates of a model on a GPU as CUDA graphs: loss, gradient, clipping and optimisers in one launch."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.objectives.checks import COLLECTED
from torchrl_gn.scenes.checked_trajectories import ENDS
from torchrl_gn.training.optimizers import ScheduledOptimizer


class RecordedUpdates:
    """Updates of one loss and optimiser, recorded at the third batch of each shape; torch runs the first two.

    The loss must have one scene and a feed-forward model, no noise and no parameters per sample.
    """

    def __init__(self, loss: ForwardModelLoss, optimizer: ScheduledOptimizer) -> None:
        self.loss, self.optimizer = loss, optimizer
        self._seen: dict[tuple, int] = {}
        self._recorded: dict[tuple, _Recorded] = {}

    @classmethod
    def of(cls, loss: nn.Module, optimizer: ScheduledOptimizer, device: torch.device) -> RecordedUpdates | None:
        """Make recorded updates of a loss and optimiser; None if they cannot be recorded on the device."""
        if device.type != "cuda" or not isinstance(loss, ForwardModelLoss) or loss.noise or loss.residual_weight:
            return None
        if loss.model.parameters_key is not None or loss.model.recurrent or loss.trained.physics is not None:
            return None
        if not all(parameter.device == device for parameter in optimizer.parameters):
            return None
        return cls(loss, optimizer) if optimizer.make_recordable() else None

    def __call__(self, batch: TensorDictBase, step: int, fraction: float) -> float | None:
        """Update on a batch and return the loss; None, and no change, if torch must run this update.

        Raises:
            FloatingPointError: the loss or the gradient is not finite; nothing changes.
        """
        entries = [batch.get(key) for key in self.loss.in_keys[:3]]
        key = tuple((entry.shape, entry.dtype) for entry in entries)
        others = (*(("next", end) for end in ENDS), self.loss.tensor_keys.priority_weight, *COLLECTED)
        if any(other in batch.keys(True) for other in others):
            return None
        if (seen := self._seen.get(key, 0)) < 2:
            self._seen[key] = seen + 1
            return None
        if (recorded := self._recorded.get(key)) is None:
            recorded = self._recorded[key] = _Recorded(self.loss, self.optimizer, batch)
        self.optimizer.set_rates(step, fraction)
        return recorded(entries, step)


class _Recorded:
    """Recorded update on batches of one shape."""

    def __init__(self, loss: ForwardModelLoss, optimizer: ScheduledOptimizer, batch: TensorDictBase) -> None:
        self._batch = batch.select(*loss.in_keys[:3]).clone()
        self._inputs = [self._batch.get(key) for key in loss.in_keys[:3]]

        def update() -> Tensor:
            value = loss.unchecked(self._batch)["loss_forward_model"]
            value.backward()
            norm = clip_on_device(optimizer.parameters, optimizer.max_norm)
            for each in optimizer.optimizers:
                each.step()
            return torch.stack((value.detach().double(), norm))

        optimizer.zero_grad()
        self._graph = UpdateGraph(update, optimizer.parameters, optimizer.optimizers)

    def __call__(self, entries: list[Tensor], step: int) -> float:
        for static, entry in zip(self._inputs, entries, strict=True):
            static.copy_(entry)
        value, norm = self._graph()
        if not (math.isfinite(value) and math.isfinite(norm)):
            self._graph.undo()
            what = f"The loss is {value}" if not math.isfinite(value) else "The gradient is not finite"
            raise FloatingPointError(f"{what} at step {step}; lower the learning rate.")
        return value


class UpdateGraph:
    """An update recorded as a CUDA graph, which can be undone.

    Args:
        update: computes loss and gradient, steps the optimisers, and returns numbers ``[K]`` without waiting for the
            GPU. It is recorded, not run.
        parameters: all parameters that it changes.
        optimizers: the optimisers whose state it changes; they must have stepped before.
    """

    def __init__(
        self, update: Callable[[], Tensor], parameters: Sequence[Tensor], optimizers: Sequence[torch.optim.Optimizer]
    ) -> None:
        states = (value for tensor in optimizers for state in tensor.state.values() for value in state.values())
        self._changed = [tensor.data for tensor in parameters] + [
            tensor for tensor in states if isinstance(tensor, Tensor)
        ]
        self._before = [torch.empty_like(tensor) for tensor in self._changed]
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            torch._foreach_copy_(self._before, self._changed)  # pyright: ignore
            self._numbers = update()

    @classmethod
    def or_none(
        cls, update: Callable[[], Tensor], parameters: Sequence[Tensor], optimizers: Sequence[torch.optim.Optimizer]
    ) -> UpdateGraph | None:
        """Record an update; None, with a warning, if it cannot be recorded and must run without a graph."""
        stream = torch.cuda.current_stream()
        try:
            return cls(update, parameters, optimizers)
        except RuntimeError as error:
            # A failed recording leaves its stream current and the random generator waiting for its end.
            torch.cuda.set_stream(stream)
            generator = torch.cuda.default_generators[stream.device_index]
            fresh = torch.Generator(stream.device).manual_seed(generator.initial_seed() + 1)
            generator.graphsafe_set_state(fresh.graphsafe_get_state())
            reason = (str(error.__context__ or error).splitlines() or [""])[0]  # ending the recording fails too
            warnings.warn(f"Updates run without a CUDA graph, more slowly: {reason}", stacklevel=2)
            return None

    def __call__(self) -> list[float]:
        """Run the update and return its numbers; the host waits for the GPU once."""
        self._graph.replay()
        return self._numbers.tolist()

    @torch.no_grad()
    def undo(self) -> None:
        """Undo the last update."""
        torch._foreach_copy_(self._changed, self._before)  # pyright: ignore


def clip_on_device(parameters: Iterable[Tensor], max_norm: float) -> Tensor:
    """Clip the joint gradient without waiting for the device; return its norm before, ``[]`` float64, finite or not."""
    gradients = [each.grad for each in parameters if each.grad is not None]
    # In float64: squares overflow float32 from 1.8e19 on.
    norm = torch.linalg.vector_norm(torch.cat([each.flatten() for each in gradients]), dtype=torch.float64)
    if max_norm < math.inf:
        factor = (max_norm / (norm + 1e-6)).clamp(max=1.0)
        torch._foreach_mul_(gradients, factor.to(gradients[0].dtype))  # pyright: ignore
    return norm
