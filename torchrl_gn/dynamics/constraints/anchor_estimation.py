"""Estimation of joint anchors from the motion of bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene

# Relative variance of rounding: states may have come as float32.
_FLOOR = 1e-12


class AnchorEstimator(Float64Buffers):
    """Least-squares estimator of anchor offsets, for variants of a scene whose lengths are hidden.

    Both bodies of a joint give its anchor the same position, ``x + R a = x' + R' a'``, an equation that is linear in
    the offsets ``a`` and ``a'``. Directions that the observed states do not determine (along a hinge's axis, or where a
    joint did not move) keep the standard scene's offsets. The prior's weight follows from the residual: noisy states
    count less. No gradient flows through the estimate.
    """

    parent: Tensor
    standard: Tensor
    scale: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        joints = scene.joint_anchors
        values = {
            "parent": joints.parent,
            "standard": np.concatenate((joints.parent_anchor, joints.child_anchor), axis=1),
            "scale": np.array(joints.anchor_scale),  # metres, standard deviation of the prior
        }
        self.constants(values)

    @torch.no_grad()
    def sums(self, states: Tensor) -> Tensor:
        """Return normal equations ``[*B, N, 7, 7]``, float64, of states ``[*B, T, N, 13]``; sum over observations."""
        at = BODY_STATE.slices
        position = states[..., at["position"]].double()
        rotation = quaternion.to_matrix(states[..., at["orientation"]].double()).unflatten(-1, (3, 3))
        difference = position - position[..., self.parent, :]
        rows = torch.cat((rotation[..., self.parent, :, :], -rotation, difference.unsqueeze(-1)), dim=-1)
        rows = rows.transpose(-4, -3).flatten(-3, -2)  # [*B, N, 3 T, 7]
        return rows.mT @ rows

    @torch.no_grad()
    def solve(self, sums: Tensor) -> tuple[Tensor, Tensor]:
        """Return parent and child anchor offsets, ``[*B, N, 3]`` each, metres, given :meth:`sums` of some states."""
        standard = self.standard.expand(*sums.shape[:-2], 6).unsqueeze(-1)
        count = sums[..., 0, 0, None, None]  # number of states: columns of a rotation have length 1
        # Equations of the difference from the standard offsets, per state.
        normal, right = sums[..., :6, :6] / count, sums[..., :6, 6:] / count
        gradient = right - normal @ standard
        square = sums[..., 6:, 6:] / count - 2 * standard.mT @ right + standard.mT @ normal @ standard

        unit = torch.eye(6, dtype=normal.dtype, device=normal.device)

        def correction(prior: Tensor) -> Tensor:
            # Positive definite for any prior above 0: never singular.
            return torch.linalg.solve_ex(normal + prior * unit, gradient)[0]

        floor = torch.full_like(square, _FLOOR)
        first = correction(floor)
        residual = (square - 2 * first.mT @ gradient + first.mT @ normal @ first).clamp(min=0)  # m^2, of 3 rows
        offsets = standard + correction(floor + residual / (3 * count * self.scale**2))
        parent_anchor, child_anchor = offsets.squeeze(-1).split(3, dim=-1)
        return parent_anchor, child_anchor
