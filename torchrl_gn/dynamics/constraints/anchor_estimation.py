"""Where joints joint anchor bodies together, found from how the bodies move."""

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

# Variance of rounding over the variance of arms that nothing is known of: states may have come as float32.
_FLOOR = 1e-12


class AnchorEstimator(Float64Buffers):
    """Find the joint anchors of a scene's variants, whose lengths are hidden, by least squares.

    A joint anchor is at one place on both bodies that it joins, ``x + R a = x' + R' a'`` in every state, and that is linear in
    the arms ``a`` and ``a'``. States whose joints turn tell both; what they leave open (along the axis of a hinge, or
    where a joint did not turn) stays as in the standard scene. How much that is trusted follows from how badly one
    joint anchor explains all states: of noisy ones less is believed. No gradient flows through what is found.

    Paper: bodies are not linked.

    Args:
        scene: the standard scene, whose variants share which bodies are joined.
    """

    parent: Tensor
    usual: Tensor
    off: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        joint_anchors = scene.joint_anchors
        values = {
            "parent": joint_anchors.parent,
            "usual": np.concatenate((joint_anchors.parent_anchor, joint_anchors.child_anchor), axis=1),
            "off": np.array(joint_anchors.anchor_scale),  # metres that arms may be off by
        }
        self.constants(values)

    @torch.no_grad()
    def sums(self, states: Tensor) -> Tensor:
        """All that states tell about pins: add these up over observations of one system.

        Args:
            states: ``[*B, T, N, 13]``.

        Returns:
            ``[*B, N, 7, 7]``, products of the equations' coefficients, in float64.
        """
        at = BODY_STATE.slices
        place = states[..., at["position"]].double()
        turned = quaternion.to_matrix(states[..., at["orientation"]].double()).unflatten(-1, (3, 3))
        apart = place - place[..., self.parent, :]
        rows = torch.cat((turned[..., self.parent, :, :], -turned, apart.unsqueeze(-1)), dim=-1)  # [*B, T, N, 3, 7]
        rows = rows.transpose(-4, -3).flatten(-3, -2)  # [*B, N, 3 T, 7]
        return rows.mT @ rows

    @torch.no_grad()
    def solve(self, sums: Tensor) -> tuple[Tensor, Tensor]:
        """Arms from parent and node to each joint anchor, ``[*B, N, 3]`` in metres, as a scene's joint_anchors has them.

        Args:
            sums: ``[*B, N, 7, 7]``, from at least one state.
        """
        usual = self.usual.expand(*sums.shape[:-2], 6).unsqueeze(-1)
        count = sums[..., 0, 0, None, None]  # states: the columns of a rotation have length 1
        # Equations for what is off from the usual arms, per state.
        normal, missing = sums[..., :6, :6] / count, sums[..., :6, 6:] / count
        pull = missing - normal @ usual
        square = sums[..., 6:, 6:] / count - 2 * usual.mT @ missing + usual.mT @ normal @ usual

        unit = torch.eye(6, dtype=normal.dtype, device=normal.device)

        def correction(trust: Tensor) -> Tensor:
            # Positive definite for any trust above 0: never singular.
            return torch.linalg.solve_ex(normal + trust * unit, pull)[0]

        floor = torch.full_like(square, _FLOOR)
        first = correction(floor)
        left = (square - 2 * first.mT @ pull + first.mT @ normal @ first).clamp(min=0)  # squared metres, of 3 rows
        anchors = usual + correction(floor + left / (3 * count * self.off**2))
        parent_anchor, child_anchor = anchors.squeeze(-1).split(3, dim=-1)
        return parent_anchor, child_anchor
