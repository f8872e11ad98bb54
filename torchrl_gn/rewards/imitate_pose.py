"""Bring bodies to their poses in a target state."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.rewards.arm_reach import arm_reach
from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene

_SLACK = 1e-3  # of the longest reach: targets are rounded, measured or predicted


class ImitatePose(Reward):
    r"""Negative squared distance of bodies from their poses in a target state.

    .. math:: r = -\sum_i |x_i' - \hat x_i|^2 + 1 - (q_i' \cdot \hat q_i)^2

    with positions :math:`x'` in metres and orientations :math:`q'` after the step: 0 when every body is there. The
    second part is :math:`\sin^2` of half the angle between the orientations, whatever the signs of the quaternions;
    it is computed as the squared vector part of :math:`\bar q' \hat q`, exact for close orientations. Gradients are
    finite everywhere. (Paper, SM "Planning configuration", Jaco "Imitate Palm Pose" and "Imitate Full Pose", and SM
    "Loss" for the dynamic-state loss.)

    Paper: the paper's loss compares normalised changes. Here there is no normaliser, so that the reward needs no model:
    a metre counts as much as half a rotation. No velocities are compared, as in the paper's table (the figure's
    caption speaks of 13 variables). The paper prints :math:`\cos^2(q \cdot \hat q)`; the dot product is the cosine.

    Target and task are a state of the scene ``[N, 13]``; only the bodies' positions and orientations are read. Targets
    out of a body's :func:`arm_reach` are refused.

    Args:
        scene: scene whose states are judged.
        bodies: names of the bodies, summed over.

    Raises:
        ValueError: the scene has no such body, or ``bodies`` is no list of different names.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> ImitatePose(load_scene("jaco"), ["jaco_hand/hand"])
        ImitatePose(scene='jaco', bodies=('jaco_hand/hand',))
    """

    base: Tensor
    reach: Tensor

    def __init__(self, scene: Scene, bodies: Sequence[str]):
        super().__init__()
        self.bodies = Bodies(scene, bodies)
        self.target_shape = (scene.num_nodes, 13)
        base, reach = zip(*(arm_reach(scene, name) for name in bodies), strict=True)
        spans = [arm_reach(scene, name)[1] for name in scene.node_names]
        self.slack = _SLACK * max(span for span in spans if span < float("inf"))
        self.register_buffer("base", torch.stack([torch.as_tensor(point) for point in base]), persistent=False)
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64), persistent=False)

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        """The target ``[*B, N, 13]`` itself; see :meth:`Reward.task_of`.

        Raises:
            ValueError: the target has a wrong shape, is not finite, or gives a body a quaternion of norm zero or a
                position out of reach.
        """
        task = super().task_of(state, target)
        if not bool((self.bodies.orientation(task).norm(dim=-1) > 0).all()):
            raise ValueError(
                f"the target of ImitatePose must hold quaternions of non-zero norm for {self.bodies.names}"
            )
        distance = (self.bodies.position(task) - self.base).norm(dim=-1)
        beyond = (distance > self.reach + self.slack).nonzero()
        if len(beyond):
            *batch, k = beyond[0].tolist()
            where = f" at index {tuple(batch)}" if batch else ""
            raise ValueError(
                f"the target of ImitatePose{where} puts {self.bodies.names[k]!r} {distance[(*batch, k)]:.4g} m from the"
                f" base of scene {self.bodies.scene_name!r}, whose links reach {self.reach[k]:.4g} m; take a"
                " target from a state of this scene, in metres"
            )
        return task

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        """Reward ``[*B, 1]``; see :class:`Reward`. Reads ``next_state`` and the task ``[*B, N, 13]``."""
        target = self.require_task(task, next_state)
        away = self.bodies.position(next_state) - self.bodies.position(target)
        wanted = quaternion.normalize(self.bodies.orientation(target))
        rotated = quaternion.product(quaternion.conjugate(self.bodies.orientation(next_state)), wanted)[..., 1:]
        return -torch.cat((away, rotated), dim=-1).square().sum(-1).sum(-1, keepdim=True)

    def extra_repr(self) -> str:
        return f"scene={self.bodies.scene_name!r}, bodies={self.bodies.names}"
