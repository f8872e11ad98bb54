"""Projection of predicted changes onto the joint constraints, in maximal coordinates."""

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
    """Projection of predicted changes onto the constraints of hinges and balls.

    The network predicts each body on its own, but a joint anchor has one position and one velocity on both bodies that
    it joins. Among the changes that keep the anchors together, the projection takes the one nearest to the prediction,
    in standard deviations of each component. It makes one Gauss-Newton step in the orientations and angular velocities.
    Positions and velocities relative to a joined group follow from the joints. A group as a whole takes the mean
    position and velocity of its bodies, or the root's if the root cannot move.

    Paper: bodies are predicted separately and drift apart.
    """

    parent: Tensor
    accumulate: Tensor
    relative: Tensor
    rotating: Tensor
    scatter: Tensor
    movable: Tensor
    used_offsets: Tensor
    moved_rows: Tensor
    offset_jacobian: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        joints, count = scene.joint_anchors, scene.num_nodes
        group = joints.root[:, None] == joints.root
        mean, root = group / group.sum(1, keepdims=True), np.eye(count)[joints.root]
        root_moves = scene.movable[joints.root, :3]
        # Position of a joined group as a whole: the mean of its bodies' predictions, or its root if that cannot move.
        whole = np.where(root_moves[:, None, :], mean[:, :, None], root[:, :, None])  # [N, N, 3]
        rotates = scene.movable[:, 9:12].ravel()
        values = {
            "parent": joints.parent,
            # These two act on the flattened coordinates of all bodies, [3 N].
            "accumulate": np.kron(joints.ancestors, np.eye(3)),
            "relative": np.eye(3 * count) - _each_coordinate(whole),
            "rotating": rotates.nonzero()[0],
            "scatter": np.eye(3 * count)[:, rotates],
            "movable": scene.movable[:, : BODY_STATE.delta_size],
        }
        self.constants(values)
        # Keep the non-zero rows and columns: planar scenes need under half.
        parts = (torch.as_tensor(part).double() for part in (joints.ancestors, mean, root_moves))
        jacobian = self._offset_jacobian(*parts)
        used = jacobian.any(2)
        self.constants({"used_offsets": used.any(1).nonzero().flatten(), "moved_rows": used.any(0).nonzero().flatten()})
        self.constants({"offset_jacobian": jacobian[self.used_offsets][:, self.moved_rows].flatten(1)})

    def forward(
        self, state: Tensor, matrices: Tensor, delta: Tensor, weight: Tensor, parameters: PhysicalParameters
    ) -> Tensor:
        """Return the nearest change that keeps the joint anchors together.

        Args:
            state: ``[*B, N, 13]``.
            matrices: ``[*B, N, 3, 3]`` rotation matrices of the state's orientations.
            delta: ``[*B, N, 12]`` predicted change.
            weight: ``[]`` :func:`position_weight`.
            parameters: physical parameters, of which the anchor offsets are read.

        Returns:
            ``[*B, N, 12]``, zero in fixed components; ``delta`` itself if it satisfies the constraints.
        """
        at, to = BODY_STATE.slices, BODY_STATE.delta_slices
        rotation, spin = delta[..., to["orientation"]], delta[..., to["angular_velocity"]]
        # Positions and velocities [*B, 2, 3 N].
        present = torch.stack((state[..., at["position"]], state[..., at["linear_velocity"]]), dim=-3).flatten(-2)
        change = torch.stack((delta[..., to["position"]], delta[..., to["linear_velocity"]]), dim=-3).flatten(-2)
        predicted, before = present + change, self.offsets(matrices, parameters)

        offsets, implied = self.forward_kinematics(state, before, rotation, spin)
        jacobian = self.jacobian(offsets)
        residual = self._residual(predicted, implied)[..., self.moved_rows].mT
        weighted = weight.to(state.dtype) * jacobian.mT
        normal = weighted @ jacobian + torch.eye(jacobian.shape[-1], dtype=state.dtype, device=state.device)
        # At least the identity: never singular.
        solved, _ = torch.linalg.solve_ex(normal, weighted @ residual)
        step = (self.scatter.to(state.dtype) @ solved).unflatten(-2, (-1, 3))  # [*B, N, 3, 2]
        rotation, spin = rotation + step[..., 0], spin + step[..., 1]

        _, implied = self.forward_kinematics(state, before, rotation, spin)
        position, velocity = (change - self._residual(predicted, implied)).unflatten(-1, (-1, 3)).unbind(-3)
        return torch.cat((position, rotation, velocity, spin), dim=-1) * self.movable

    def offsets(self, matrices: Tensor, parameters: PhysicalParameters) -> Tensor:
        """Return each joint anchor's offsets from its parent and its child, ``[*B, 2, N, 3]``, in the world frame."""
        # One of the two may have a batch without the other.
        anchors = torch.broadcast_tensors(parameters.parent_anchor, parameters.child_anchor)
        offsets = torch.stack(anchors, dim=-3).to(matrices.dtype)
        both = torch.stack((matrices[..., self.parent, :, :], matrices), dim=-4)
        return (both @ offsets.unsqueeze(-1)).squeeze(-1)

    def jacobian(self, offsets: Tensor) -> Tensor:
        """Return ``[*B, R, L]``: derivative of body positions relative to their group by the ``L`` movable rotations.

        It is linear in the anchor offsets ``[*B, 2, N, 3]``. Rotations move ``R`` of the ``3 N`` coordinates.
        """
        used = offsets.flatten(-3)[..., self.used_offsets]
        return (used @ self.offset_jacobian.to(offsets.dtype)).unflatten(-1, (-1, len(self.rotating)))

    def forward_kinematics(
        self, state: Tensor, offsets: Tensor, rotation: Tensor, spin: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return anchor offsets after rotation vectors and changes of angular velocity (``spin``), both ``[*B, N, 3]``.

        Also returns the positions and velocities ``[*B, 2, 3 N]``, relative to each group's root, that the joints then
        imply.
        """
        angular = state[..., BODY_STATE.slices["angular_velocity"]] + spin
        both = torch.cat((rotation, angular), dim=-1)
        rotation, angular = torch.stack((both[..., self.parent, :], both), dim=-3).split(3, dim=-1)
        offsets = quaternion.rotate_by(rotation, offsets)
        return offsets, self._accumulated(torch.stack((offsets, torch.linalg.cross(angular, offsets)), dim=-4))

    def _accumulated(self, parts: Tensor) -> Tensor:
        """Sum parent less child parts ``[*B, 2, N, 3]`` over each node's ancestors, to ``[*B, 3 N]``."""
        parent, child = parts.unbind(-3)
        return F.linear((parent - child).flatten(-2), self.accumulate.to(parts.dtype))

    def _residual(self, predicted: Tensor, implied: Tensor) -> Tensor:
        """Return predicted less implied positions or velocities ``[*B, 3 N]``, relative to their group as a whole."""
        return F.linear(predicted - implied, self.relative.to(predicted.dtype))

    def _offset_jacobian(self, ancestors: Tensor, mean: Tensor, root_moves: Tensor) -> Tensor:
        """Return ``[6 N, 3 N, L]``: the :meth:`jacobian` of all coordinates, for each unit anchor offset."""
        count = len(self.parent)
        upper, lower = torch.eye(6 * count, dtype=torch.float64).view(-1, 2, count, 3).unbind(1)
        upper, lower = _cross(upper).unsqueeze(-3), _cross(lower).unsqueeze(-3)  # [6 N, N, 1, 3, 3]
        parents, identity = F.one_hot(self.parent, count).double(), torch.eye(count, dtype=torch.float64)
        # Each anchor j among node i's ancestors adds: parent's spin x parent offset less own spin x child offset.
        each = identity[..., None, None] * lower - parents[..., None, None] * upper
        bodies = torch.einsum("ij,...jkab->...iakb", ancestors, each)
        means = torch.einsum("ij,...jakb->...iakb", mean, bodies)
        bodies = bodies - root_moves[:, :, None, None] * means
        return bodies.flatten(-2).flatten(-3, -2)[..., self.rotating]


def position_weight(std: Tensor) -> Tensor:
    """Return the weight ``[]`` of a squared metre against a squared radian, from a change's ``[12]`` deviations."""
    return std[9:].square().sum() / std[6:9].square().sum().clamp(min=1e-30)


def _each_coordinate(matrices: np.ndarray) -> np.ndarray:
    """Return the matrix ``[3 N, 3 N]`` that acts on each coordinate with its own matrix of ``[N, N, 3]``."""
    count = len(matrices)
    return np.einsum("ijc,cd->icjd", matrices, np.eye(3)).reshape(3 * count, 3 * count)


def _cross(v: Tensor) -> Tensor:
    """Return the matrices ``[..., 3, 3]`` of the cross product with vectors ``[..., 3]``."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), -1).unflatten(-1, (3, 3))
