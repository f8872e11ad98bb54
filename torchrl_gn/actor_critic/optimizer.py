"""Optimiser of the short-horizon actor-critic."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from torchrl_gn.objectives import SHACLoss
from torchrl_gn.training.gradients import with_gradients
from torchrl_gn.training.nested_state import require_like
from torchrl_gn.training.optimizers import clip_gradients, load_optimizer
from torchrl_gn.training.recorded_update import UpdateGraph, clip_on_device

_BETAS = (0.7, 0.95)  # SHAC's: gradients change fast with the policy
_MAX_NORM = 1.0
_REPORTED = {"reward": "imagined_reward", "loss_value": "loss_value", "entropy": "entropy"}


class ActorCriticOptimizer:
    """Update policy, values and entropy weights by Adam, each with its own learning rate and clipped gradients.

    The policy climbs the values, so the values must keep up: they take further steps on the same imagined data. On an
    NVIDIA GPU the third update is recorded as a CUDA graph, and all later updates replay it.

    Args:
        losses: one loss per task; their policies share weights.
        policy_lr, value_lr, alpha_lr: learning rates of the policy, of the values, and of the entropy weights.
        value_steps: extra value steps per update, each on a random half of the imagined steps.
    """

    def __init__(
        self, losses: Sequence[SHACLoss], *, policy_lr: float, value_lr: float, alpha_lr: float, value_steps: int
    ) -> None:
        self.losses, self.value_steps = list(losses), value_steps
        self.policy = list(self.losses[0].policy.parameters())
        self.values = [list(loss.value.parameters()) for loss in self.losses]
        self.alphas = [loss.log_alpha for loss in self.losses]
        groups = (
            (self.policy, policy_lr),
            ([parameter for group in self.values for parameter in group], value_lr),
            (self.alphas, alpha_lr),
        )
        self.optimizer = torch.optim.Adam(
            [{"params": group, "lr": lr} for group, lr in groups], betas=_BETAS, fused=True
        )
        self.clipped = [self.policy, *self.values, *([alpha] for alpha in self.alphas)]
        self._by_torch, self._graph = 2 if self.alphas[0].is_cuda else math.inf, None  # updates before the recording
        self._states: list[TensorDict] = []

    def learn(
        self, starts: Sequence[Callable[[int], TensorDict]], *, updates: int, batch_size: int, desc: str
    ) -> dict[str, float]:
        """Run ``updates`` updates and return the means of their last quarter.

        Args:
            starts: one function per task that draws start states of imagination: ``state`` ``[batch_size, N, 13]`` and,
                in tasks with a target, ``target`` ``[batch_size, 3]``.
            updates: number of updates.
            batch_size: start states of a task in an update.
            desc: label of the progress bar.

        Returns:
            ``imagined_reward`` per control step, ``loss_value`` and ``entropy``.

        Raises:
            FloatingPointError: a gradient is not finite; that step changes nothing.
        """
        history: dict[str, list[Tensor]] = {name: [] for name in _REPORTED}
        with tqdm(total=updates, desc=desc, unit=" updates", leave=False) as bar:
            for update in range(updates):
                numbers = self._update([partial(draw, batch_size) for draw in starts], f"update {update}")
                if update >= 3 * updates // 4:
                    for name, values in history.items():
                        values += [of_loss[name] for of_loss in numbers]
                bar.update()
        return {_REPORTED[name]: float(torch.stack(values).mean()) for name, values in history.items()}

    @with_gradients
    def _update(self, draws: Sequence[Callable[[], TensorDict]], when: str) -> list[dict[str, Tensor]]:
        """Update once from newly drawn states; return the numbers of each loss. See :meth:`learn` for errors."""
        if self._graph is None and self._by_torch < 1:
            self._record([draw() for draw in draws])
        if self._graph is None:
            self._by_torch -= 1
            return self._gradient_steps(
                [draw() for draw in draws], lambda group: clip_gradients(group, _MAX_NORM, when)
            )
        for static, draw in zip(self._states, draws, strict=True):
            static.copy_(draw())
        numbers = self._graph()
        count = len(self.losses) * len(_REPORTED)
        loss_numbers, norms = iter(torch.tensor(numbers[:count])), numbers[count:]
        if not all(map(math.isfinite, norms)):
            self._graph.undo()
            raise FloatingPointError(f"The gradient is not finite at {when}; lower the learning rate.")
        return [{name: next(loss_numbers) for name in _REPORTED} for _ in self.losses]

    def _gradient_steps(
        self, states: Sequence[TensorDict], clip: Callable[[Sequence[Tensor]], object]
    ) -> list[dict[str, Tensor]]:
        """Update once from states ``[B]`` for each loss, clipping gradients by ``clip``; return each loss's numbers."""
        self.optimizer.zero_grad()
        outputs = [loss(start) for loss, start in zip(self.losses, states, strict=True)]
        for output in outputs:
            (output["loss_actor"] / len(self.losses) + output["loss_value"] + output["loss_alpha"]).backward()
        self._step(self.clipped, clip)
        imagined = [output["imagined"].flatten() for output in outputs]
        for _ in range(self.value_steps):
            self.optimizer.zero_grad()  # the policy has no gradient now and stays as it is
            for loss, steps in zip(self.losses, imagined, strict=True):
                rows = torch.randint(len(steps), (-(-len(steps) // 2),), device=loss.log_alpha.device)
                loss.value_loss(steps[rows]).backward()
            self._step(self.values, clip)
        return [{name: output[name].detach() for name in _REPORTED} for output in outputs]

    def _step(self, groups: Sequence[Sequence[Tensor]], clip: Callable[[Sequence[Tensor]], object]) -> None:
        for group in groups:
            clip(group)
        self.optimizer.step()

    def _record(self, states: list[TensorDict]) -> None:
        """Record the update on states of these shapes as a CUDA graph."""
        self._states = states
        gc.collect()  # gradients of earlier updates belong to another stream
        self._set_capturable(True)
        self.optimizer.zero_grad()
        parameters = [parameter for group in self.clipped for parameter in group]
        self._graph = UpdateGraph.or_none(self._on_device, parameters, [self.optimizer])
        if self._graph is None:
            self._by_torch = math.inf
            self._set_capturable(False)

    def _set_capturable(self, value: bool) -> None:
        for group in self.optimizer.param_groups:
            group["capturable"] = value

    def _on_device(self) -> Tensor:
        """Update without waiting for the device; return the losses' numbers, then the norms of all gradients."""
        norms: list[Tensor] = []
        numbers = self._gradient_steps(self._states, lambda group: norms.append(clip_on_device(group, _MAX_NORM)))
        return torch.stack([*(value.double() for of_loss in numbers for value in of_loss.values()), *norms])

    def state_dict(self) -> dict[str, Any]:
        """Return the state to resume from, without the networks."""
        return {"adam": self.optimizer.state_dict(), "log_alphas": [alpha.detach() for alpha in self.alphas]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a :meth:`state_dict`; ValueError if it belongs to other networks or is malformed."""
        require_like(self.state_dict()["log_alphas"], state["log_alphas"], "training.log_alphas")
        load_optimizer(self.optimizer, state["adam"])
        with torch.no_grad():
            for alpha, kept in zip(self.alphas, state["log_alphas"], strict=True):
                alpha.copy_(kept)
