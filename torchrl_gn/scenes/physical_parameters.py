"""The numbers of a scene that differ between its variants; what is left is topology."""

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
    """Numbers that differ between variants of a scene (lengths, masses, ...), float64, each with or without a batch.

    Attributes:
        nodes: ``[*B, N, F_n]`` static node features, all or those that a model reads, in SI units; or inferred ones.
        edges: ``[*B, E, F_e]``.
        globals_: ``[*B, F_g]``.
        joint_axis: ``[*B, E, 3]`` axis of each edge's joint, in the frame of the node that carries it.
        rest: ``[*B, 4]`` the root's orientation at yaw_frame 0.
        pivot: ``[*B, 3]`` where the yaw_frame's axis is, metres.
        parent_anchor: ``[*B, N, 3]`` where each node is joined to its parent, in the parent's frame, metres.
        arm: ``[*B, N, 3]`` the same in the node's own frame.
        contact_offset: ``[*B, N, 4, 3]`` points that can touch the plane, in the node's frame, metres.
        contact_radius: ``[*B, N, 4]`` radii about them, metres.
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
        """All numbers of a scene."""
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
        """Take the entries that a TensorDict has; the rest are a scene's ``own``.

        Raises:
            KeyError: if it has entries that are none of these.
            ValueError: if an entry has a wrong shape.
        """
        unknown = sorted(set(map(str, static.keys())) - set(cls._fields))
        if unknown:
            raise KeyError(f"Static entries {unknown} are not known; use some of {list(cls._fields)}.")
        values = {}
        for name, usual in own._asdict().items():
            value = static.get(name, None)
            if value is None:
                value = usual
            elif value.shape[len(static.shape) :] != usual.shape:
                shape = [*static.shape, *usual.shape]
                raise ValueError(f"Static entry {name!r} must be {shape}, got {list(value.shape)}.")
            values[name] = value
        return cls(**values)

    def tensordict(self) -> TensorDict:
        """As entries of a TensorDict without batch."""
        return TensorDict(self._asdict())


def topology(scene: Scene) -> dict[str, object]:
    """What variants of one scene have in common, as comparable values by what it is."""
    yaw_frame, joint_anchors = scene.yaw_frame, scene.joint_anchors
    turn = None if yaw_frame is None else (yaw_frame.exact, yaw_frame.node, yaw_frame.axis)
    return {
        "number of nodes": scene.num_nodes,
        "edges": (scene.senders.tolist(), scene.receivers.tolist()),
        "motors": (scene.num_actions, scene.edge_action.tolist()),
        "components that move": scene.movable.tolist(),
        "invariant axes": scene.translation_invariant.tolist(),
        "control step": round(scene.timestep, 9),
        "yaw_frame": turn,
        "pins": (joint_anchors.parent.tolist(), joint_anchors.root.tolist(), joint_anchors.ancestors.tolist()),
        "joint axes": joint_axes(scene)[0].tolist(),
        "contact points": contact_slots(scene)[2].tolist(),
    }
