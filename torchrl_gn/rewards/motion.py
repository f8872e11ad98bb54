"""Rewards that read one component of a body's position or motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

from torch import Tensor

from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene

Axis = Literal["x", "y", "z"]


class Velocity(Reward):
    """Velocity of a body's frame along a world axis after the step, m/s, to a power of at least 1.

    Paper, SM "Planning configuration": Cheetah and Walker2d "forward", Cheetah "vertical speed" (``power=2``).
    """

    def __init__(self, scene: Scene, body: str, axis: Axis, *, power: int = 1):
        super().__init__()
        if isinstance(power, bool) or not isinstance(power, int) or power < 1:
            raise ValueError(f"power must be a whole number from 1, got {power!r}")
        self.bodies, self.axis, self.power = Bodies(scene, [body]), axis, power
        self.component = _component(axis)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return self.bodies.linear_velocity(next_state)[..., self.component] ** self.power

    def extra_repr(self) -> str:
        return f"{_one(self.bodies)}, axis={self.axis!r}, power={self.power}"


class Position(Reward):
    """Position of a body along a world axis after the step, metres (paper: height of the torso)."""

    def __init__(self, scene: Scene, body: str, axis: Axis):
        super().__init__()
        self.bodies, self.axis = Bodies(scene, [body]), axis
        self.component = _component(axis)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return self.bodies.position(next_state)[..., self.component]

    def extra_repr(self) -> str:
        return f"{_one(self.bodies)}, axis={self.axis!r}"


class AngularSpeed(Reward):
    """Squared angular speed of a body after the step, rad^2/s^2 (paper: Cheetah "Squared angular speed")."""

    def __init__(self, scene: Scene, body: str):
        super().__init__()
        self.bodies = Bodies(scene, [body])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return self.bodies.angular_velocity(next_state).square().sum(-1)

    def extra_repr(self) -> str:
        return _one(self.bodies)


class VerticalDistance(Reward):
    """Sum of squared vertical distances to a reference body after the step, m^2 (paper: "Feet to head height")."""

    def __init__(self, scene: Scene, bodies: Sequence[str], reference: str):
        super().__init__()
        self.bodies, self.reference = Bodies(scene, bodies), Bodies(scene, [reference])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        height = self.bodies.position(next_state)[..., 2]
        return (height - self.reference.position(next_state)[..., 2]).square().sum(-1, keepdim=True)

    def extra_repr(self) -> str:
        return f"scene={self.bodies.scene_name!r}, bodies={self.bodies.names}, reference={self.reference.names[0]!r}"


def _component(axis: str) -> int:
    if axis not in get_args(Axis):
        raise ValueError(f"axis must be one of {', '.join(get_args(Axis))}, got {axis!r}")
    return get_args(Axis).index(axis)


def _one(bodies: Bodies) -> str:
    return f"scene={bodies.scene_name!r}, body={bodies.names[0]!r}"
