"""MuJoCo's laws of activations: how filters, integrators and muscles follow controls that are held."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.actuator_kinds import in_disabled_group
from torchrl_gn.scenes.scene import Scene

_DYN, _TINY = mujoco.mjtDyn, mujoco.mjMINVAL


class ActivationStep(NamedTuple):
    """Activations in a control step."""

    now: Tensor  # [*B, na] that drive the actuators at its start
    later: Tensor  # [*B, na] at its end
    change: Tensor  # [*B, N, K] of the state


class ActivationLaws(Float64Buffers):
    """Activations of a scene, ``na`` of them, over a control step with its controls held, or delayed ones changed once.

    Those without a law of MuJoCo's (of plugins, or of users' callbacks) stay: the network predicts their change.
    """

    node: Tensor
    channel: Tensor
    place: Tensor
    control: Tensor
    switch: Tensor
    keeps: Tensor
    slope: Tensor
    low: Tensor
    high: Tensor
    is_muscle: Tensor
    muscle: Tensor
    early: Tensor

    def __init__(self, scene: Scene, switch: np.ndarray | None = None) -> None:
        """``switch`` ``[A]``: physics steps of a control step after which another control acts; default: none."""
        super().__init__()
        model, found = scene.model, scene.activations
        actuator = found.actuator
        self.steps, self.timestep = scene.substeps, float(model.opt.timestep)
        self.averages = model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4)
        off = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION))
        runs = found.known & ~np.array(
            [off or in_disabled_group(model, each) for each in actuator.tolist()], dtype=bool
        )
        kind = np.where(runs, model.actuator_dyntype[actuator], -1)
        limited, ranges = model.actuator_actlimited[actuator].astype(bool), model.actuator_actrange[actuator]
        is_muscle, early = kind == int(_DYN.mjDYN_MUSCLE), model.actuator_actearly[actuator].astype(bool)
        self.any_muscle, self.any_early = bool(is_muscle.any()), bool(early.any())
        self.switches = switch is not None and bool((switch[actuator] < self.steps).any())
        self.constants(
            {
                "node": found.node,
                "channel": BODY_STATE.size + found.slot,
                "place": found.places(scene.num_nodes),
                "control": actuator,
                "switch": np.full(len(actuator), self.steps) if switch is None else switch[actuator],
                "keeps": self._keeps(kind, np.maximum(model.actuator_dynprm[actuator, 0], _TINY)),
                "slope": np.where(kind == int(_DYN.mjDYN_INTEGRATOR), self.timestep, 0.0),
                "low": np.where(limited, ranges[:, 0], -np.inf),
                "high": np.where(limited, ranges[:, 1], np.inf),
                "is_muscle": is_muscle,
                "muscle": np.where(is_muscle[:, None], model.actuator_dynprm[actuator, :3], 1.0).T.copy(),
                "early": early,
            }
        )

    def _keeps(self, kind: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """How much ``[na]`` of its distance from the control a filter keeps in a physics step; 1 of others."""
        part = self.timestep / tau
        moved = np.where(kind == int(_DYN.mjDYN_FILTEREXACT), 1 - np.exp(-part), part)
        if self.averages:  # the rates at the stages of a Runge-Kutta step
            moved = moved * (1 - part / 2 + part**2 / 6 - part**3 / 24)
        return np.where(np.isin(kind, (int(_DYN.mjDYN_FILTER), int(_DYN.mjDYN_FILTEREXACT))), 1 - moved, 1.0)

    def read(self, state: Tensor) -> Tensor:
        """Activations ``[*B, na]`` in states ``[*B, N, C]``."""
        return state[..., self.node, self.channel]

    def after(self, activation: Tensor, first: Tensor, later: Tensor, steps: int) -> Tensor:
        """Activations ``[*B, na]`` some physics steps later, under controls ``[*B, A]`` within their limits."""
        first, later = first[..., self.control], later[..., self.control]
        if self.switches:
            before = self.switch.clamp(max=steps)
            found = self._follow(self._follow(activation, first, before), later, steps - before)
        else:
            found = self._follow(activation, first, steps)
        if not self.any_muscle:
            return found
        contracted = activation
        for step in range(steps):
            control = torch.where(step < self.switch, first, later) if self.switches else first
            contracted = self._contract(contracted, control)
        return torch.where(self.is_muscle, self._limited(contracted), found)

    def _follow(self, activation: Tensor, control: Tensor, steps: Tensor | int) -> Tensor:
        """Filters and integrators some physics steps later."""
        dtype = activation.dtype
        away = (activation - control) * (self.keeps**steps - 1).to(dtype)
        return self._limited(activation + away + control * (steps * self.slope).to(dtype))

    def _contract(self, activation: Tensor, control: Tensor) -> Tensor:
        """Muscles after a physics step."""
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
        """Rate of muscles' activations, ``mju_muscleDynamics``."""
        rises, falls, width = self.muscle.to(activation.dtype)
        away, speed = control.clamp(0, 1) - activation, 0.5 + 1.5 * activation.clamp(0, 1)
        rises, falls = rises * speed, falls / speed
        is_smooth = width > _TINY
        x = (away / torch.where(is_smooth, width, 1.0) + 0.5).clamp(0, 1)
        smooth = x * x * x * (3 * x * (2 * x - 5) + 10)
        up = torch.where(is_smooth, smooth, torch.where(away > 0, 1.0, 0.0).to(x.dtype))
        return away / (falls + (rises - falls) * up).clamp(min=_TINY)

    def forward(self, state: Tensor, first: Tensor, later: Tensor) -> ActivationStep:
        """What a control step makes of states ``[*B, N, C]`` under controls ``[*B, A]`` within their limits.

        ``first`` act at its start and ``later`` at its end: the same without delays.
        """
        now = self.read(state)
        end = self.after(now, first, later, self.steps)
        change = pad(end - now, (0, 1))[..., self.place]
        if self.any_early:  # forces are those of the next physics step's activation
            now = torch.where(self.early, self.after(now, first, first, 1), now)
            end = torch.where(self.early, self.after(end, later, later, 1), end)
        return ActivationStep(now, end, change)
