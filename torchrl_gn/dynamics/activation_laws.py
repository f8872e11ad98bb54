"""Activation dynamics of MuJoCo's filters, integrators and muscles, under controls held over a control step."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.actuator_kinds import switched_off
from torchrl_gn.scenes.scene import Scene

_DYN, _TINY = mujoco.mjtDyn, mujoco.mjMINVAL


class ActivationStep(NamedTuple):
    """Activations at the start and end of a control step, and the change of the state."""

    now: Tensor  # [*B, na] activations that drive the actuators at the start
    later: Tensor  # [*B, na] activations that drive them at the end
    change: Tensor  # [*B, N, K] change of the state's activation channels


class ActivationLaws(Float64Buffers):
    """Dynamics of a scene's ``na`` activations over a control step.

    Controls are held over the step; a delayed control changes once within it. Activations outside
    ``scene.activations.known`` (of plugins, user callbacks, ...) stay constant here: the network predicts their change.
    """

    node: Tensor
    channel: Tensor
    place: Tensor
    control: Tensor
    switch: Tensor
    keeps: Tensor
    keeps_early: Tensor
    slope: Tensor
    low: Tensor
    high: Tensor
    is_muscle: Tensor
    muscle: Tensor
    early: Tensor

    def __init__(self, scene: Scene, switch: np.ndarray | None = None) -> None:
        """Read the laws of a scene.

        Args:
            scene: the scene.
            switch: ``[A]`` physics steps into a control step after which the next control acts; default: no change.
        """
        super().__init__()
        model, activations = scene.model, scene.activations
        actuator = activations.actuator
        self.steps, self.timestep = scene.substeps, float(model.opt.timestep)
        self.averages = model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)
        runs = activations.known & ~switched_off(model)[actuator]
        kind = np.where(runs, model.actuator_dyntype[actuator], -1)
        limited, ranges = model.actuator_actlimited[actuator].astype(bool), model.actuator_actrange[actuator]
        is_muscle, early = kind == int(_DYN.mjDYN_MUSCLE), model.actuator_actearly[actuator].astype(bool)
        self.any_muscle, self.any_early = bool(is_muscle.any()), bool(early.any())
        self.switches = switch is not None and bool((switch[actuator] < self.steps).any())
        tau = np.maximum(model.actuator_dynprm[actuator, 0], _TINY)
        self.constants(
            {
                "node": activations.node,
                "channel": BODY_STATE.size + activations.slot,
                "place": activations.places(scene.num_nodes),
                "control": actuator,
                "switch": np.full(len(actuator), self.steps) if switch is None else switch[actuator],
                "keeps": self._keeps(kind, tau, averages=self.averages),
                "keeps_early": self._keeps(kind, tau, averages=False),
                "slope": np.where(kind == int(_DYN.mjDYN_INTEGRATOR), self.timestep, 0.0),
                "low": np.where(limited, ranges[:, 0], -np.inf),
                "high": np.where(limited, ranges[:, 1], np.inf),
                "is_muscle": is_muscle,
                "muscle": np.where(is_muscle[:, None], model.actuator_dynprm[actuator, :3], 1.0).T.copy(),
                "early": early,
            }
        )

    def _keeps(self, kind: np.ndarray, tau: np.ndarray, *, averages: bool) -> np.ndarray:
        """Return each filter's decay factor ``[na]`` per physics step; 1 for other activations."""
        part = self.timestep / tau
        moved = np.where(kind == int(_DYN.mjDYN_FILTEREXACT), 1 - np.exp(-part), part)
        if averages:  # RK4 averages the rates of its four stages
            moved = moved * (1 - part / 2 + part**2 / 6 - part**3 / 24)
        return np.where(np.isin(kind, (int(_DYN.mjDYN_FILTER), int(_DYN.mjDYN_FILTEREXACT))), 1 - moved, 1.0)

    def read(self, state: Tensor) -> Tensor:
        """Return the activations ``[*B, na]`` of states ``[*B, N, C]``."""
        return state[..., self.node, self.channel]

    def after(self, activation: Tensor, first: Tensor, later: Tensor, steps: int) -> Tensor:
        """Return activations ``[*B, na]`` after some physics steps under controls ``[*B, A]`` within their limits."""
        first, later = first[..., self.control], later[..., self.control]
        if self.switches:
            before = self.switch.clamp(max=steps)
            filtered = self._follow(self._follow(activation, first, before), later, steps - before)
        else:
            filtered = self._follow(activation, first, steps)
        if not self.any_muscle:
            return filtered
        contracted = activation
        for step in range(steps):
            control = torch.where(step < self.switch, first, later) if self.switches else first
            contracted = self._contract(contracted, control)
        return torch.where(self.is_muscle, self._limited(contracted), filtered)

    def _early_activation(self, activation: Tensor, control: Tensor) -> Tensor:
        """Return the activations ``[*B, na]`` that forces with ``actearly`` use, under controls ``[*B, A]``.

        These are the activations of the next physics step, by Euler's method even with RK4.
        """
        control = control[..., self.control]
        filtered = self._follow(activation, control, 1, self.keeps_early)
        if not self.any_muscle:
            return filtered
        contracted = self._limited(activation + self.timestep * self._rate(activation, control))
        return torch.where(self.is_muscle, contracted, filtered)

    def _follow(self, activation: Tensor, control: Tensor, steps: Tensor | int, keeps: Tensor | None = None) -> Tensor:
        """Advance filters and integrators by some physics steps."""
        dtype, keeps = activation.dtype, self.keeps if keeps is None else keeps
        away = (activation - control) * (keeps**steps - 1).to(dtype)
        return self._limited(activation + away + control * (steps * self.slope).to(dtype))

    def _contract(self, activation: Tensor, control: Tensor) -> Tensor:
        """Advance muscles by one physics step."""
        h, rate = self.timestep, self._rate
        first = mean = rate(activation, control)
        if self.averages:
            second = rate(activation + h / 2 * first, control)
            third = rate(activation + h / 2 * second, control)
            mean = (first + 2 * second + 2 * third + rate(activation + h * third, control)) / 6
        return self._limited(activation + h * mean)

    def _limited(self, activation: Tensor) -> Tensor:
        low, high = self.low.to(activation.dtype), self.high.to(activation.dtype)
        return torch.minimum(torch.maximum(activation, low), high)

    def _rate(self, activation: Tensor, control: Tensor) -> Tensor:
        """Return the rates of muscles' activations (``mju_muscleDynamics``)."""
        rises, falls, width = self.muscle.to(activation.dtype)
        away, speed = control.clamp(0, 1) - activation, 0.5 + 1.5 * activation.clamp(0, 1)
        rises, falls = rises * speed, falls / speed
        is_smooth = width > _TINY
        x = (away / torch.where(is_smooth, width, 1.0) + 0.5).clamp(0, 1)
        smooth = x * x * x * (3 * x * (2 * x - 5) + 10)
        up = torch.where(is_smooth, smooth, torch.where(away > 0, 1.0, 0.0).to(x.dtype))
        return away / (falls + (rises - falls) * up).clamp(min=_TINY)

    def forward(self, state: Tensor, first: Tensor, later: Tensor) -> ActivationStep:
        """Advance the activations of states ``[*B, N, C]`` by a control step.

        ``first`` and ``later`` are the controls ``[*B, A]`` at the step's start and end, within their limits. They are
        equal without delays.
        """
        now = self.read(state)
        end = self.after(now, first, later, self.steps)
        change = pad(end - now, (0, 1))[..., self.place]
        if self.any_early:  # with actearly, forces use the next physics step's activation
            now = torch.where(self.early, self._early_activation(now, first), now)
            end = torch.where(self.early, self._early_activation(end, later), end)
        return ActivationStep(now, end, change)
