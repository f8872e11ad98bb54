"""Value, gradient and Gauss-Newton Hessian of a reward along a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

Inputs = tuple[np.ndarray, np.ndarray, np.ndarray]  # state [*B, N, 13], action [*B, A], next state [*B, N, 13]


class RewardExpansion:
    """A tensor reward ``(state, action, next_state, task) -> [*B, 1]`` as a function of arrays, with derivatives.

    Opens autograd itself. ``task`` has no batch: a tensor, a TensorDict or None.
    """

    def __init__(self, reward: Callable[..., Tensor], task: Any, device: torch.device | str | None):
        self.reward, self.device = reward, device
        with torch.inference_mode(False):
            # Autograd refuses tensors made in inference mode: clone it.
            self.task = None if task is None else task.detach().clone()

    def value(self, inputs: Inputs) -> np.ndarray:
        """Rewards ``[*B]``."""
        with torch.inference_mode(False), torch.no_grad():
            return self._call(self._tensors(inputs)).cpu().numpy()

    def derivatives(self, inputs: Inputs, jacobians: Inputs) -> tuple[np.ndarray, np.ndarray]:
        """Gradient ``[T, Z]`` and Gauss-Newton Hessian ``[T, Z, Z]`` by ``Z`` variables of the inputs.

        ``inputs`` are those of ``T`` steps, with Jacobians ``[T, N * 13, Z]``, ``[T, A, Z]`` and ``[T, N * 13, Z]``.
        ValueError if autograd cannot differentiate the reward, or its shape is wrong.
        """
        num = jacobians[0].shape[-1]
        with torch.inference_mode(False), torch.enable_grad():
            columns = [torch.from_numpy(np.ascontiguousarray(j)).to(self.device) for j in jacobians]
            gradients, _ = self._gradients(self._tensors(inputs))
            pairs = zip(columns, gradients, strict=True)
            terms = [(j.mT @ g.flatten(1).unsqueeze(-1)).squeeze(-1) for j, g in pairs]
            gradient = (terms[0] + terms[1] + terms[2]).detach().cpu().numpy()
            hessian = torch.zeros(len(inputs[1]), num, num, dtype=torch.float64)
            if any(g.requires_grad for g in gradients):
                # One copy of the trajectory per variable: rows are independent, so one backward pass gives H J.
                state, action, next_state = (np.broadcast_to(x, (num, *x.shape)) for x in inputs)
                gradients, leaves = self._gradients(self._tensors((state, action, next_state)))
                tangents = [j.permute(2, 0, 1).reshape(x.shape) for j, x in zip(columns, leaves, strict=True)]
                pairs = [(g, v) for g, v in zip(gradients, tangents, strict=True) if g.requires_grad]
                products = torch.autograd.grad(
                    [g for g, _ in pairs], leaves, [v for _, v in pairs], allow_unused=True, materialize_grads=True
                )
                for j, p in zip(columns, products, strict=True):
                    hessian += torch.einsum("tiz,yti->tzy", j, p.flatten(2)).detach().cpu()
        return gradient, hessian.numpy()

    def _gradients(self, leaves: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        leaves = tuple(leaf.requires_grad_() for leaf in leaves)
        total = self._call(leaves).sum()
        if not total.requires_grad:
            raise ValueError(
                f"iLQG needs a reward that autograd can differentiate; {self.reward} returned one without gradient."
            )
        gradients = torch.autograd.grad(total, leaves, create_graph=True, allow_unused=True, materialize_grads=True)
        return gradients, leaves

    def _call(self, tensors: tuple[Tensor, ...]) -> Tensor:
        state, action, next_state = tensors
        batch = action.shape[:-1]
        task = None if self.task is None else self.task.expand(*batch, *self.task.shape)
        value = self.reward(state, action, next_state, task)
        if value.shape != (*batch, 1):
            raise ValueError(f"the reward must be {[*batch, 1]}, {self.reward} returned {list(value.shape)}")
        return value[..., 0]

    def _tensors(self, inputs: Inputs) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(np.array(x, dtype=np.float64, order="C")).to(self.device) for x in inputs)
