"""The control suite's tasks as differentiable rewards on states, with returns comparable to the suite's."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.distance import Near, length
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.rewards.tolerance import tolerance
from torchrl_gn.scenes.scene import Scene

_ANY = math.inf


class CenterOfMassVelocity(Float64Buffers):
    """World-frame velocity ``[*B, 3]``, m/s, of the centre of mass of a body and all its descendants.

    ValueError if the scene has no such body, or states have a wrong shape.
    """

    share: Tensor
    center: Tensor

    def __init__(self, scene: Scene, body: str) -> None:
        super().__init__()
        model = scene.model
        root = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
        if root < 1:
            raise ValueError(f"scene {scene.name!r} has no body {body!r}")
        below = {root}
        for index in range(root + 1, model.nbody):  # parents come first
            if model.body_parentid[index] in below:
                below.add(index)
        rows = sorted(below)
        self.bodies = Bodies(scene, [model.body(index).name for index in rows])
        mass = model.body_mass[rows]
        self.constants({"share": mass / mass.sum(), "center": model.body_ipos[rows]})

    def forward(self, state: Tensor) -> Tensor:
        offset = quaternion.rotate(self.bodies.orientation(state), self.center.to(state.dtype))
        velocity = self.bodies.linear_velocity(state)
        velocity = velocity + torch.linalg.cross(self.bodies.angular_velocity(state), offset)
        return (self.share.to(state.dtype).unsqueeze(-1) * velocity).sum(-2)


class Place(Float64Buffers):
    """World-frame position ``[*B, 3]``, metres, and velocity ``[*B, 3]``, m/s, of a point fixed in a body.

    Args:
        body: name of the body.
        offset: ``[3]`` of the point in the body's frame, metres.
    """

    offset: Tensor

    def __init__(self, scene: Scene, body: str, offset: np.ndarray) -> None:
        super().__init__()
        self.bodies = Bodies(scene, [body])
        self.constants({"offset": np.array(offset, dtype=np.float64)})

    @classmethod
    def of_geom(cls, scene: Scene, name: str) -> Place:
        geom = scene.model.geom(name)
        return cls(scene, scene.model.body(int(geom.bodyid[0])).name, geom.pos)

    @classmethod
    def of_site(cls, scene: Scene, name: str) -> Place:
        site = scene.model.site(name)
        return cls(scene, scene.model.body(int(site.bodyid[0])).name, site.pos)

    @classmethod
    def of_mass(cls, scene: Scene, body: str) -> Place:
        """Return the centre of mass of a body without its descendants."""
        return cls(scene, body, scene.model.body(body).ipos)

    def forward(self, state: Tensor) -> Tensor:
        position, orientation = (each.squeeze(-2) for each in self.bodies.pose(state))
        return position + quaternion.rotate(orientation, self.offset.to(state.dtype).expand_as(position))

    def velocity(self, state: Tensor) -> Tensor:
        orientation, spin = self.bodies.orientation(state).squeeze(-2), self.bodies.angular_velocity(state).squeeze(-2)
        arm = quaternion.rotate(orientation, self.offset.to(state.dtype).expand_as(spin))
        return self.bodies.linear_velocity(state).squeeze(-2) + torch.linalg.cross(spin, arm)


class HingeRates(Float64Buffers):
    """Rates ``[*B, K]``, rad/s, of hinges that share no child body and no parent body."""

    axis: Tensor

    def __init__(self, scene: Scene, joints: list[str]) -> None:
        super().__init__()
        model = scene.model
        below = [int(model.joint(name).bodyid[0]) for name in joints]
        above = [int(model.body_parentid[body]) for body in below]
        self.moving = Bodies(scene, [model.body(body).name for body in below])
        self.parents = Bodies(scene, [model.body(body).name for body in above])
        self.constants({"axis": np.stack([model.joint(name).axis for name in joints])})

    def forward(self, state: Tensor) -> Tensor:
        spin, orientation = self.moving.angular_velocity(state), self.moving.orientation(state)
        axis = quaternion.rotate(orientation, self.axis.to(state.dtype).expand_as(spin))
        return ((spin - self.parents.angular_velocity(state)) * axis).sum(-1)


class SuiteReward(Reward):
    """Base class of the suite's rewards ``[*B, 1]``, from 0 to 1, of the state after a step and the step's action."""

    def __init__(self, scene: Scene, **shown: object) -> None:
        super().__init__()
        self.shown = {"scene": scene.name, **shown}

    def upright(self, bodies: Bodies, state: Tensor) -> Tensor:
        """Return the cosine ``[*B, K]`` of the angle between each body's z axis and the vertical."""
        return quaternion.to_matrix(bodies.orientation(state))[..., 8]

    def small(self, action: Tensor) -> Tensor:
        """Return the suite's factor ``[*B, 1]``, 0.8 to 1, that favours small actions."""
        return (4 + tolerance(action, margin=1, sigmoid="quadratic", at_margin=0.0).mean(-1, keepdim=True)) / 5


class Run(SuiteReward):
    r"""The suite's ``cheetah run``: velocity of the centre of mass along x divided by ``speed``, clamped to [0, 1].

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> Run(load_scene("cheetah"), "torso")
        Run(scene='cheetah', body='torso', speed=10.0)
    """

    def __init__(self, scene: Scene, body: str, *, speed: float = 10.0) -> None:
        if not 0 < speed < math.inf:
            raise ValueError(f"speed must be a positive number of m/s, got {speed}")
        super().__init__(scene, body=body, speed=float(speed))
        self.velocity, self.speed = CenterOfMassVelocity(scene, body), float(speed)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return _pace(self.velocity(next_state), self.speed)


class RunUpright(SuiteReward):
    r"""The suite's ``walker run`` (``speed=8``), ``walk`` (1) and ``stand`` (0): upright, velocity at least ``speed``.

    .. math:: \tfrac{1}{4} (3\, h + \tfrac{1 + \cos\theta}{2}) \cdot \tfrac{1}{6} (5\, v + 1)

    Here :math:`h` is 1 if the body's height is at least 1.2 m, with a Gaussian decrease below; :math:`\theta` is its
    angle to the vertical; and :math:`v` is the velocity of the centre of mass along x divided by ``speed``, clamped to
    [0, 1]. With ``speed=0`` the second factor is 1.
    """

    def __init__(self, scene: Scene, body: str, *, speed: float = 8.0) -> None:
        if not 0 <= speed < math.inf:
            raise ValueError(f"speed must be a number of m/s from 0, got {speed}")
        super().__init__(scene, body=body, speed=float(speed))
        self.bodies, self.velocity, self.speed = Bodies(scene, [body]), CenterOfMassVelocity(scene, body), float(speed)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        standing = tolerance(self.bodies.position(next_state)[..., 2], 1.2, _ANY, margin=0.6)
        stand = (3 * standing + (1 + self.upright(self.bodies, next_state)) / 2) / 4
        if self.speed == 0:
            return stand
        return stand * (5 * _pace(self.velocity(next_state), self.speed) + 1) / 6


class TipUp(SuiteReward):
    """The suite's ``acrobot swingup``: the tip near the target above; if ``sparse``, within the target's radius."""

    def __init__(self, scene: Scene, *, sparse: bool = False) -> None:
        super().__init__(scene, sparse=sparse)
        self.tip, self.target = Place.of_site(scene, "tip"), Place.of_site(scene, "target")
        self.radius, self.margin = float(scene.model.site("target").size[0]), 0.0 if sparse else 1.0

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        away = length(self.target(next_state) - self.tip(next_state))
        return tolerance(away, 0.0, self.radius, margin=self.margin)


class PolesUp(SuiteReward):
    """The suite's ``cartpole``: poles upright and slow, the cart in the middle, small actions."""

    def __init__(self, scene: Scene, *, sparse: bool = False) -> None:
        super().__init__(scene, sparse=sparse)
        hinges = [name for name in scene.joint_names if name.startswith("hinge")]
        self.cart, self.poles = Bodies(scene, ["cart"]), Bodies(scene, [f"pole_{k + 1}" for k in range(len(hinges))])
        self.rates, self.sparse = HingeRates(scene, hinges), sparse

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        upright, cart_position = self.upright(self.poles, next_state), self.cart.position(next_state)[..., 0]
        if self.sparse:
            up = tolerance(upright, 0.995, 1.0 + 1e-9).prod(-1, keepdim=True)  # a cosine may round beyond 1
            return up * tolerance(cart_position, -0.25, 0.25)
        centered = (1 + tolerance(cart_position, margin=2)) / 2
        slow = (1 + tolerance(self.rates(next_state), margin=5).amin(-1, keepdim=True)) / 2
        return ((upright + 1) / 2).mean(-1, keepdim=True) * self.small(action) * slow * centered


class PoleUp(SuiteReward):
    """The suite's ``pendulum swingup``: 1 within 8 degrees of the vertical, else 0."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.pole = Bodies(scene, ["pole"])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return tolerance(self.upright(self.pole, next_state), math.cos(math.radians(8)), _ANY)


class Hop(SuiteReward):
    """The suite's ``hopper hop`` (``speed=2``) and ``stand`` (0): torso above the foot, velocity at least ``speed``."""

    def __init__(self, scene: Scene, *, speed: float = 2.0) -> None:
        super().__init__(scene, speed=speed)
        self.torso, self.foot = Place.of_mass(scene, "torso"), Place.of_mass(scene, "foot")
        self.velocity, self.speed = CenterOfMassVelocity(scene, "torso"), speed

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        height = (self.torso(next_state) - self.foot(next_state))[..., 2:]
        standing = tolerance(height, 0.6, 2.0)
        return standing * (self.small(action) if self.speed == 0 else _pace(self.velocity(next_state), self.speed))


class Walk(SuiteReward):
    """The suite's ``quadruped walk`` (``speed=0.5``) and ``run`` (5): upright, and forward in the torso's frame."""

    ahead: Tensor

    def __init__(self, scene: Scene, *, speed: float) -> None:
        super().__init__(scene, speed=speed)
        self.torso, self.speed = Bodies(scene, ["torso"]), speed
        self.place = Place.of_site(scene, "torso")  # site of the velocimeter
        ahead = torch.from_numpy(_axes(scene.model.site("torso").quat)[:, 0].copy())
        self.register_buffer("ahead", ahead, persistent=False)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        velocity, orientation = self.place.velocity(next_state), self.torso.orientation(next_state).squeeze(-2)
        ahead = quaternion.rotate(orientation, self.ahead.to(velocity.dtype).expand_as(velocity))
        speed = (velocity * ahead).sum(-1, keepdim=True)
        upright = (1 + self.upright(self.torso, next_state)) / 2
        moving = tolerance(speed, self.speed, _ANY, margin=self.speed, sigmoid="linear", at_margin=0.5)
        return upright.clamp(0.0, 1.0) * moving


class HeadUp(SuiteReward):
    """The suite's ``humanoid stand`` (``speed=0``), ``walk`` (1) and ``run`` (10)."""

    def __init__(self, scene: Scene, *, speed: float) -> None:
        super().__init__(scene, speed=speed)
        self.head, self.torso = Bodies(scene, ["head"]), Bodies(scene, ["torso"])
        self.velocity, self.speed = CenterOfMassVelocity(scene, "torso"), speed

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        height = self.head.position(next_state)[..., 2]
        standing = tolerance(height, 1.4, _ANY, margin=0.35)
        upright = tolerance(
            self.upright(self.torso, next_state), 0.9, _ANY, margin=1.9, sigmoid="linear", at_margin=0.0
        )
        velocity = self.velocity(next_state)[..., :2]
        if self.speed == 0:
            moving = tolerance(velocity, margin=2).mean(-1, keepdim=True)
        else:
            moving = (1 + 5 * (length(velocity) / self.speed).clamp(max=1.0)) / 6
        return self.small(action) * standing * upright * moving


class Spin(SuiteReward):
    """The suite's ``finger spin``: 1 while the hinge turns at -15 rad/s or faster, else 0."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.rate = HingeRates(scene, ["hinge"])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return tolerance(self.rate(next_state), -_ANY, -15.0)


class TorsoUp(SuiteReward):
    """The suite's ``fish upright``."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.torso = Bodies(scene, ["torso"])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return tolerance(self.upright(self.torso, next_state), 1.0, 1.0, margin=1)


class CaughtBall(SuiteReward):
    """The suite's ``ball_in_cup catch``: 1 while the ball is in the cup, else 0."""

    inside: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.ball, self.cup = Bodies(scene, ["ball"]), Place.of_site(scene, "target")
        size = scene.model.site("target").size[[0, 2]] - scene.model.geom("ball").size[0]
        self.register_buffer("inside", torch.from_numpy(size.copy()), persistent=False)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        away = (self.cup(next_state) - self.ball.position(next_state).squeeze(-2)).abs()[..., ::2]
        return (away < self.inside).all(-1, keepdim=True).to(next_state.dtype)


class MassAtTarget(SuiteReward):
    """The suite's ``point_mass easy``: the mass at its target, with small actions."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.mass, self.target = Place.of_geom(scene, "pointmass"), Place.of_geom(scene, "target")
        self.size = float(scene.model.geom("target").size[0])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        away = length(self.target(next_state) - self.mass(next_state))
        return tolerance(away, 0.0, self.size, margin=self.size) * self.small(action)


class PlaceAtTarget(SuiteReward):
    """The suite's ``reacher`` and ``finger turn``: 1 if ``place`` is within ``radius`` of the episode's target, else 0.

    Args:
        axes: world axes along which the distance is taken.
    """

    target_shape = (3,)

    def __init__(self, scene: Scene, place: Place, axes: Sequence[int], radius: float) -> None:
        super().__init__(scene, radius=radius)
        self.place, self.axes, self.radius = place, list(axes), radius

    def away(self, state: Tensor, task: Tensor | None) -> Tensor:
        """Return the distance ``[*B, 1]`` of ``place`` from the target."""
        return length((self.require_task(task, state) - self.place(state))[..., self.axes])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return tolerance(self.away(next_state, task), 0.0, self.radius)


class SwimUpright(PlaceAtTarget):
    """The suite's ``fish swim``: the mouth at the episode's target, the torso upright."""

    def __init__(self, scene: Scene) -> None:
        radius = sum(float(scene.model.geom(name).size[0]) for name in ("mouth", "target"))
        super().__init__(scene, Place.of_geom(scene, "mouth"), (0, 1, 2), radius)
        self.torso = Bodies(scene, ["torso"])

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        near = tolerance(self.away(next_state, task), 0.0, self.radius, margin=2 * self.radius)
        return (7 * near + (1 + self.upright(self.torso, next_state)) / 2) / 8


def _reacher(scene: Scene, target: float) -> Reward:
    finger = Place.of_geom(scene, "finger")
    return PlaceAtTarget(scene, finger, (0, 1), target + float(scene.model.geom("finger").size[0]))


def _swimmer(scene: Scene) -> Reward:
    nose, radius = scene.model.geom("nose"), float(scene.model.geom("target").size[0])
    return Near(scene, "head", offset=nose.pos, radius=radius, margin=5 * radius)


def _turned(scene: Scene, target: float) -> Reward:
    return PlaceAtTarget(scene, Place.of_site(scene, "tip"), (0, 2), target)


def _pace(velocity: Tensor, speed: float) -> Tensor:
    """Divide the velocity along x by ``speed`` and clamp it to [0, 1], ``[*B, 1]``.

    This is the suite's linear tolerance with a margin of half the speed.
    """
    return (velocity[..., :1] / speed).clamp(0.0, 1.0)


def _axes(orientation: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, orientation)
    return matrix.reshape(3, 3)


_REWARDS: dict[str, Callable[[Scene], Reward]] = {
    "acrobot/swingup": TipUp,
    "acrobot/swingup_sparse": lambda scene: TipUp(scene, sparse=True),
    "ball_in_cup/catch": CaughtBall,
    "cartpole/balance": PolesUp,
    "cartpole/balance_sparse": lambda scene: PolesUp(scene, sparse=True),
    "cartpole/swingup": PolesUp,
    "cartpole/swingup_sparse": lambda scene: PolesUp(scene, sparse=True),
    "cartpole/three_poles": PolesUp,
    "cartpole/two_poles": PolesUp,
    "cheetah/run": lambda scene: Run(scene, "torso"),
    "finger/spin": Spin,
    "finger/turn_easy": lambda scene: _turned(scene, 0.07),  # tasks set the target's size, not the model
    "finger/turn_hard": lambda scene: _turned(scene, 0.03),
    "fish/swim": SwimUpright,
    "fish/upright": TorsoUp,
    "hopper/hop": Hop,
    "hopper/stand": lambda scene: Hop(scene, speed=0.0),
    "humanoid/run": lambda scene: HeadUp(scene, speed=10.0),
    "humanoid/run_pure_state": lambda scene: HeadUp(scene, speed=10.0),
    "humanoid/stand": lambda scene: HeadUp(scene, speed=0.0),
    "humanoid/walk": lambda scene: HeadUp(scene, speed=1.0),
    "pendulum/swingup": PoleUp,
    "point_mass/easy": MassAtTarget,
    "quadruped/run": lambda scene: Walk(scene, speed=5.0),
    "quadruped/walk": lambda scene: Walk(scene, speed=0.5),
    "reacher/easy": lambda scene: _reacher(scene, 0.05),
    "reacher/hard": lambda scene: _reacher(scene, 0.015),
    "swimmer/swimmer15": _swimmer,
    "swimmer/swimmer6": _swimmer,
    "walker/run": lambda scene: RunUpright(scene, "torso"),
    "walker/stand": lambda scene: RunUpright(scene, "torso", speed=0.0),
    "walker/walk": lambda scene: RunUpright(scene, "torso", speed=1.0),
}

SUITE_TASKS: tuple[str, ...] = tuple(_REWARDS)
"""Tasks of the suite that :func:`suite_reward` supports."""


def suite_reward(scene: Scene) -> Reward:
    """Return dm_control's reward of a suite scene, such as ``load_scene("suite:cheetah/run")``.

    It is differentiable, except for rewards that are only 0 or 1. If episodes have a target (reacher, finger turn, fish
    swim, swimmer), it is the reward's target. ValueError for other scenes and tasks.
    """
    task = scene.origin.get("suite")
    if task not in _REWARDS:
        known = f"there are {', '.join(SUITE_TASKS)}"
        raise ValueError(f"Scene {scene.name!r} is not a task of the suite whose reward is known; {known}.")
    return _REWARDS[task](scene)
