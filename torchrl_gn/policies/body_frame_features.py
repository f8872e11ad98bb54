"""Features of every body in its own frame, as a graph of a scene's bodies."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.normalizer import Normalizer, unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.policies.state_features import FLOOR, LIMIT, check_states
from torchrl_gn.scenes import Scene, require_bodies


class BodyFrameFeatures(Float64Buffers):
    r"""Normalised graph of a scene's moving bodies, each described in its own frame.

    A node has the body's velocities :math:`R^T v` and :math:`R^T \omega`, the world's origin :math:`-R^T x`, the
    world's axes (the rows of :math:`R`), and activations of actuators. An edge, one direction of a joint, has the
    sender's pose in the receiver's frame, and the direction as static feature. The features omit positions along the
    task's invariant axes and world axes that only the yaw distinguishes. They mean the same in scenes of any number of
    bodies.

    Args:
        invariances: invariances of the task, see :func:`task_invariances`.

    Raises:
        TypeError: the scene is a kinematic tree.
    """

    bodies: Tensor
    visible: Tensor

    def __init__(self, scene: Scene, invariances: Canonicalizer) -> None:
        super().__init__()
        require_bodies(scene, "A policy")
        self.scene, self.options = scene, invariances
        bodies = np.flatnonzero(scene.predicted)
        row = np.full(scene.num_nodes, -1)
        row[bodies] = np.arange(len(bodies))
        pairs = np.stack((row[scene.senders], row[scene.receivers]))
        within = np.flatnonzero((pairs >= 0).all(0))
        _, first = np.unique(pairs[:, within], axis=1, return_index=True)  # several joints may join the same two bodies
        edges = within[np.sort(first)]
        edge_index = torch.as_tensor(pairs[:, edges]).long()
        direction = 1.0 - 2.0 * (edges % 2)  # a joint's edges lead from the parent, then back
        frame = invariances.frame(scene)
        # World axes that bodies perceive: all, only the yaw axis, or none where every axis is alike.
        if frame is None:
            self.axes = slice(0, 3)
        else:
            self.axes = slice(0, 0) if frame.axis is None else slice(frame.axis, frame.axis + 1)
        hidden = np.asarray(scene.translation_invariant) if invariances.recenter else np.zeros(3, bool)
        self.constants({"bodies": bodies, "visible": 1.0 - hidden, "direction": direction[:, None]})
        self.incidence = Incidence(edge_index, len(bodies))
        activations = scene.state_size - BODY_STATE.size
        self.size = GraphSize(9 + 3 * len(range(*self.axes.indices(3))) + activations, 12, 0)
        self.node_normalizer = Normalizer(self.size.nodes, floor=FLOOR, limit=LIMIT)
        self.edge_normalizer = Normalizer(self.size.edges, floor=FLOOR, limit=LIMIT)

    @property
    def fitted(self) -> bool:
        """True if the normalisers have data; reading it synchronises with the device."""
        return self.node_normalizer.fitted

    def differs_from(self, other: BodyFrameFeatures) -> str | None:
        """Name the invariance in which the scene differs from another with features of equal size, or None."""
        if self.axes != other.axes:
            return f"yaw axis {'xyz'[self.axes.start]}, not {'xyz'[other.axes.start]}"
        if not torch.equal(self.visible.cpu(), other.visible.cpu()):
            ours, theirs = (
                "".join(axis for axis, seen in zip("xyz", each.visible.tolist(), strict=True) if not seen) or "none"
                for each in (self, other)
            )
            return f"invariant axes {ours}, not {theirs}"
        return None

    @torch.no_grad()
    def update(self, state: Tensor) -> None:
        """Add states ``[*B, N, 13]`` to the normalisers; ValueError if one is not finite."""
        nodes, edges = self._features(state)
        with unchanged_on_error(self):
            self.node_normalizer.update(nodes)
            self.edge_normalizer.update(edges)

    @without_autocast
    def forward(self, state: Tensor, dtype: torch.dtype | None = None) -> Graph:
        """Return graphs ``[*B]`` of states ``[*B, N, 13]``; differentiable."""
        nodes, edges = self._features(state)
        nodes, edges = self.node_normalizer(nodes, dtype), self.edge_normalizer(edges, dtype)
        return Graph(nodes, edges, nodes.new_zeros(*nodes.shape[:-2], 0), self.incidence.edge_index)

    def static_graph(self, like: Tensor) -> Graph:
        """Return the directions of the edges, which are the same for every sample."""
        direction = cast(Tensor, self.direction).to(like)
        nodes, globals_ = like.new_zeros(self.incidence.num_nodes, 0), like.new_zeros(0)
        return Graph(nodes, direction, globals_, self.incidence.edge_index)

    def _features(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return features of nodes ``[*B, N', F_n]`` and edges ``[*B, E', F_e]``."""
        check_states(self.scene, state)
        state = state.index_select(-2, self.bodies)
        position, orientation, velocity, angular = (
            state[..., BODY_STATE.slices[name]]
            for name in ("position", "orientation", "linear_velocity", "angular_velocity")
        )
        world = quaternion.to_matrix(orientation).unflatten(-1, (3, 3))
        to_body_frame = world.mT
        seen = torch.stack((velocity, angular, -position * self.visible.to(state.dtype)), -1)
        axes = world[..., self.axes, :].flatten(-2)  # the world's axes in the body's frame
        nodes = torch.cat(((to_body_frame @ seen).mT.flatten(-2), axes, state[..., BODY_STATE.size :]), -1)
        sender, receiver = self.incidence.edge_index
        frame, offset = to_body_frame[..., receiver, :, :], position[..., sender, :] - position[..., receiver, :]
        relative = torch.cat((world[..., sender, :, :], offset.unsqueeze(-1)), -1)
        return nodes, (frame @ relative).flatten(-2)
