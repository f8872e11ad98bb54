"""Predicted changes that turn bodies about their joints' axes alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.constraints.maximal_coordinates import MaximalProjection, position_weight
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.joint_axes import joint_axes

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


def make_projection(scene: Scene) -> MaximalProjection:
    """The projection that a scene needs: by joint rates where they are fewer than the rates of its bodies."""
    fewer = len(_dofs(scene)) < np.count_nonzero(scene.movable[:, 9:])
    return GeneralizedProjection(scene) if fewer else MaximalProjection(scene)


class GeneralizedProjection(MaximalProjection):
    """Settle predictions by the joints' own angles and rates.

    As :class:`~torchrl_gn.dynamics.constraints.maximal_coordinates.MaximalProjection`, for bodies that hinges let turn about fewer axes
    than space has (an arm of hinges about different axes): of all changes of the joint angles, and
    then of all joint rates, the nearest to what the network predicts for the bodies is taken. What a
    hinge cannot do cannot build up. In the plane both are the same, and the other is faster.

    Args:
        scene: whose joints these are.
    """

    dof_node: Tensor
    dof_carrier: Tensor
    dof_edge: Tensor
    hinged: Tensor
    own_axis: Tensor
    reach: Tensor
    first: Tensor
    second: Tensor
    is_root: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        dofs = _dofs(scene)
        count, joint_anchors = scene.num_nodes, scene.joint_anchors
        node, carrier, edge, axis, stage = (np.array(column) for column in zip(*dofs, strict=True))
        # Nodes that a degree of freedom turns: its own and all that hang on it.
        below = (joint_anchors.ancestors + np.eye(count)) > 0
        roots = node == joint_anchors.root[node]
        reach = np.where(roots, joint_anchors.root[:, None] == node, below[:, node])
        owns = np.eye(count)[:, node]
        values = {
            "dof_node": node,
            "dof_carrier": carrier,
            "dof_edge": np.maximum(edge, 0),
            "hinged": (edge >= 0)[:, None],
            "own_axis": axis.astype(float).reshape(-1, 3),
            "reach": reach.astype(float),
            "first": owns * (stage == 0),
            "second": owns * (stage == 1),
            "is_root": (joint_anchors.parent == np.arange(count))[:, None],
        }
        self.constants(values)
        # Parents come before their children, as in MuJoCo's trees.
        self._order = [(int(n), int(joint_anchors.parent[n])) for n in range(count) if joint_anchors.parent[n] != n]
        self._two_stages = bool((stage == 1).any())

    def forward(
        self, state: Tensor, matrices: Tensor, delta: Tensor, std: Tensor, values: PhysicalParameters
    ) -> Tensor:
        """The nearest change of joint angles and rates; arguments and result as of ``MaximalProjection``."""
        at, to = BODY_STATE.slices, BODY_STATE.delta_slices
        weight = position_weight(std).to(state.dtype)
        place = state[..., at["position"]] + delta[..., to["position"]]
        velocity = state[..., at["linear_velocity"]] + delta[..., to["linear_velocity"]]
        speed = state[..., at["angular_velocity"]] + delta[..., to["angular_velocity"]]
        axes, anchors = self._axes(matrices, values), self.anchors(matrices, values)

        # Angles: what each pair of bodies says about its joint, then one Gauss-Newton step of all.
        predicted = quaternion.exp(delta[..., to["orientation"]])
        against = torch.where(self.is_root, _none(predicted), predicted[..., self.parent, :])
        relative = quaternion.log(quaternion.product(quaternion.conjugate(against), predicted))
        angles = (axes * relative[..., self.dof_node, :]).sum(-1)
        turned = self._compose(axes, angles)
        here = self._turn(turned, axes, anchors)
        missing = quaternion.log(quaternion.product(predicted, quaternion.conjugate(turned)))
        gaps = self._gap(place.flatten(-2), self._along(here[1]))
        angles = angles + self._solve(*here, missing, gaps, weight)
        turned = self._compose(axes, angles)
        axes, anchors = self._turn(turned, axes, anchors)
        gaps = self._gap(place.flatten(-2), self._along(anchors))
        shift = place - gaps.view_as(place) - state[..., at["position"]]

        # Rates: linear, where the joints are now.
        moved = velocity.flatten(-2)
        rates = self._solve(axes, anchors, speed, self._gap(moved, torch.zeros_like(moved)), weight)
        speed = (self._turning(axes) @ rates.unsqueeze(-1)).squeeze(-1).unflatten(-1, (-1, 3))
        both = torch.stack((speed[..., self.parent, :], speed), dim=-3)
        along = self._along(torch.linalg.cross(both, anchors))
        push = velocity - self._gap(moved, along).view_as(velocity) - state[..., at["linear_velocity"]]
        spin = speed - state[..., at["angular_velocity"]]
        return torch.cat((shift, quaternion.log(turned), push, spin), dim=-1) * self.movable

    def _axes(self, matrices: Tensor, values: PhysicalParameters) -> Tensor:
        """Axes of all degrees of freedom ``[*B, K, 3]`` in the world frame."""
        axis = torch.where(self.hinged, values.joint_axis[..., self.dof_edge, :], self.own_axis).to(matrices.dtype)
        carried = (matrices[..., self.dof_carrier, :, :] @ axis.unsqueeze(-1)).squeeze(-1)
        return torch.where(self.hinged, carried, axis)

    def _turn(self, turned: Tensor, axes: Tensor, anchors: Tensor) -> tuple[Tensor, Tensor]:
        """Axes and arms after bodies have been turned by ``[*B, N, 4]``."""
        moved = quaternion.rotate(turned[..., self.dof_carrier, :], axes)
        both = torch.stack((turned[..., self.parent, :], turned), dim=-3)
        return torch.where(self.hinged, moved, axes), quaternion.rotate(both, anchors)

    def _compose(self, axes: Tensor, angles: Tensor) -> Tensor:
        """Rotation ``[*B, N, 4]`` of every body when joints turn by ``angles`` ``[*B, K]``."""
        vectors = axes * angles.unsqueeze(-1)
        own = quaternion.exp(self.first.to(axes.dtype) @ vectors)
        if self._two_stages:
            own = quaternion.product(own, quaternion.exp(self.second.to(axes.dtype) @ vectors))
        # One product a body: p * q is linear in p.
        turned, after = list(own.unsqueeze(-1).unbind(-3)), quaternion.right_matrix(own).unbind(-3)
        for node, parent in self._order:
            turned[node] = after[node] @ turned[parent]
        return torch.stack(turned, dim=-3).squeeze(-1)

    def _turning(self, axes: Tensor) -> Tensor:
        """``[*B, 3 N, K]``: angular velocities of all bodies for each rate."""
        return (self.reach.to(axes.dtype).unsqueeze(-2) * axes.mT.unsqueeze(-3)).flatten(-3, -2)

    def _solve(self, axes: Tensor, anchors: Tensor, turns: Tensor, gaps: Tensor, weight: Tensor) -> Tensor:
        """Rates ``[*B, K]`` whose turning ``[*B, N, 3]`` and moving ``[*B, 3 N]`` of the bodies is nearest."""
        turning = self._turning(axes)
        moving = self.moves(anchors) @ turning[..., self.turning, :]
        pull = torch.cat((turning.mT, weight * moving.mT), dim=-1)
        normal = turning.mT @ turning + weight * (moving.mT @ moving)
        # Two parallel hinges at one place would share their turn: a little of nothing, but more than is rounded away,
        # settles it.
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        little = (16 * torch.finfo(normal.dtype).eps * diagonal.amax(-1, keepdim=True)).clamp(min=1e-12)
        normal = normal + torch.diag_embed(little.expand_as(diagonal))
        wanted = torch.cat((turns.flatten(-2), gaps[..., self.placed]), dim=-1).unsqueeze(-1)
        return torch.linalg.solve_ex(normal, pull @ wanted)[0].squeeze(-1)


def _none(rotation: Tensor) -> Tensor:
    """No rotation, as quaternions of the same shape."""
    return torch.cat((torch.ones_like(rotation[..., :1]), torch.zeros_like(rotation[..., 1:])), dim=-1)


def _dofs(scene: Scene) -> list[tuple[int, int, int, np.ndarray, int]]:
    """Node, carrier of the axis, edge, else an axis in the world, and place in its node's chain of hinges."""
    model, joint_anchors = scene.model, scene.joint_anchors
    carriers, _ = joint_axes(scene)
    dofs: list[tuple[int, int, int, np.ndarray, int]] = []
    for node in range(scene.num_nodes):
        free = scene.movable[node, 9:].nonzero()[0]
        if joint_anchors.parent[node] != node:
            body = int(scene.body[node])
            joints = model.body_jntadr[body] + np.arange(model.body_jntnum[body])
            if (model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_HINGE)).all() and len(joints) <= 2:
                zero = np.zeros(3)
                dofs += [(node, int(carriers[j]), 2 * int(j), zero, stage) for stage, j in enumerate(joints)]
                continue
            free = np.arange(3)  # a ball, or more hinges than their axes can be told of
        dofs += [(node, 0, -1, np.eye(3)[axis], 0) for axis in free]
    return dofs
