"""The control suite's running tasks as rewards on states, for returns that compare with the suite's learners."""

from __future__ import annotations

import math

import mujoco
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene

_STAND_HEIGHT, _EDGE = 1.2, 0.1  # metres; the suite's value at the margin of a Gaussian tolerance


class CenterOfMassVelocity(Float64Buffers):
    """Velocity ``[*B, 3]``, m/s, of the centre of mass of a body and all that hangs on it, in the world's frame.

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


class Run(Reward):
    r"""The suite's ``cheetah run``: speed of the centre of mass along x over ``speed``, within 0 and 1.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> Run(load_scene("cheetah"), "torso")
        Run(scene='cheetah', body='torso', speed=10.0)
    """

    def __init__(self, scene: Scene, body: str, *, speed: float = 10.0) -> None:
        super().__init__()
        if not 0 < speed < math.inf:
            raise ValueError(f"speed must be a positive number of m/s, got {speed}")
        self.velocity, self.speed = CenterOfMassVelocity(scene, body), float(speed)
        self.shown = {"scene": scene.name, "body": body, "speed": self.speed}

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        return (self.velocity(next_state)[..., :1] / self.speed).clamp(0.0, 1.0)


class RunUpright(Reward):
    r"""The suite's ``walker run`` (``speed=8``), ``walk`` (1) and ``stand`` (0): upright, and as fast as ``speed``.

    .. math:: \tfrac{1}{4} (3\, h + \tfrac{1 + \cos\theta}{2}) \cdot \tfrac{1}{6} (5\, v + 1)

    with :math:`h` 1 from 1.2 m of the body's height and a Gaussian below, :math:`\theta` its angle to the vertical, and
    :math:`v` the speed of the centre of mass along x over ``speed``, within 0 and 1 (the second factor 1 for 0).
    """

    def __init__(self, scene: Scene, body: str, *, speed: float = 8.0) -> None:
        super().__init__()
        if not 0 <= speed < math.inf:
            raise ValueError(f"speed must be a number of m/s from 0, got {speed}")
        self.bodies, self.velocity, self.speed = Bodies(scene, [body]), CenterOfMassVelocity(scene, body), float(speed)
        self.shown = {"scene": scene.name, "body": body, "speed": self.speed}

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        position, orientation = self.bodies.pose(next_state)
        low = (_STAND_HEIGHT - position[..., 2]).clamp(min=0.0) / (_STAND_HEIGHT / 2)
        standing = torch.exp(math.log(_EDGE) * low.square())
        stand = (3 * standing + (1 + quaternion.to_matrix(orientation)[..., 8]) / 2) / 4
        if self.speed == 0:
            return stand
        # Half of the reward at half of the speed, none at rest: the suite's linear tolerance.
        moving = (self.velocity(next_state)[..., :1] / self.speed).clamp(0.0, 1.0)
        return stand * (5 * moving + 1) / 6
