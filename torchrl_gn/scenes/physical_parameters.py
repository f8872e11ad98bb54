"""Physical parameters, which differ between the variants of a scene, and the topology they share."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.scenes.contact_points import contact_slots
from torchrl_gn.scenes.joint_axes import joint_axes
from torchrl_gn.scenes.scene import Scene

if TYPE_CHECKING:
    from torchrl_gn.scenes.kinematic_tree import KinematicTree


class PhysicalParameters(NamedTuple):
    """Physical parameters of a scene (lengths, masses, ...), float64, with or without a batch.

    Attributes:
        nodes: ``[*B, N, F_n]`` static node features, true or inferred, all or those that a model reads.
        edges: ``[*B, E, F_e]``.
        globals_: ``[*B, F_g]``.
        joint_axis: ``[*B, E, 3]`` joint axis of each edge, in the frame of the node it is fixed to.
        rest: ``[*B, 4]`` the root's orientation at yaw 0.
        pivot: ``[*B, 3]`` a point on the yaw axis, metres.
        parent_anchor: ``[*B, N, 3]`` anchor of each node in the parent's frame, metres.
        child_anchor: ``[*B, N, 3]`` anchor of each node in its own frame, metres.
        contact_offset: ``[*B, N, 4, 3]`` contact points in the node's frame, metres.
        contact_radius: ``[*B, N, 4]`` metres.
    """

    nodes: Tensor
    edges: Tensor
    globals_: Tensor
    joint_axis: Tensor
    rest: Tensor
    pivot: Tensor
    parent_anchor: Tensor
    child_anchor: Tensor
    contact_offset: Tensor
    contact_radius: Tensor

    @classmethod
    def of(cls, scene: Scene | KinematicTree) -> PhysicalParameters:
        """Return the parameters of a scene."""
        if not isinstance(scene, Scene):
            return scene.values()
        yaw_frame, (offset, radius, _) = scene.yaw_frame, contact_slots(scene)
        values = {
            "nodes": scene.static.nodes,
            "edges": scene.static.edges,
            "globals_": scene.static.globals_,
            "joint_axis": joint_axes(scene)[1].repeat(2, axis=0),
            "rest": np.array([1.0, 0.0, 0.0, 0.0]) if yaw_frame is None else yaw_frame.rest,
            "pivot": np.zeros(3) if yaw_frame is None else yaw_frame.pivot,
            "parent_anchor": scene.joint_anchors.parent_anchor,
            "child_anchor": scene.joint_anchors.child_anchor,
            "contact_offset": offset,
            "contact_radius": radius,
        }
        return cls(**{name: torch.as_tensor(value, dtype=torch.float64) for name, value in values.items()})

    @classmethod
    def read(cls, static: TensorDictBase, own: PhysicalParameters) -> PhysicalParameters:
        """Return the entries of a TensorDict, completed by a scene's ``own``.

        Raises:
            KeyError: if an entry is unknown.
            ValueError: if an entry has a wrong shape.
        """
        unknown = sorted(set(map(str, static.keys())) - set(cls._fields))
        if unknown:
            raise KeyError(f"Physical parameters {unknown} are not known; use some of {list(cls._fields)}.")
        values = {}
        for name, default in own._asdict().items():
            value = static.get(name, default)
            if value is not default and value.shape[len(static.shape) :] != default.shape:
                shape = [*static.shape, *default.shape]
                raise ValueError(f"Physical parameter {name!r} must be {shape}, got {list(value.shape)}.")
            values[name] = value
        return cls(**values)

    def tensordict(self) -> TensorDict:
        """Return a TensorDict without batch."""
        return TensorDict(self._asdict())


def topology(scene: Scene) -> dict[str, object]:
    """Return what the variants of a scene have in common, as comparable values by name."""
    yaw_frame, joint_anchors = scene.yaw_frame, scene.joint_anchors
    return {
        "number of nodes": scene.num_nodes,
        "edges": (scene.senders.tolist(), scene.receivers.tolist()),
        "motors": (scene.num_actions, scene.edge_action.tolist()),
        "movable components": scene.movable.tolist(),
        "invariant axes": scene.translation_invariant.tolist(),
        "control step": round(scene.timestep, 9),
        "yaw frame": None if yaw_frame is None else (yaw_frame.exact, yaw_frame.node, yaw_frame.axis),
        "joint anchors": (joint_anchors.parent.tolist(), joint_anchors.root.tolist(), joint_anchors.ancestors.tolist()),
        "joint axes": joint_axes(scene)[0].tolist(),
        "contact points": contact_slots(scene)[2].tolist(),
    }
