"""Parameters of the force elements at joints: joint limits and actuator laws."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.scenes.activations import muscle_actuators
from torchrl_gn.scenes.actuator_kinds import switched_off
from torchrl_gn.scenes.lines import known_tendon
from torchrl_gn.scenes.topology import topology

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

_JOINT, _GAIN, _BIAS, _TRANSMISSION = mujoco.mjtJoint, mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtTrn
FAR = 1e10
"""Limit of joints and forces without limits."""
JOINT_GROUPS = {"slide": 1, "one": 1, "two": 2, "three": 3, "ball": 1, "free": 1}
"""Joints per group: slides, hinges of bodies with one, two or three of them, balls and free joints."""
_HINGES = ("one", "two", "three")
_BEYOND = 0.25  # rad that a hinge may go beyond its soft limits
_PARALLEL = 1e-3  # consecutive hinges are parallel below this sine of their angle


def joint_groups(model: mujoco.MjModel, bodies: np.ndarray) -> tuple[dict[str, list[tuple[int, list[int]]]], list[int]]:
    """Group the joints whose coordinates follow from node poses; also return the list of all other joints.

    ``bodies`` ``[N]`` are the nodes' root bodies. Each group lists nodes and their joints. Coordinates follow if a body
    has a free joint; or independent slides (or none), then a ball or up to three hinges (or none), of which no two
    consecutive ones are parallel.
    """
    groups: dict[str, list[tuple[int, list[int]]]] = {name: [] for name in JOINT_GROUPS}
    others = []
    for node, body in enumerate(bodies.tolist()[1:], start=1):
        first = int(model.body_jntadr[body])
        joints = list(range(first, first + int(model.body_jntnum[body])))
        parts = _parts(model, joints)
        for name, some in parts or ():
            groups[name].append((node, some))
        others += joints if parts is None else []
    return groups, others


def _parts(model: mujoco.MjModel, joints: list[int]) -> list[tuple[str, list[int]]] | None:
    """Group a body's joints; None if their coordinates do not follow from the body's pose."""
    kinds, axes = [_JOINT(model.jnt_type[joint]) for joint in joints], model.jnt_axis[joints]
    if kinds == [_JOINT.mjJNT_FREE]:
        return [("free", joints)]
    slid = next((index for index, kind in enumerate(kinds) if kind != _JOINT.mjJNT_SLIDE), len(kinds))
    rotating = joints[slid:]
    if slid and (
        np.linalg.matrix_rank(axes[:slid]) < slid or (rotating and np.ptp(model.jnt_pos[rotating], axis=0).any())
    ):
        return None
    slides = [("slide", [joint]) for joint in joints[:slid]]
    if not rotating:
        return slides
    if kinds[slid:] == [_JOINT.mjJNT_BALL]:
        return [*slides, ("ball", rotating)]
    across = np.linalg.norm(np.cross(axes[slid:-1], axes[slid + 1 :]), axis=-1)
    if len(rotating) > 3 or set(kinds[slid:]) != {_JOINT.mjJNT_HINGE} or (across < _PARALLEL).any():
        return None
    return [*slides, (_HINGES[len(rotating) - 1], rotating)]


def joint_poses(scene: Scene) -> np.ndarray:
    """Return each node's pose ``[N, 7]`` in its parent's frame, position and quaternion, joints at reference."""
    columns = [*(f"pos[{index}]" for index in range(3)), *(f"quat[{index}]" for index in range(4))]
    return scene.static.nodes[:, [scene.static.node_names.index(name) for name in columns]]


def joint_constants(scene: Scene) -> np.ndarray:
    """Return ``[E, 8]`` of each edge's joint: axis 3 and anchor 3 in the child's frame, lower and upper limit.

    A slide's axis is the vector whose product with the position gives the coordinate; its anchor is the anchor of the
    following hinges or ball. The constraint's force sets in at the limits (rad or m), ``jnt_margin`` inside the range;
    a ball has only an upper limit, its largest angle.
    """
    model = scene.model
    kinds, axes, places, count = model.jnt_type, model.jnt_axis, model.jnt_pos, model.njnt
    constants = np.zeros((len(scene.pairs), 8))
    constants[:count, :3], constants[:count, 3:6] = axes, places
    for joint in np.flatnonzero(kinds == int(_JOINT.mjJNT_SLIDE)).tolist():
        body_joints = np.flatnonzero(model.jnt_bodyid == model.jnt_bodyid[joint])
        slides = body_joints[kinds[body_joints] == kinds[joint]].tolist()
        constants[joint, :3] = np.linalg.pinv(axes[slides].T)[slides.index(joint)]
        constants[joint, 3:6] = places[body_joints[-1]] if body_joints[-1] not in slides else 0.0
    constants[:, 6:] = -FAR, FAR
    limited = limited_joints(model)
    within = model.jnt_range + model.jnt_margin[:, None] * [1, -1]
    constants[:count][limited, 6:] = within[limited]
    constants[:count][kinds == int(_JOINT.mjJNT_BALL), 6] = -FAR
    return np.repeat(constants, 2, axis=0)


def limited_joints(model: mujoco.MjModel) -> np.ndarray:
    """Find joints ``[J]``, bool, with limits in force."""
    off = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    in_force = not model.opt.disableflags & off
    return model.jnt_limited.astype(bool) & in_force


def winding_joints(model: mujoco.MjModel) -> np.ndarray:
    """Find hinges ``[J]``, bool, that may make a whole turn, which the pose of their body does not show.

    Limits are soft: a hinge that is a little beyond a limit of half a turn looks as if it were before the other one.
    """
    wide = np.ptp(model.jnt_range, axis=1) > 2 * (np.pi - _BEYOND)
    return (model.jnt_type == int(_JOINT.mjJNT_HINGE)) & (~limited_joints(model) | wide)


def gimbal_lock(model: mujoco.MjModel, joints: list[int]) -> float:
    """Return an angle [rad] of the middle one of three hinges, from its reference, where their axes lie in one plane.

    The other such angle is half a turn away. Each pose on one side of these angles looks like one on the other side.
    """
    first, second, third = model.jnt_axis[joints]
    return math.atan2(first @ np.cross(second, third), first @ third - (first @ second) * (second @ third))


def passes_gimbal_lock(model: mujoco.MjModel, joints: list[int]) -> bool:
    """Return True if the middle one of three hinges can reach gimbal lock, also if a little beyond its soft limits."""
    middle = joints[1]
    if not limited_joints(model)[middle]:
        return True
    low, high = model.jnt_range[middle] - model.qpos0[model.jnt_qposadr[middle]] - gimbal_lock(model, joints)
    return math.floor((high + _BEYOND) / math.pi) >= math.ceil((low - _BEYOND) / math.pi)


def sprung(model: mujoco.MjModel, kind: str) -> np.ndarray:
    """Find joints or tendons ``[n]``, bool, with a spring."""
    arrays = [getattr(model, f"{kind}_{name}", None) for name in ("stiffness", "stiffnesspoly")]  # since MuJoCo 3.7
    stiff = [np.any(each != 0, axis=tuple(range(1, each.ndim))) for each in arrays if each is not None]
    return np.logical_or.reduce(stiff)


def actuator_laws(scene: Scene) -> np.ndarray:
    """Return the law ``[E, C, 9]`` of the actuator in each control slot of an edge.

    The law is 0 where the force is unknown here, or switched off.

    Columns: gain 3 and bias 3, each a constant and its slopes in the actuator's length and velocity (0 for muscles, see
    MuscleForces); lower and upper limit of the force; gear at the edge. The gear is the force at the edge per force of
    the actuator, and the change of the actuator's length per change of the joint coordinate, tendon length or crank
    length; it is 1 for sites.
    """
    model, action, known = scene.model, scene.edge_action[::2], known_slots(scene)
    gain, bias = model.actuator_gainprm[:, :3].copy(), model.actuator_biasprm[:, :3].copy()
    gain[model.actuator_gaintype == int(_GAIN.mjGAIN_FIXED), 1:] = 0
    bias[model.actuator_biastype == int(_BIAS.mjBIAS_NONE)] = 0
    gain[muscle_actuators(model)] = bias[muscle_actuators(model)] = 0
    limits = np.where(model.actuator_forcelimited[:, None], model.actuator_forcerange, (-FAR, FAR))
    names = ["actuator_gear[0]" + f"/{slot}" * (slot > 0) for slot in range(action.shape[1])]
    gear = scene.static.edges[::2, [scene.static.edge_names.index(name) for name in names]]
    gear[np.isin(action, site_actuators(model))] = 1.0
    known &= ~np.isin(action, np.flatnonzero(switched_off(model)))
    laws = np.zeros((*action.shape, 9))
    laws[known, :8], laws[known, 8] = np.concatenate((gain, bias, limits), axis=1)[action[known]], gear[known]
    return np.repeat(laws, 2, axis=0)


def known_moments(scene: Scene) -> np.ndarray:
    """Find joints ``[J]``, bool, where the effect of a wrench on the bodies they carry follows from body states."""
    model = scene.model
    groups, others = joint_groups(model, scene.body)
    known = ~np.isin(np.arange(model.njnt), others)
    for name in _HINGES[1:]:
        for _, joints in groups[name]:
            if np.ptp(model.jnt_pos[joints], axis=0).any():  # each anchor's position depends on the other joints
                known[joints] = False
    return known


def straight_joints(scene: Scene) -> np.ndarray:
    """Find hinges and slides ``[J]``, bool, whose coordinate follows from body states."""
    groups, _ = joint_groups(scene.model, scene.body)
    straight = [joint for name in ("slide", *_HINGES) for _, joints in groups[name] for joint in joints]
    return np.isin(np.arange(scene.model.njnt), straight)


def site_actuators(model: mujoco.MjModel) -> list[int]:
    """Return the actuators of sites."""
    return np.flatnonzero(model.actuator_trntype == int(_TRANSMISSION.mjTRN_SITE)).tolist()


def line_actuators(scene: Scene) -> list[int]:
    """Find actuators of spatial tendons, slider-cranks and sites whose length follows from body states."""
    model, graph, joint_known = scene.model, topology(scene.model), known_moments(scene)
    actuators = []
    for actuator in range(len(model.actuator_trntype)):
        kind, (target, other) = _TRANSMISSION(model.actuator_trntype[actuator]), model.actuator_trnid[actuator].tolist()
        if kind == _TRANSMISSION.mjTRN_TENDON:
            known = known_tendon(model, target) and not _tendon_limits_force(model, target)
        elif kind == _TRANSMISSION.mjTRN_SITE:  # between moving bodies MuJoCo omits joints that move both
            known = other < 0 or not graph.node_of_body[model.site_bodyid[other]]
        else:
            known = kind == _TRANSMISSION.mjTRN_SLIDERCRANK
        pairs = np.flatnonzero((scene.edge_action[::2] == actuator).any(1))
        if known and len(pairs) and (kind == _TRANSMISSION.mjTRN_SITE or joint_known[pairs].all()):
            actuators.append(actuator)
    return actuators


def _tendon_limits_force(model: mujoco.MjModel, tendon: int) -> bool:
    """Return True if the total force of a tendon's actuators has limits."""
    limited = getattr(model, "tendon_actfrclimited", None)  # MuJoCo before 3.3 has none
    return limited is not None and bool(limited[tendon])


def _of_coordinates(model: mujoco.MjModel, actuator: int) -> bool:
    """Return True if an actuator drives a joint, or a fixed tendon without limits on its actuators' total force."""
    kind, target = _TRANSMISSION(model.actuator_trntype[actuator]), int(model.actuator_trnid[actuator, 0])
    if kind != _TRANSMISSION.mjTRN_TENDON:
        return kind in (_TRANSMISSION.mjTRN_JOINT, _TRANSMISSION.mjTRN_JOINTINPARENT)
    fixed = model.wrap_type[model.tendon_adr[target]] == mujoco.mjtWrap.mjWRAP_JOINT
    return bool(fixed) and not _tendon_limits_force(model, target)


def known_slots(scene: Scene) -> np.ndarray:
    """Find control slots ``[E / 2, C]``, bool, of actuators whose force follows from body states."""
    model, action = scene.model, scene.edge_action[::2]
    straight = np.zeros(len(action), dtype=bool)
    straight[: model.njnt] = straight_joints(scene)
    known = np.array([_of_coordinates(model, actuator) for actuator in range(model.nu)], dtype=bool)
    known &= ~np.isin(np.arange(model.nu), action[~straight])
    known[line_actuators(scene)] = True
    affine = np.isin(model.actuator_gaintype, (int(_GAIN.mjGAIN_FIXED), int(_GAIN.mjGAIN_AFFINE)))
    affine &= np.isin(model.actuator_biastype, (int(_BIAS.mjBIAS_NONE), int(_BIAS.mjBIAS_AFFINE)))
    known &= (affine | muscle_actuators(model)) & (model.actuator_plugin < 0)
    return np.append(known, False)[action]  # -1: no actuator
