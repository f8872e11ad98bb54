"""Rewards for reaching a target, on states and on the control suite's observations."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from torchrl_gn.maths import quaternion
from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.rewards.tolerance import tolerance
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.scenes.scene import Scene

REACHED = 1e-9  # metres; a nearer target counts as reached


def length(vector: Tensor, least: float = 0.0) -> Tensor:
    """Return lengths ``[*B, 1]`` of vectors ``[*B, K]``; lengths up to ``least`` become 0, with zero gradient.

    This avoids the infinite gradient of the square root at 0.
    """
    square = vector.square().sum(-1, keepdim=True)
    away = square > least**2
    return torch.where(away, torch.where(away, square, 1.0).sqrt(), 0.0)


class Distance(Reward):
    """Negative distance, metres, of a body from a target after the step, raised to ``power``.

    The gradient is zero at the target.

    Args:
        scene: scene of the bodies.
        body: name of the body.
        target: ``[3]`` in the world frame, metres; or the name of another body, whose origin is the target; None: each
            episode has its own (:class:`FreezeGoal`).
        offset: ``[3]`` point in the frame of ``body`` whose distance is taken, metres.
        power: 1, or 2 for a squared distance.

    Raises:
        ValueError: if the scene has no such body, ``target`` is ``body``, ``power`` is another number, or ``target`` or
            ``offset`` are not three finite numbers.
    """

    goal: Tensor | None

    def __init__(
        self,
        scene: Scene,
        body: str,
        *,
        target: Sequence[float] | str | None = None,
        offset: Sequence[float] = (0.0, 0.0, 0.0),
        power: int = 1,
    ):
        super().__init__()
        if power not in (1, 2):
            raise ValueError(f"power must be 1 or 2, got {power!r}")
        fixed = None if isinstance(target, str) else target
        self.bodies, self.power = Bodies(scene, [body, target] if isinstance(target, str) else [body]), power
        self.shown = {"scene": scene.name, "body": body, "target": target if fixed is None else tuple(fixed)}
        for name, value in (("goal", fixed), ("offset", offset)):
            tensor = None if value is None else torch.tensor([float(each) for each in value], dtype=torch.float64)
            if tensor is not None and (tensor.shape != (3,) or not bool(tensor.isfinite().all())):
                raise ValueError(f"{'target' if name == 'goal' else name} must be three finite numbers, got {value}")
            self.register_buffer(name, tensor)
        self.target_shape = (3,) if target is None else None

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        position, orientation = self.bodies.pose(next_state)
        if self.goal is not None:
            goal = self.goal.to(next_state.dtype)
        elif self.target_shape is None:
            goal = position[..., 1, :]
        else:
            goal = self.require_task(task, next_state)
        offset = cast(Tensor, self.offset).to(next_state.dtype)
        point = position[..., 0, :] + quaternion.rotate(orientation[..., 0, :], offset.expand_as(goal))
        return -(point - goal).square().sum(-1, keepdim=True) if self.power == 2 else -length(point - goal, REACHED)


class Near(Distance):
    """The suite's reward for reaching a target: 1 within ``radius`` of the target, less at larger distances.

    At a distance ``d`` above ``radius`` it is ``1 / (1 + (3 (d - radius) / margin)^2)``, the long-tailed
    ``dm_control.utils.rewards.tolerance``. The gradient within ``radius`` is 0. See :class:`Distance` for the other
    arguments.

    Args:
        radius: distance, metres, up to which the reward is 1.
        margin: further distance, metres, at which the reward is 0.1.
    """

    def __init__(
        self,
        scene: Scene,
        body: str,
        *,
        target: Sequence[float] | str | None = None,
        offset: Sequence[float] = (0.0, 0.0, 0.0),
        radius: float = 0.1,
        margin: float = 0.5,
    ):
        super().__init__(scene, body, target=target, offset=offset, power=2)
        _check_sizes(radius, margin)
        self.radius, self.margin = radius, margin
        self.shown = {**self.shown, "radius": radius, "margin": margin}

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return _long_tail(-super().forward(state, action, next_state, task), self.radius, self.margin)


class TargetDistance(nn.Module):
    """The reward of :class:`Near` on observations, in which ``entry`` is the vector to the target."""

    def __init__(
        self, graph: ObservationGraph, entry: str = "to_target", *, radius: float = 0.1, margin: float = 0.5
    ) -> None:
        super().__init__()
        if entry not in graph.observation:
            raise ValueError(f"Observations of {graph.name!r} have no {entry!r}; there are {list(graph.observation)}.")
        _check_sizes(radius, margin)
        names = list(graph.observation)
        start = sum(graph.observation[name] for name in names[: names.index(entry)])
        self.where, self.radius, self.margin = slice(start, start + graph.observation[entry]), radius, margin

    def forward(self, observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
        square = next_observation[..., self.where].square().sum(-1, keepdim=True)
        return _long_tail(square, self.radius, self.margin)


def _check_sizes(radius: float, margin: float) -> None:
    if not (0 < radius < math.inf and 0 < margin < math.inf):
        raise ValueError(f"radius={radius} and margin={margin} must be positive and finite.")


def _long_tail(square: Tensor, radius: float, margin: float) -> Tensor:
    """Return the suite's long-tailed tolerance at squared distances."""
    # Clamp before the root, whose gradient is infinite at 0.
    return tolerance(square.clamp(min=radius**2).sqrt(), 0.0, radius, margin=margin, sigmoid="long_tail")
