"""Projection of predicted changes onto generalised coordinates: joint angles and rates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.dynamics.constraints.maximal_coordinates import MaximalProjection
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.invariance import locked_dofs
from torchrl_gn.scenes.physical_parameters import joint_axes

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


def make_projection(scene: Scene) -> MaximalProjection:
    """Make a scene's projection: in generalised coordinates if they are fewer than the bodies' movable rotations."""
    fewer = len(_dofs(scene)) < np.count_nonzero(scene.movable[:, 9:12])
    return GeneralizedProjection(scene) if fewer else MaximalProjection(scene)


class GeneralizedProjection(MaximalProjection):
    """Projection of predicted changes onto the joints' angles and rates.

    For bodies that rotate about fewer than three axes (an arm of hinges). Finds the change of the joint angles, then
    the joint rates, nearest to the changes predicted for the bodies, so motion that a hinge cannot make does not build
    up. In planar scenes it equals the projection in maximal coordinates, which is faster there.
    """

    dof_node: Tensor
    dof_frame: Tensor
    dof_edge: Tensor
    hinged: Tensor
    own_axis: Tensor
    subtree: Tensor
    first: Tensor
    second: Tensor
    is_root: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        count, joints = scene.num_nodes, scene.joint_anchors
        node, frame, edge, axis, stage = (np.array(column) for column in zip(*_dofs(scene), strict=True))
        # Nodes that a degree of freedom rotates: its own and its descendants.
        below = (joints.ancestors + np.eye(count)) > 0
        subtree = np.where(node == joints.root[node], joints.root[:, None] == node, below[:, node])
        owns = np.eye(count)[:, node]
        values = {
            "dof_node": node,
            "dof_frame": frame,
            "dof_edge": np.maximum(edge, 0),
            "hinged": (edge >= 0)[:, None],
            "own_axis": axis.astype(float).reshape(-1, 3),
            "subtree": subtree.astype(float),
            "first": owns * (stage == 0),
            "second": owns * (stage == 1),
            "is_root": (joints.parent == np.arange(count))[:, None],
        }
        self.constants(values)
        # Parents come before their children, as in MuJoCo's trees.
        self._order = [(int(n), int(joints.parent[n])) for n in range(count) if joints.parent[n] != n]
        self._two_stages = bool((stage == 1).any())

    def forward(
        self, state: Tensor, matrices: Tensor, delta: Tensor, weight: Tensor, parameters: PhysicalParameters
    ) -> Tensor:
        """Return the nearest change that joint angles and rates can make, see :meth:`MaximalProjection.forward`."""
        at, to = BODY_STATE.slices, BODY_STATE.delta_slices
        weight = weight.to(state.dtype)
        position = state[..., at["position"]] + delta[..., to["position"]]
        velocity = state[..., at["linear_velocity"]] + delta[..., to["linear_velocity"]]
        angular = state[..., at["angular_velocity"]] + delta[..., to["angular_velocity"]]
        axes, offsets = self._axes(matrices, parameters), self.offsets(matrices, parameters)

        # Angles: from the relative rotation of each pair of bodies, then one Gauss-Newton step of all.
        predicted = quaternion.exp(delta[..., to["orientation"]])
        identity = pad(torch.ones_like(predicted[..., :1]), (0, 3))
        against = torch.where(self.is_root, identity, predicted[..., self.parent, :])
        relative = quaternion.log(quaternion.product(quaternion.conjugate(against), predicted))
        angles = (axes * relative[..., self.dof_node, :]).sum(-1)
        rotation = self._compose(axes, angles)
        rotated = self._rotate(rotation, axes, offsets)
        missing = quaternion.log(quaternion.product(predicted, quaternion.conjugate(rotation)))
        residual = self._residual(position.flatten(-2), self._accumulated(rotated[1]))
        angles = angles + self._solve(*rotated, missing, residual, weight)
        rotation = self._compose(axes, angles)
        axes, offsets = self._rotate(rotation, axes, offsets)
        residual = self._residual(position.flatten(-2), self._accumulated(offsets))
        moved = position - residual.view_as(position) - state[..., at["position"]]

        # Rates: linear, at the joints' new angles.
        flat = velocity.flatten(-2)
        rates = self._solve(axes, offsets, angular, self._residual(flat, torch.zeros_like(flat)), weight)
        angular = (self._rotation_jacobian(axes) @ rates.unsqueeze(-1)).squeeze(-1).unflatten(-1, (-1, 3))
        both = torch.stack((angular[..., self.parent, :], angular), dim=-3)
        implied = self._accumulated(torch.linalg.cross(both, offsets))
        linear = velocity - self._residual(flat, implied).view_as(velocity) - state[..., at["linear_velocity"]]
        angular = angular - state[..., at["angular_velocity"]]
        return torch.cat((moved, quaternion.log(rotation), linear, angular), dim=-1) * self.movable

    def _axes(self, matrices: Tensor, parameters: PhysicalParameters) -> Tensor:
        """Return the axes ``[*B, K, 3]`` of all degrees of freedom in the world frame."""
        axis = torch.where(self.hinged, parameters.joint_axis[..., self.dof_edge, :], self.own_axis).to(matrices.dtype)
        rotated = (matrices[..., self.dof_frame, :, :] @ axis.unsqueeze(-1)).squeeze(-1)
        return torch.where(self.hinged, rotated, axis)

    def _rotate(self, rotation: Tensor, axes: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Return axes and anchor offsets after rotations ``[*B, N, 4]`` of the bodies."""
        rotated = quaternion.rotate(rotation[..., self.dof_frame, :], axes)
        both = torch.stack((rotation[..., self.parent, :], rotation), dim=-3)
        return torch.where(self.hinged, rotated, axes), quaternion.rotate(both, offsets)

    def _compose(self, axes: Tensor, angles: Tensor) -> Tensor:
        """Return the rotation ``[*B, N, 4]`` of every body for joint angles ``[*B, K]``."""
        vectors = axes * angles.unsqueeze(-1)
        rotations = quaternion.exp(self.first.to(axes.dtype) @ vectors)
        if self._two_stages:
            rotations = quaternion.product(rotations, quaternion.exp(self.second.to(axes.dtype) @ vectors))
        # One product a body: p * q is linear in p.
        rotation, after = list(rotations.unsqueeze(-1).unbind(-3)), quaternion.right_matrix(rotations).unbind(-3)
        for node, parent in self._order:
            rotation[node] = after[node] @ rotation[parent]
        return torch.stack(rotation, dim=-3).squeeze(-1)

    def _rotation_jacobian(self, axes: Tensor) -> Tensor:
        """Return ``[*B, 3 N, K]``: derivative of all bodies' angular velocities by the joint rates."""
        return (self.subtree.to(axes.dtype).unsqueeze(-2) * axes.mT.unsqueeze(-3)).flatten(-3, -2)

    def _solve(self, axes: Tensor, offsets: Tensor, rotations: Tensor, residual: Tensor, weight: Tensor) -> Tensor:
        """Return least-squares rates ``[*B, K]`` for body rotations ``[*B, N, 3]`` and positions ``[*B, 3 N]``."""
        rotating = self._rotation_jacobian(axes)
        moving = self.jacobian(offsets) @ rotating[..., self.rotating, :]
        weighted = torch.cat((rotating.mT, weight * moving.mT), dim=-1)
        normal = rotating.mT @ rotating + weight * (moving.mT @ moving)
        # The equations do not tell two parallel hinges at one point apart: regularise, above rounding.
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        damping = (16 * torch.finfo(normal.dtype).eps * diagonal.amax(-1, keepdim=True)).clamp(min=1e-12)
        normal = normal + torch.diag_embed(damping.expand_as(diagonal))
        targets = torch.cat((rotations.flatten(-2), residual[..., self.moved_rows]), dim=-1).unsqueeze(-1)
        return torch.linalg.solve_ex(normal, weighted @ targets)[0].squeeze(-1)


def _dofs(scene: Scene) -> list[tuple[int, int, int, np.ndarray, int]]:
    """List the rotational degrees of freedom of a scene's bodies.

    Each has its node, the node that the axis is fixed to, the hinge's edge (-1 without), the axis in the world where
    there is no hinge, and the hinge's index on its body.
    """
    model, joints, locked = scene.model, scene.joint_anchors, locked_dofs(scene.model)
    frames, _ = joint_axes(scene)
    dofs: list[tuple[int, int, int, np.ndarray, int]] = []
    for node in range(scene.num_nodes):
        free = scene.movable[node, 9:12].nonzero()[0]
        if joints.parent[node] != node:
            body = int(scene.body[node])
            body_joints = model.body_jntadr[body] + np.arange(model.body_jntnum[body])
            if (model.jnt_type[body_joints] == int(mujoco.mjtJoint.mjJNT_HINGE)).all() and len(body_joints) <= 2:
                turning = [(stage, int(j)) for stage, j in enumerate(body_joints) if not locked[model.jnt_dofadr[j]]]
                dofs += [(node, int(frames[j]), 2 * j, np.zeros(3), stage) for stage, j in turning]
                continue
            free = np.arange(3)  # a ball, or more hinges than can be told apart
        dofs += [(node, 0, -1, np.eye(3)[axis], 0) for axis in free]
    return dofs
