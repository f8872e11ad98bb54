"""World axes along which a whole scene can be shifted without changing its dynamics."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from torchrl_gn.scenes.topology import Topology

_TOLERANCE = 1e-9
_Disable = mujoco.mjtDisableBit


def translation_invariant(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology) -> np.ndarray:
    """Axes along which the dynamics do not depend on where the scene is.

    An axis counts if every tree that hangs from the world can move along it by
    its slide or free joints alone; if those joints have no limit, spring or
    actuator that feels position; and if nothing fixed in the world is felt:
    contact only with planes parallel to the axis, no equality constraint or
    tendon tied to the world or to those joints. What cannot be judged (plugins,
    flexes) counts as not invariant. Gravity, wind and fluid drag are the same
    everywhere.

    Args:
        model: the scene's model.
        data: of that model at its reference, kinematics done.
        graph: its topology.

    Returns:
        ``[3]`` bool.
    """
    return np.array([_invariant_along(model, data, graph, axis) for axis in np.eye(3)])


def _invariant_along(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, axis: np.ndarray) -> bool:
    if model.nplugin or model.nflex:
        return False
    shifted: set[int] = set()  # joints that carry the shift
    for node in np.flatnonzero(graph.parent == 0):
        joints = _joints_along(model, int(graph.body[node]), axis)
        if joints is None:
            return False
        shifted.update(joints)
    return (
        not any(feels_position(model, joint) for joint in shifted)
        and not touches_world(model, data, graph, axis)
        and not any(tied(model, graph, shifted))
    )


def _joints_along(model: mujoco.MjModel, body: int, axis: np.ndarray) -> list[int] | None:
    """Joints of a root body whose displacement shifts it along ``axis``; None if it cannot."""
    slides, directions = [], []
    frame = reference_rotation(model, body)
    first = model.body_jntadr[body]
    for joint in range(first, first + model.body_jntnum[body]):
        kind = mujoco.mjtJoint(model.jnt_type[joint])
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            return [joint]
        if kind != mujoco.mjtJoint.mjJNT_SLIDE:
            break  # the axes of later slides turn with this joint
        slides.append(joint)
        directions.append(frame @ model.jnt_axis[joint])
    if not slides:
        return None
    matrix = np.array(directions).T  # [3, slides]
    amounts = np.linalg.lstsq(matrix, axis, rcond=None)[0]
    if np.abs(matrix @ amounts - axis).max() > _TOLERANCE:
        return None
    return [joint for joint, amount in zip(slides, amounts, strict=True) if abs(amount) > _TOLERANCE]


def reference_rotation(model: mujoco.MjModel, body: int) -> np.ndarray:
    """``[3, 3]`` world orientation of a body that only fixed bodies carry."""
    rotation = np.eye(3)
    while body:
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, model.body_quat[body])
        rotation = matrix.reshape(3, 3) @ rotation
        body = int(model.body_parentid[body])
    return rotation


def feels_position(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a limit, spring or actuator of a joint depends on the joint's position."""
    stiffness = [model.jnt_stiffness, getattr(model, "jnt_stiffnesspoly", None)]  # MuJoCo before 3.7 has no polynomials
    if model.jnt_limited[joint] or any(np.any(table[joint]) for table in stiffness if table is not None):
        return True
    gains, biases = mujoco.mjtGain, mujoco.mjtBias
    for actuator in np.flatnonzero(model.actuator_trnid[:, 0] == joint):
        gain = gains(model.actuator_gaintype[actuator])
        bias = biases(model.actuator_biastype[actuator])
        if gain not in (gains.mjGAIN_FIXED, gains.mjGAIN_AFFINE):
            return True
        if bias not in (biases.mjBIAS_NONE, biases.mjBIAS_AFFINE):
            return True
        if gain == gains.mjGAIN_AFFINE and model.actuator_gainprm[actuator, 1]:
            return True
        if bias == biases.mjBIAS_AFFINE and model.actuator_biasprm[actuator, 1]:
            return True
    return False


def touches_world(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, axis: np.ndarray | None) -> bool:
    """Whether a moving geom can collide with a fixed one, planes parallel to ``axis`` apart."""
    if model.opt.disableflags & (_Disable.mjDSBL_CONTACT | _Disable.mjDSBL_CONSTRAINT):
        return False
    fixed = graph.node_of_body[model.geom_bodyid] == 0
    for still in np.flatnonzero(fixed):
        normal = data.geom_xmat[still].reshape(3, 3)[:, 2]
        plane = model.geom_type[still] == mujoco.mjtGeom.mjGEOM_PLANE
        if plane and axis is not None and abs(normal @ axis) < _TOLERANCE:
            continue
        if any(can_collide(model, int(still), int(moving)) for moving in np.flatnonzero(~fixed)):
            return True
    return False


def can_collide(model: mujoco.MjModel, first: int, second: int) -> bool:
    """Whether two geoms' masks, or an explicit pair, let them touch."""
    if model.opt.disableflags & (_Disable.mjDSBL_CONTACT | _Disable.mjDSBL_CONSTRAINT):
        return False
    pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    return bool(
        model.geom_contype[first] & model.geom_conaffinity[second]
        or model.geom_contype[second] & model.geom_conaffinity[first]
        or any({first, second} == set(pair) for pair in pairs)
    )


def tied(model: mujoco.MjModel, graph: Topology, shifted: set[int]) -> Iterator[bool]:
    """For every equality constraint and tendon, whether it ties the scene to a place."""
    if not model.opt.disableflags & (_Disable.mjDSBL_EQUALITY | _Disable.mjDSBL_CONSTRAINT):
        for equality in range(model.neq):
            yield _equality_ties(model, graph, equality, shifted)
    fixed_site = graph.node_of_body[model.site_bodyid] == 0
    fixed_geom = graph.node_of_body[model.geom_bodyid] == 0
    wrap = mujoco.mjtWrap
    for code, element in zip(model.wrap_type, model.wrap_objid, strict=True):
        kind = wrap(code)
        if kind == wrap.mjWRAP_JOINT:
            yield int(element) in shifted
        elif kind == wrap.mjWRAP_SITE:
            yield bool(fixed_site[element])
        elif kind in (wrap.mjWRAP_SPHERE, wrap.mjWRAP_CYLINDER):
            yield bool(fixed_geom[element])


def _equality_ties(model: mujoco.MjModel, graph: Topology, equality: int, shifted: set[int]) -> bool:
    kind = mujoco.mjtEq(model.eq_type[equality])
    ends = (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    if kind == mujoco.mjtEq.mjEQ_JOINT:
        return any(end in shifted for end in ends)
    if kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
        sites = model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE
        bodies = [int(model.site_bodyid[end]) if sites else end for end in ends]
        return any(graph.node_of_body[body] == 0 for body in bodies)
    return kind != mujoco.mjtEq.mjEQ_TENDON  # a tendon's ends are judged with the tendon
