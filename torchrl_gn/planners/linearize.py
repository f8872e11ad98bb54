"""Derivatives along a trajectory: of the true physics by finite differences, of a reward by autograd."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.envs.specs import require_shape
from torchrl_gn.scenes import Scene

Inputs = tuple[np.ndarray, np.ndarray, np.ndarray]  # state [*B, N, 13], action [*B, A], next state [*B, N, 13]


class Tangent:
    """Tangent space of physics states: ``2 nv + na`` numbers and past controls; rotation vectors for quaternions."""

    def __init__(self, scene: Scene):
        self.scene, self.model = scene, scene.model
        model = self.model
        self.size = 2 * model.nv + model.na + len(scene.delays.actuator)
        self._flat = model.nq == model.nv
        self._end = 1 + model.nq + model.nv + model.na  # 1: the time comes first

    def add(self, physics: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Add changes ``[*B, X]`` to states ``[*B, S]``."""
        nq, nv, na = self.model.nq, self.model.nv, self.model.na
        changed = np.array(np.broadcast_to(physics, (*change.shape[:-1], physics.shape[-1])), order="C")
        self.scene.delays.add(self.model, self.scene.substeps, changed, change[..., 2 * nv + na :])
        change = change[..., : 2 * nv + na]
        if self._flat:
            changed[..., 1 : self._end] += change
            return changed
        changed[..., 1 + nq : self._end] += change[..., nv:]
        rows = changed.reshape(-1, changed.shape[-1])
        for row, step in zip(rows, change[..., :nv].reshape(-1, nv), strict=True):
            mujoco.mj_integratePos(self.model, row[1 : 1 + nq], step, 1.0)
        return changed

    def subtract(self, physics: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Return changes ``[*B, X]`` from states ``base`` to states ``physics``, which broadcast."""
        nq, nv, late = self.model.nq, self.model.nv, self.scene.delays
        past = [late.read(self.model, self.scene.substeps, each) for each in (physics, base)]
        if self._flat:
            change = physics[..., 1 : self._end] - base[..., 1 : self._end]
            return np.concatenate((change, past[0] - past[1]), axis=-1) if late.size else change
        physics, base = np.broadcast_arrays(physics, base)
        change = np.empty((*physics.shape[:-1], self.size))
        change[..., nv : self.size - len(late.actuator)] = (
            physics[..., 1 + nq : self._end] - base[..., 1 + nq : self._end]
        )
        change[..., self.size - len(late.actuator) :] = past[0] - past[1]
        to, start = (np.ascontiguousarray(s[..., 1 : 1 + nq]).reshape(-1, nq) for s in (physics, base))
        step = np.empty((len(to), nv))
        for row in range(len(to)):
            mujoco.mj_differentiatePos(self.model, step[row], 1.0, start[row], to[row])
        change[..., :nv] = step.reshape(*change.shape[:-1], nv)
        return change


@dataclass(frozen=True)
class Linearization:
    """Jacobians along a trajectory of ``T`` control steps, NaN where a simulation was unstable."""

    dynamics: np.ndarray  # [T, X, X + A], of the next state by state and action
    bodies: np.ndarray  # [T + 1, N * 13, X], of the body states (entry `state`) by the state at the same time
    deviation: Callable[[int, np.ndarray], np.ndarray]  # changes [*B, X] from a step's state to others [*B, S]


def linearize(
    simulator: Simulator, physics: np.ndarray, actions: np.ndarray, *, epsilon: float = 1e-6, central: bool = False
) -> Linearization:
    """Linearise the dynamics at states ``[T + 1, S]`` and ``actions`` ``[T, A]`` by finite differences.

    Controls at a bound are perturbed inwards.

    Args:
        epsilon: perturbation in SI units; of controls, in units of half their range.
        central: use central differences, with error ``O(epsilon ** 2)``, at twice the cost of forward differences, with
            error ``O(epsilon)``.
    """
    scene, tangent = simulator.scene, Tangent(simulator.scene)
    times, num = len(physics), tangent.size + scene.num_actions
    # The last state has no action: its row only observes the bodies.
    controls = np.concatenate([actions, actions[-1:]])
    change = np.zeros((times, num, tangent.size))
    change[:, range(tangent.size), range(tangent.size)] = epsilon
    above, below, width = _perturb_controls(scene.action_low, scene.action_high, controls, epsilon, central)
    widths = np.full((times, num), 2 * epsilon if central else epsilon)
    widths[:, tangent.size :] = width

    starts, applied = [tangent.add(physics[:, None], change)], [_one_perturbed(controls, tangent.size, above)]
    starts.append(tangent.add(physics[:, None], -change) if central else physics[:, None])
    applied.append(_one_perturbed(controls, tangent.size, below) if central else controls[:, None])
    after, state = simulator.step(
        np.concatenate([s.reshape(-1, scene.physics_size) for s in starts]),
        np.concatenate([c.reshape(-1, scene.num_actions) for c in applied]),
    )
    (after_plus, after_minus), (bodies_plus, bodies_minus) = (
        [part.reshape(times, -1, part.shape[-1]) for part in np.split(values, [times * num])]
        for values in (after, state.reshape(len(state), -1))
    )
    dynamics = tangent.subtract(after_plus[:-1], after_minus[:-1]) / widths[:-1, :, None]
    minus = bodies_minus[:, : tangent.size]
    bodies = (bodies_plus[:, : tangent.size] - minus) / widths[:, : tangent.size, None]

    def deviation(t: int, others: np.ndarray) -> np.ndarray:
        return tangent.subtract(others, physics[t])

    return Linearization(dynamics.swapaxes(1, 2), bodies.swapaxes(1, 2), deviation)


def _perturb_controls(
    low: np.ndarray, high: np.ndarray, controls: np.ndarray, epsilon: float, central: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Perturb controls ``[T, A]`` up and down, inwards at bounds; also return the difference, 1 for equal bounds."""
    step = 0.5 * epsilon * (high - low)
    above = np.minimum(controls + step, high)
    below = np.maximum(controls - step, low)
    if not central:
        above = np.where(controls + step <= high, controls + step, controls - step)
        below = controls
    return above, below, np.where(high > low, above - below, 1.0)


def _one_perturbed(controls: np.ndarray, before: int, perturbed: np.ndarray) -> np.ndarray:
    """Return controls ``[T, before + A, A]``: ``before`` copies, then one copy per control with that one perturbed."""
    times, num = controls.shape
    result = np.repeat(controls[:, None], before + num, axis=1)
    result[:, range(before, before + num), range(num)] = perturbed
    return result


class RewardExpansion:
    """A tensor reward ``(state, action, next_state, task) -> [*B, 1]`` as a function of arrays, with derivatives.

    It enables autograd itself. ``task``, a tensor, a TensorDict or None, has no batch dimension.
    """

    def __init__(self, reward: Callable[..., Tensor], task: Any, device: torch.device | str | None):
        self.reward, self.device = reward, device
        with torch.inference_mode(False):
            # Autograd refuses tensors made in inference mode: clone the task.
            self.task = None if task is None else task.detach().clone()

    def value(self, inputs: Inputs) -> np.ndarray:
        """Return rewards ``[*B]``."""
        with torch.inference_mode(False), torch.no_grad():
            return self._call(self._tensors(inputs)).cpu().numpy()

    def derivatives(self, inputs: Inputs, jacobians: Inputs) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient ``[T, Z]`` and Gauss-Newton Hessian ``[T, Z, Z]`` with respect to ``Z`` variables.

        Args:
            inputs: state, action and next state of ``T`` steps.
            jacobians: Jacobians of the inputs, ``[T, N * 13, Z]``, ``[T, A, Z]`` and ``[T, N * 13, Z]``.

        Raises:
            ValueError: autograd cannot differentiate the reward, or its shape is wrong.
        """
        num = jacobians[0].shape[-1]
        with torch.inference_mode(False), torch.enable_grad():
            columns = [torch.from_numpy(np.ascontiguousarray(j)).to(self.device) for j in jacobians]
            gradients, _ = self._gradients(self._tensors(inputs))
            pairs = zip(columns, gradients, strict=True)
            terms = [(j.mT @ g.flatten(1).unsqueeze(-1)).squeeze(-1) for j, g in pairs]
            gradient = (terms[0] + terms[1] + terms[2]).detach().cpu().numpy()
            hessian = torch.zeros(len(inputs[1]), num, num, dtype=torch.float64, device="cpu")
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
        return require_shape(value, (*batch, 1), "the reward", self.reward)[..., 0]

    def _tensors(self, inputs: Inputs) -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(np.array(x, dtype=np.float64, order="C")).to(self.device) for x in inputs)
