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
    r"""Velocity of a body along a world axis, or a power of it.

    .. math:: r = (v'_a)^k

    with :math:`v'` the velocity of the body's frame after the step, m/s (paper, SM "Planning configuration":
    horizontal velocity of Cheetah's and Walker2d's torso, squared vertical speed of Cheetah's torso).

    Args:
        scene: scene whose states are judged.
        body: name of the body.
        axis: ``"x"``, ``"y"`` or ``"z"``; z is up.
        power: the exponent, at least 1; odd powers keep the sign.

    Raises:
        ValueError: the scene has no such body, or ``axis`` or ``power`` is invalid.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> Velocity(load_scene("cheetah"), "torso", "z", power=2)
        Velocity(scene='cheetah', body='torso', axis='z', power=2)
    """

    def __init__(self, scene: Scene, body: str, axis: Axis, *, power: int = 1):
        super().__init__()
        if isinstance(power, bool) or not isinstance(power, int) or power < 1:
            raise ValueError(f"power must be a whole number from 1, got {power!r}")
        self.bodies, self.axis, self.power = Bodies(scene, [body]), axis, power
        self.component = _component(axis)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward ``[*B, 1]``, m/s to the power; see :class:`Reward`. Only ``next_state`` is read."""
        return self.bodies.linear_velocity(next_state)[..., self.component] ** self.power

    def extra_repr(self) -> str:
        return f"{_one(self.bodies)}, axis={self.axis!r}, power={self.power}"


class Position(Reward):
    """Position of a body along a world axis after the step, metres.

    Paper, SM "Planning configuration": vertical position of Cheetah's and Walker2d's torso (``axis="z"``).

    Args:
        scene: scene whose states are judged.
        body: name of the body.
        axis: ``"x"``, ``"y"`` or ``"z"``; z is up.

    Raises:
        ValueError: the scene has no such body, or ``axis`` is invalid.
    """

    def __init__(self, scene: Scene, body: str, axis: Axis):
        super().__init__()
        self.bodies, self.axis = Bodies(scene, [body]), axis
        self.component = _component(axis)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward ``[*B, 1]``, metres; see :class:`Reward`. Only ``next_state`` is read."""
        return self.bodies.position(next_state)[..., self.component]

    def extra_repr(self) -> str:
        return f"{_one(self.bodies)}, axis={self.axis!r}"


class AngularSpeed(Reward):
    r"""Squared angular speed of a body.

    .. math:: r = |\omega'|^2

    with :math:`\omega'` the angular velocity after the step, rad/s (paper, SM "Planning configuration",
    Cheetah "Squared angular speed").

    Args:
        scene: scene whose states are judged.
        body: name of the body.

    Raises:
        ValueError: the scene has no such body.
    """

    def __init__(self, scene: Scene, body: str):
        super().__init__()
        self.bodies = Bodies(scene, [body])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward ``[*B, 1]``, rad^2/s^2; see :class:`Reward`. Only ``next_state`` is read."""
        return self.bodies.angular_velocity(next_state).square().sum(-1)

    def extra_repr(self) -> str:
        return _one(self.bodies)


class VerticalDistance(Reward):
    r"""Squared vertical distance between bodies and a reference body.

    .. math:: r = \sum_i (z'_i - z'_\text{reference})^2

    after the step (paper, SM "Planning configuration", Walker2d "Feet to head height", with the torso as the head).

    Args:
        scene: scene whose states are judged.
        bodies: names of the bodies, summed over.
        reference: name of the reference body.

    Raises:
        ValueError: the scene has no such body, or ``bodies`` is no list of different names.
    """

    def __init__(self, scene: Scene, bodies: Sequence[str], reference: str):
        super().__init__()
        self.bodies, self.reference = Bodies(scene, bodies), Bodies(scene, [reference])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward ``[*B, 1]``, square metres; see :class:`Reward`. Only ``next_state`` is read."""
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
