"""Lengths, rates and moments of tendons, fixed and spatial, from body states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.joint_coordinates import JointStates
from torchrl_gn.dynamics.joint_moments import LinePulls, LinesAtJoints
from torchrl_gn.dynamics.lines import Lines
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.tendons import is_fixed, tendon_coefficients


class TendonStates(Float64Buffers):
    """Lengths of tendons from body states, and their moments in ``slots`` ``[K]``, pairs of a tendon and a joint."""

    fixed: Tensor
    arms: Tensor
    is_fixed: Tensor
    to_tendons: Tensor
    to_slots: Tensor

    def __init__(self, scene: Scene, tendons: Sequence[int], slots: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        spatial = [tendon for tendon in tendons if not is_fixed(scene.model, tendon)]
        pulled = [(spatial.index(tendon), joint) for tendon, joint in slots if tendon in spatial]
        self.lines = LinesAtJoints(scene, Lines(scene, spatial), pulled) if spatial else None
        self.pulls = bool(pulled)
        coefficients = tendon_coefficients(scene.model)
        # Index of each spatial tendon among the lines, and of each of its slots among their moments.
        lines, moments = iter(range(len(spatial))), iter(range(len(pulled)))
        self.constants(
            {
                "fixed": coefficients[list(tendons)],
                "arms": np.array([coefficients[each] for each in slots], dtype=float),
                "is_fixed": np.array([tendon not in spatial for tendon in tendons]),
                "in_fixed": np.array([tendon not in spatial for tendon, _ in slots], dtype=bool),
                "to_tendons": np.array([next(lines) if tendon in spatial else 0 for tendon in tendons]),
                "to_slots": np.array(
                    [next(moments) if tendon in spatial else 0 for tendon, _ in slots], dtype=np.int64
                ),
            }
        )

    in_fixed: Tensor

    def forward(self, state: Tensor, matrices: Tensor, joints: JointStates) -> LinePulls:
        """Return lengths ``[*B, T]``, rates, and each slot's moment and vector, see :class:`JointMoments`."""
        fixed = self.fixed.to(state.dtype).mT
        length, velocity = joints.coordinate @ fixed, joints.rate @ fixed
        moment = self.arms.to(state.dtype).expand(*state.shape[:-2], -1)
        if self.lines is None:
            return LinePulls(length, velocity, moment, moment.new_zeros((*moment.shape, 6)))
        pulls = self.lines(state, matrices, joints)
        length, velocity = (
            torch.where(self.is_fixed, own, there[..., self.to_tendons])
            for own, there in ((length, pulls.length), (velocity, pulls.velocity))
        )
        if not self.pulls:  # spatial tendons that move no joint
            return LinePulls(length, velocity, moment, moment.new_zeros((*moment.shape, 6)))
        moment = torch.where(self.in_fixed, moment, pulls.moment[..., self.to_slots])
        vector = torch.where(self.in_fixed.unsqueeze(-1), 0.0, pulls.vector[..., self.to_slots, :])
        return LinePulls(length, velocity, moment, vector)
