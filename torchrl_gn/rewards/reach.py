"""Move a body towards a target."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene

_REACHED = 1e-9  # metres


class Reach(Reward):
    r"""Progress of a body towards a target in the horizontal plane, metres.

    .. math:: r = d \cdot u - c\, (d \cdot u_\perp)^2

    with :math:`d` the body's displacement in this step, :math:`u` the horizontal unit vector to the target when
    planning started, and :math:`c` the ``shaping``, 1/m (paper, SM "Planning configuration", Swimmer "Move towards
    target"). The target is a location ``[3]``, metres, world frame, height ignored; the task is :math:`u`, ``[3]``,
    zero within a nanometre of the target.
    """

    target_shape = (3,)

    def __init__(self, scene: Scene, body: str, *, shaping: float = 0.01):
        super().__init__()
        if not 0 <= shaping < math.inf:
            raise ValueError(f"shaping must be a finite number from 0, got {shaping}")
        self.bodies, self.shaping = Bodies(scene, [body]), float(shaping)

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        """Direction ``[*B, 3]`` from the body in ``state`` to the target ``[*B, 3]``."""
        location = super().task_of(state, target).to(state.dtype)
        to_target = (location - self.bodies.position(state).squeeze(-2))[..., :2]
        # Divide by the largest entry first, so that squares neither overflow nor vanish.
        largest = to_target.abs().amax(-1, keepdim=True)
        reached = largest < _REACHED
        scaled = torch.where(
            reached, torch.ones_like(to_target), to_target / torch.where(reached, torch.ones_like(largest), largest)
        )
        direction = torch.where(reached, torch.zeros_like(to_target), scaled / scaled.norm(dim=-1, keepdim=True))
        return torch.cat((direction, torch.zeros_like(largest)), dim=-1)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        x, y, _ = self.require_task(task, next_state).split(1, dim=-1)
        displacement = (self.bodies.position(next_state) - self.bodies.position(state)).squeeze(-2)
        dx, dy, _ = displacement.split(1, dim=-1)
        return dx * x + dy * y - self.shaping * (dy * x - dx * y).square()

    def extra_repr(self) -> str:
        return f"scene={self.bodies.scene_name!r}, body={self.bodies.names[0]!r}, shaping={self.shaping:g}"
