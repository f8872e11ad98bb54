"""Move a body towards a target."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene

_THERE = 1e-9  # metres


class Reach(Reward):
    r"""Progress of a body towards a target in the horizontal plane.

    .. math:: r = d \cdot u - c\, (d \cdot u_\perp)^2

    with :math:`d` the displacement of the body in this step, metres, :math:`u` the horizontal unit vector to the target
    from the body's position when planning started, :math:`u_\perp` the horizontal direction across it, and :math:`c`
    the shaping (paper, SM "Planning configuration", Swimmer "Move towards target").

    The target is a location ``[3]`` in metres, world frame; its height is ignored. The task is :math:`u`, ``[3]`` with
    zero height. Within a nanometre of the target (horizontally) the task is zero, and so are rewards and gradients.

    Args:
        scene: scene whose states are judged.
        body: name of the body.
        shaping: the factor :math:`c` of the squared sideways displacement, 1/m.

    Raises:
        ValueError: the scene has no such body, or ``shaping`` is negative or not finite.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("swimmer6")
        >>> reward = Reach(scene, "head")
        >>> before = torch.zeros(scene.num_nodes, 13, dtype=torch.float64)
        >>> task = reward.task_of(before, torch.tensor([0.0, 5.0, 0.0]))
        >>> task.tolist()
        [0.0, 1.0, 0.0]
        >>> after = before.clone()
        >>> after[1, :2] = torch.tensor([1.0, 2.0])
        >>> reward(before, torch.zeros(5), after, task).tolist()
        [1.99]
    """

    target_shape = (3,)

    def __init__(self, scene: Scene, body: str, *, shaping: float = 0.01):
        super().__init__()
        if not 0 <= shaping < math.inf:
            raise ValueError(f"shaping must be a finite number from 0, got {shaping}")
        self.bodies, self.shaping = Bodies(scene, [body]), float(shaping)

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        """Direction ``[*B, 3]`` from the body in ``state`` to the target ``[*B, 3]``; see :meth:`Reward.task_of`."""
        location = super().task_of(state, target).to(state.dtype)
        way = (location - self.bodies.position(state).squeeze(-2))[..., :2]
        # Divide by the largest entry first, so that squares neither overflow nor vanish.
        largest = way.abs().amax(-1, keepdim=True)
        there = largest < _THERE
        scaled = torch.where(there, torch.ones_like(way), way / torch.where(there, torch.ones_like(largest), largest))
        direction = torch.where(there, torch.zeros_like(way), scaled / scaled.norm(dim=-1, keepdim=True))
        return torch.cat((direction, torch.zeros_like(largest)), dim=-1)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward ``[*B, 1]``, metres; see :class:`Reward`. Reads both states and the task ``[*B, 3]``."""
        x, y, _ = self.require_task(task, next_state).split(1, dim=-1)
        displacement = (self.bodies.position(next_state) - self.bodies.position(state)).squeeze(-2)
        dx, dy, _ = displacement.split(1, dim=-1)
        return dx * x + dy * y - self.shaping * (dy * x - dx * y).square()

    def extra_repr(self) -> str:
        return f"scene={self.bodies.scene_name!r}, body={self.bodies.names[0]!r}, shaping={self.shaping:g}"
