"""Physical parameters (different in each variant of a scene), their names, and the topology that variants share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.scenes.activations import activation_numbers
from torchrl_gn.scenes.contact_points import contact_slots
from torchrl_gn.scenes.couplings import constraint_numbers
from torchrl_gn.scenes.force_elements import actuator_laws, joint_constants, joint_poses
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.static_features import is_member
from torchrl_gn.scenes.tendons import tendon_numbers

if TYPE_CHECKING:
    from torchrl_gn.scenes.articulation import Articulation


class PhysicalParameters(NamedTuple):
    """Physical parameters of a scene (lengths, masses, ...), float64, with or without a batch."""

    nodes: Tensor  # [*B, N, F_n] static node features, true or inferred; all, or those that a model reads
    edges: Tensor  # [*B, E, F_e]
    globals_: Tensor  # [*B, F_g]
    joint_axis: Tensor  # [*B, E, 3] joint axis of each edge, in the frame of the node it is fixed to
    rest: Tensor  # [*B, 4] the root's orientation at yaw 0
    pivot: Tensor  # [*B, 3] a point on the yaw axis, metres
    parent_anchor: Tensor  # [*B, N, 3] anchor of each node in the parent's frame, metres
    child_anchor: Tensor  # [*B, N, 3] anchor of each node in its own frame, metres
    contact_offset: Tensor  # [*B, N, 4, 3] contact points in the node's frame, metres
    contact_radius: Tensor  # [*B, N, 4] metres
    joint_pose: Tensor  # [*B, N, 7] pose of each node in its parent's frame, joints at reference
    joint: Tensor  # [*B, E, 8] axis, anchor and limits of each edge's joint, see joint_constants
    actuator: Tensor  # [*B, E, C, 9] law of the actuator in each control slot, see actuator_laws
    contact_point: Tensor  # [*B, P, 16] points of bodies that can touch the world, see WorldContacts
    contact_pair: Tensor  # [*B, P, S, 2] contacts of these points and surfaces, see WorldContacts
    surface: Tensor  # [*B, S, 22] surfaces of the world, see Surface

    @classmethod
    def of(cls, scene: Articulation) -> PhysicalParameters:
        """Return the parameters of a scene."""
        if not isinstance(scene, Scene):
            return scene.values()
        static, anchors, yaw_frame = scene.static, scene.joint_anchors, scene.yaw_frame
        identity = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        rest_quat, pivot = identity if yaw_frame is None else (yaw_frame.rest, yaw_frame.pivot)
        arrays = (static.nodes, static.edges, static.globals_, joint_axes(scene)[1].repeat(2, axis=0), rest_quat, pivot)
        arrays += (anchors.parent_anchor, anchors.child_anchor, *contact_slots(scene)[:2])
        arrays += (joint_poses(scene), joint_constants(scene), actuator_laws(scene))
        contacts = scene.world_contacts
        arrays += tuple(_not_empty(each) for each in (contacts.points, contacts.pairs, contacts.constants))
        return cls(*(torch.as_tensor(array, dtype=torch.float64, device="cpu") for array in arrays))

    @classmethod
    def read(cls, static: TensorDictBase, own: PhysicalParameters) -> PhysicalParameters:
        """Read a TensorDict, with ``own`` for missing entries; KeyError if one is unknown, ValueError if misshapen."""
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
        return TensorDict(self._asdict())


def _not_empty(array: np.ndarray) -> np.ndarray:
    """Extend empty dimensions of an array to one zero, as ``torch.export`` saves no empty constants."""
    return array if array.size else np.zeros([max(size, 1) for size in array.shape])


def topology(scene: Scene) -> dict[str, object]:
    """Return everything that the variants of a scene have in common, as comparable values by name.

    These are the structure, and numbers that features read of the scene they are bound to, because samples lack them.
    """
    yaw_frame, joint_anchors, contacts = scene.yaw_frame, scene.joint_anchors, scene.world_contacts
    plane = scene.contact_points
    ground = None if plane is None else np.round((plane.normal, plane.origin), 9).tolist()
    force_limits = np.where(scene.model.jnt_actfrclimited[:, None], scene.model.jnt_actfrcrange, np.inf)
    return {
        "number of nodes": scene.num_nodes,
        "edges": (scene.senders.tolist(), scene.receivers.tolist()),
        "motors": (scene.num_actions, scene.edge_action.tolist()),
        "action bounds": (scene.action_low.tolist(), scene.action_high.tolist()),
        "limits of the actuators' forces at joints": force_limits.tolist(),
        "movable components": scene.movable.tolist(),
        "invariant axes": scene.translation_invariant.tolist(),
        "control step": round(scene.timestep, 9),
        "yaw frame": None if yaw_frame is None else (yaw_frame.exact, yaw_frame.node, yaw_frame.axis),
        "joint anchors": (joint_anchors.parent.tolist(), joint_anchors.root.tolist(), joint_anchors.ancestors.tolist()),
        "joint axes": joint_axes(scene)[0].tolist(),
        "contact points": contact_slots(scene)[2].tolist(),
        "plane that contact points touch": ground,
        "tendons, slider-cranks or sites": tendon_numbers(scene),
        "equality constraints": constraint_numbers(scene),
        "activations": activation_numbers(scene.model),
        "delays": scene.delays.lag.tolist(),
        "mocap poses": np.round(scene.mocap_poses, 9).tolist(),
        "moving surfaces of bodies": np.round(contacts.velocity, 9).tolist(),
        "contacts with the world": (contacts.node.tolist(), contacts.touches.tolist(), contacts.kinds),
    }


def require_variant(scene: Scene, other: Scene) -> None:
    """Raise ValueError, saying what differs, unless physical parameters say all that features read of ``other``."""
    own, others = topology(scene), topology(other)
    if differs := [what for what in own if own[what] != others[what]]:
        raise ValueError(
            f"Scene {other.name!r} is not a variant of {scene.name!r}: {', '.join(differs)} differ. Give it a model and"
            " data of its own."
        )


def joint_axes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the node ``[E / 2]`` that each joint's axis is fixed to, and the unit axis ``[E / 2, 3]`` in its frame.

    The node is the parent if no rotation precedes the joint on its body, else the child (approximate for the middle one
    of three hinges). Axes of balls, free joints and pairs without joint are 0.
    """
    model, kind = scene.model, mujoco.mjtJoint
    nodes = scene.receivers[::2].copy()
    axes = np.zeros((len(nodes), 3))
    rotated: set[int] = set()
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if model.jnt_type[joint] not in (int(kind.mjJNT_HINGE), int(kind.mjJNT_SLIDE)):
            rotated.add(body)
            continue
        axes[joint] = model.jnt_axis[joint]
        if body not in rotated:
            child = nodes[joint]
            nodes[joint] = scene.senders[2 * joint]
            rest_quat = scene.static.nodes[
                child, [scene.static.node_names.index(f"quat[{index}]") for index in range(4)]
            ]
            mujoco.mju_rotVecQuat(axes[joint], model.jnt_axis[joint], rest_quat)
        if model.jnt_type[joint] == int(kind.mjJNT_HINGE):
            rotated.add(body)
    return nodes, axes


@dataclass(frozen=True)
class ParameterNames:
    """Names of the physical-parameter columns of a scene, a data set or a model; they stay valid if columns move."""

    nodes: tuple[str, ...] = ()
    edges: tuple[str, ...] = ()
    globals_: tuple[str, ...] = ()

    @classmethod
    def of(cls, scene: Articulation) -> ParameterNames:
        """Return the names of a scene's columns."""
        static = scene.static
        return cls(tuple(static.node_names), tuple(static.edge_names), tuple(static.global_names))

    @classmethod
    def from_names(cls, names: Mapping[str, Sequence[str]]) -> ParameterNames:
        """Restore names from ``dataclasses.asdict``, also after JSON."""
        return cls(**{part: tuple(columns) for part, columns in names.items()})

    def common(self, other: ParameterNames) -> ParameterNames:
        """Return the names that ``other`` has too, in the order of this set."""
        others = asdict(other)
        return ParameterNames(
            **{part: tuple(name for name in names if name in others[part]) for part, names in asdict(self).items()}
        )

    def missing_in(self, other: ParameterNames) -> list[str]:
        """List the names that ``other`` lacks, ignoring types and flags of another MuJoCo version."""
        others = asdict(other)
        all_names = asdict(self).items()
        return [name for part, names in all_names for name in names if name not in others[part] and not is_member(name)]

    def columns_in(self, other: ParameterNames) -> dict[str, list[int]]:
        """Return each name's column in ``other``, by part, for :func:`take_columns`; -1 where missing."""
        columns = {part: {name: column for column, name in enumerate(names)} for part, names in asdict(other).items()}
        return {part: [columns[part].get(name, -1) for name in names] for part, names in asdict(self).items()}

    def select(self, scene: Articulation) -> PhysicalParameters:
        """Select these columns of a scene's parameters, 0 for unknown types and flags; ValueError if one is missing."""
        values, available = PhysicalParameters.of(scene), ParameterNames.of(scene)
        if missing := self.missing_in(available):
            raise ValueError(f"Scene {scene.name!r} lacks the static features {missing} that the model reads.")
        columns = self.columns_in(available)
        return values._replace(**{part: take_columns(getattr(values, part), columns[part]) for part in columns})


def take_columns(values: Tensor, columns: Sequence[int] | Tensor) -> Tensor:
    """Select columns of ``[..., F]``; column -1 gives zeros."""
    return pad(values, (0, 1))[..., torch.as_tensor(columns, dtype=torch.long)]
