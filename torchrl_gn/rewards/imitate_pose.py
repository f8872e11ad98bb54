"""Reward for bringing bodies to their poses in a target state."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.rewards.bodies import Bodies, find_body
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene

_SLACK = 1e-3  # share of the longest reach; targets may be rounded, measured or predicted


def arm_reach(scene: Scene, body: str) -> tuple[np.ndarray, float]:
    """Return the centre ``[3]`` and radius, metres, of a ball that a body cannot leave; ignores joint limits.

    The centre is the world position of the first joint's anchor. The radius is the sum of the links' lengths; it is
    infinite if a joint between body and world slides or is free, or if the joints of one body have different anchors.
    """
    arm_body, joint_anchors = find_body(scene, body), scene.joint_anchors
    node, point, length = arm_body.node, arm_body.pos, 0.0
    if joint_anchors.root[node] != 0:
        return np.zeros(3), math.inf
    while node:
        length += float(np.linalg.norm(point - joint_anchors.child_anchor[node]))
        node, point = int(joint_anchors.parent[node]), joint_anchors.parent_anchor[node]
    return point, length


class ImitatePose(Reward):
    r"""Negative squared distance of bodies from their poses in a target state; rejects targets out of reach.

    .. math:: r = -\sum_i |x_i' - \hat x_i|^2 + 1 - (q_i' \cdot \hat q_i)^2

    with positions :math:`x'` in metres and orientations :math:`q'` after the step; the second part is :math:`\sin^2` of
    half the angle between the orientations (paper, SM "Planning configuration", Jaco "Imitate Palm Pose" and "Imitate
    Full Pose"). Target and task are a state ``[N, 13]``, which holds the bodies' target poses.

    The paper's loss compares normalised changes. Here a metre counts as much as a half turn, so no model's normalisers
    are needed. The paper prints :math:`\cos^2(q \cdot \hat q)`, but the dot product already is the cosine.
    """

    base: Tensor
    reach: Tensor

    def __init__(self, scene: Scene, bodies: Sequence[str]):
        super().__init__()
        self.bodies = Bodies(scene, bodies)
        self.shown = {"scene": scene.name, "bodies": tuple(bodies)}
        self.target_shape = (scene.num_nodes, 13)
        base, reach = zip(*(arm_reach(scene, name) for name in bodies), strict=True)
        spans = [arm_reach(scene, name)[1] for name in scene.node_names]
        self.slack = _SLACK * max(span for span in spans if span < math.inf)
        self.register_buffer("base", torch.stack([torch.as_tensor(point) for point in base]), persistent=False)
        self.register_buffer("reach", torch.tensor(reach, dtype=torch.float64), persistent=False)

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        """Return the target ``[*B, N, 13]``; ValueError also for quaternions of zero norm or positions out of reach."""
        task = super().task_of(state, target)
        names = self.bodies.names
        if not bool((self.bodies.orientation(task).norm(dim=-1) > 0).all()):
            raise ValueError(f"the target of ImitatePose must hold quaternions of non-zero norm for {names}")
        distance = (self.bodies.position(task) - self.base).norm(dim=-1)
        beyond = (distance > self.reach + self.slack).nonzero()
        if len(beyond):
            *batch, k = beyond[0].tolist()
            where = f" at index {tuple(batch)}" if batch else ""
            raise ValueError(
                f"the target of ImitatePose{where} puts {names[k]!r} {distance[(*batch, k)]:.4g} m from the"
                f" base of scene {self.bodies.scene_name!r}, whose links reach {self.reach[k]:.4g} m; take a"
                " target from a state of this scene, in metres"
            )
        return task

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        position, orientation = self.bodies.pose(next_state)
        to, target = self.bodies.pose(self.require_task(task, next_state))
        # Conjugate the constant target, not the state: fewer operations are differentiated.
        back = quaternion.conjugate(quaternion.normalize(target))
        rotated = quaternion.product(back, orientation)[..., 1:]
        return -torch.cat((position - to, rotated), dim=-1).square().sum((-2, -1)).unsqueeze(-1)
