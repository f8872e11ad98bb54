"""Predicted changes that keep bodies together where joints joint anchor them together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import BODY_STATE

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class MaximalProjection(Float64Buffers):
    """Settle what is predicted for bodies that are joined together.

    The network predicts every body on its own, but a joint anchor is at one place, and moves at one speed,
    on both bodies that it joins. Of all changes that keep every joint anchor together the nearest
    to the prediction is taken, in units of how much each component varies: one Gauss-Newton step of
    least squares on orientations and angular velocities. Positions and velocities follow from the
    joints exactly, but for those of each joint_anchors as a whole, which are the mean of its bodies' (or
    stay the root's where it cannot move).

    Paper: bodies are predicted alone and drift apart.

    Args:
        scene: whose joints these are (:attr:`Scene.joint_anchors <torchrl_gn.scenes.Scene>`).
    """

    parent: Tensor
    sums: Tensor
    apart: Tensor
    turning: Tensor
    lever_arms: Tensor
    placed: Tensor
    levers: Tensor
    spread: Tensor
    movable: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        joint_anchors = scene.joint_anchors
        together = joint_anchors.root[:, None] == joint_anchors.root
        mean, root = together / together.sum(1, keepdims=True), np.eye(scene.num_nodes)[joint_anchors.root]
        root_moves = scene.movable[joint_anchors.root, :3]
        # Where a joint_anchors as a whole is: the mean opinion of its bodies, or its root's where that cannot move.
        whole = np.where(root_moves[:, None, :], mean[:, :, None], root[:, :, None])  # [N, N, 3]
        values = {
            "parent": joint_anchors.parent,
            # Both act on all coordinates of all bodies in a row, [3 N].
            "sums": np.kron(joint_anchors.ancestors, np.eye(3)),
            "apart": np.eye(3 * scene.num_nodes) - _each_coordinate(whole),
            "turning": scene.movable[:, 9:].ravel().nonzero()[0],
            "spread": np.eye(3 * scene.num_nodes)[:, scene.movable[:, 9:].ravel()],
            "movable": scene.movable,
        }
        self.constants(values)
        # Of all arms and places those that turning can move: in the plane less than half of the products.
        levers = self._levers(*(torch.as_tensor(part).double() for part in (joint_anchors.ancestors, mean, root_moves)))
        used = levers.any(2)
        self.constants({"lever_arms": used.any(1).nonzero().flatten(), "placed": used.any(0).nonzero().flatten()})
        self.constants({"levers": levers[self.lever_arms][:, self.placed].flatten(1)})

    def forward(
        self, state: Tensor, matrices: Tensor, delta: Tensor, std: Tensor, values: PhysicalParameters
    ) -> Tensor:
        """The nearest change that keeps joint anchors together.

        Args:
            state: ``[*B, N, 13]``.
            matrices: ``[*B, N, 3, 3]`` of the orientations in it.
            delta: ``[*B, N, 12]`` predicted change.
            std: ``[12]`` how much each channel of a change varies.
            values: numbers of the scene; read are where the joint anchors are.

        Returns:
            ``[*B, N, 12]``, zero in fixed components; ``delta`` itself where nothing is apart.
        """
        at, to = BODY_STATE.slices, BODY_STATE.delta_slices
        turn, spin = delta[..., to["orientation"]], delta[..., to["angular_velocity"]]
        # Positions and velocities [*B, 2, 3 N].
        here = torch.stack((state[..., at["position"]], state[..., at["linear_velocity"]]), dim=-3).flatten(-2)
        change = torch.stack((delta[..., to["position"]], delta[..., to["linear_velocity"]]), dim=-3).flatten(-2)
        moved, before = here + change, self.anchors(matrices, values)

        anchors, along = self.pins(state, before, turn, spin)
        moves = self.moves(anchors)
        misses = self._gap(moved, along)[..., self.placed].mT
        ratio = position_weight(std).to(state.dtype)
        pull = ratio * moves.mT
        normal = pull @ moves + torch.eye(moves.shape[-1], dtype=state.dtype, device=state.device)
        # At least the identity: never singular, so nothing needs to be checked.
        solved, _ = torch.linalg.solve_ex(normal, pull @ misses)
        better = (self.spread.to(state.dtype) @ solved).unflatten(-2, (-1, 3))  # [*B, N, 3, 2]
        turn, spin = turn + better[..., 0], spin + better[..., 1]

        _, along = self.pins(state, before, turn, spin)
        shift, push = (change - self._gap(moved, along)).unflatten(-1, (-1, 3)).unbind(-3)
        return torch.cat((shift, turn, push, spin), dim=-1) * self.movable

    def anchors(self, matrices: Tensor, values: PhysicalParameters) -> Tensor:
        """From each joint anchor's upper and lower body to it, ``[*B, 2, N, 3]``, in the world frame."""
        anchors = torch.stack((values.parent_anchor, values.child_anchor), dim=-3).to(matrices.dtype)
        both = torch.stack((matrices[..., self.parent, :, :], matrices), dim=-4)
        return (both @ anchors.unsqueeze(-1)).squeeze(-1)

    def moves(self, anchors: Tensor) -> Tensor:
        """``[*B, R, L]``: how turning moves bodies relative to their joint_anchors as a whole, linear in the arms.

        Args:
            arms: ``[*B, 2, N, 3]``.

        Returns:
            For the ``R`` of the ``3 N`` coordinates that turning moves (``placed``).
        """
        used = anchors.flatten(-3)[..., self.lever_arms]
        return (used @ self.levers.to(anchors.dtype)).unflatten(-1, (-1, len(self.turning)))

    def pins(self, state: Tensor, anchors: Tensor, turn: Tensor, spin: Tensor) -> tuple[Tensor, Tensor]:
        """Where joint anchors put the bodies after a change of orientations and angular velocities.

        Args:
            state: ``[*B, N, 13]``.
            arms: ``[*B, 2, N, 3]`` before the change.
            turn: ``[*B, N, 3]`` rotation vectors.
            spin: ``[*B, N, 3]`` changes of angular velocity.

        Returns:
            Arms after it, and places and speeds ``[*B, 2, 3 N]`` relative to each joint_anchors's root.
        """
        speed = state[..., BODY_STATE.slices["angular_velocity"]] + spin
        both = torch.cat((turn, speed), dim=-1)
        turn, speed = torch.stack((both[..., self.parent, :], both), dim=-3).split(3, dim=-1)
        anchors = quaternion.rotate_by(turn, anchors)
        return anchors, self._along(torch.stack((anchors, torch.linalg.cross(speed, anchors)), dim=-4))

    def _along(self, pins: Tensor) -> Tensor:
        """Sums ``[*B, 3 N]`` from each joint_anchors's root of what joint anchors ``[*B, 2, N, 3]`` add, upper less lower body."""
        upper, lower = pins.unbind(-3)
        return F.linear((upper - lower).flatten(-2), self.sums.to(pins.dtype))

    def _gap(self, moved: Tensor, along: Tensor) -> Tensor:
        """How far predicted places or speeds ``[*B, 3 N]`` are from where their linkages have them."""
        return F.linear(moved - along, self.apart.to(moved.dtype))  # the difference: opinions of the root's

    def _levers(self, ancestors: Tensor, mean: Tensor, root_moves: Tensor) -> Tensor:
        """``[6 N, 3 N, L]``: velocities of bodies about their joint_anchors's own for each movable angular velocity, by arm."""
        count = len(self.parent)
        upper, lower = torch.eye(6 * count, dtype=torch.float64).view(-1, 2, count, 3).unbind(1)
        upper, lower = _cross(upper).unsqueeze(-3), _cross(lower).unsqueeze(-3)  # [6 N, N, 1, 3, 3]
        parents, own = F.one_hot(self.parent, count).double(), torch.eye(count, dtype=torch.float64)
        # Node i moves with every joint anchor j on its way to the root: by parent's spin x upper less own spin x lower.
        pins = own[..., None, None] * lower - parents[..., None, None] * upper
        bodies = torch.einsum("ij,...jkab->...iakb", ancestors, pins)
        means = torch.einsum("ij,...jakb->...iakb", mean, bodies)
        bodies = bodies - root_moves[:, :, None, None] * means
        return bodies.flatten(-2).flatten(-3, -2)[..., self.turning]


def position_weight(std: Tensor) -> Tensor:
    """What a squared metre weighs against a squared radian."""
    return std[9:].square().sum() / std[6:9].square().sum().clamp(min=1e-30)


def _each_coordinate(matrices: np.ndarray) -> np.ndarray:
    """``[3 N, 3 N]`` that acts on each of three coordinates with its own of matrices ``[N, N, 3]``."""
    count = len(matrices)
    return np.einsum("ijc,cd->icjd", matrices, np.eye(3)).reshape(3 * count, 3 * count)


def _cross(v: Tensor) -> Tensor:
    """Matrices ``[..., 3, 3]`` of the cross product with vectors ``[..., 3]``."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), -1).unflatten(-1, (3, 3))
