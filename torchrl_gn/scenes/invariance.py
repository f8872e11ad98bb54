"""Invariances: shifts and rotations of a scene that leave its dynamics unchanged, and what can move at all."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.topology import Topology

_TOLERANCE = 1e-9
_Disable, _Trn = mujoco.mjtDisableBit, mujoco.mjtTrn


def translation_invariant(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology) -> np.ndarray:
    """Axes ``[3]``, bool, along which the dynamics do not depend on where the scene is.

    Along such an axis, slide or free joints without limit, spring or position actuator move every root, contacts with
    fixed geoms are with parallel planes alone, and no equality constraint or tendon acts on the world or those joints.
    Scenes with plugins or flexes count as not invariant. ``data`` must be at its reference, kinematics done.
    """
    return np.array([_invariant_along(model, data, graph, axis) for axis in np.eye(3)])


def _invariant_along(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, axis: np.ndarray) -> bool:
    if model.nplugin or model.nflex:
        return False
    shifting = [_joints_along(model, int(root), axis) for root in graph.body[graph.parent == 0]]
    shifted = {joint for joints in shifting for joint in joints or ()}  # joints whose displacement shifts the scene
    return (
        None not in shifting
        and not any(depends_on_position(model, joint) for joint in shifted)
        and not collides_with_world(model, data, graph, axis)
        and not acts_on_position(model, graph, shifted)
    )


def _joints_along(model: mujoco.MjModel, body: int, axis: np.ndarray) -> list[int] | None:
    """Joints that shift a root body along ``axis``; None if it cannot move along it."""
    slides, frame = [], reference_rotation(model, body)
    first = model.body_jntadr[body]
    for joint in range(first, first + model.body_jntnum[body]):
        kind = mujoco.mjtJoint(model.jnt_type[joint])
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            return [joint]
        if kind != mujoco.mjtJoint.mjJNT_SLIDE:
            break  # this joint rotates the axes of later slides
        slides.append(joint)
    if not slides:
        return None
    matrix = np.array([frame @ model.jnt_axis[joint] for joint in slides]).T  # [3, slides]
    amounts = np.linalg.lstsq(matrix, axis, rcond=None)[0]
    if np.abs(matrix @ amounts - axis).max() > _TOLERANCE:
        return None
    return [joint for joint, amount in zip(slides, amounts, strict=True) if abs(amount) > _TOLERANCE]


def reference_rotation(model: mujoco.MjModel, body: int) -> np.ndarray:
    """World orientation ``[3, 3]`` at the reference of a body below fixed bodies."""
    rotation = np.eye(3)
    while body:
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, model.body_quat[body])
        rotation = matrix.reshape(3, 3) @ rotation
        body = int(model.body_parentid[body])
    return rotation


def depends_on_position(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a limit, spring or actuator of a joint depends on the joint's position."""
    stiffness = [model.jnt_stiffness, getattr(model, "jnt_stiffnesspoly", None)]  # since MuJoCo 3.7
    if model.jnt_limited[joint] or any(np.any(table[joint]) for table in stiffness if table is not None):
        return True
    gains, biases = mujoco.mjtGain, mujoco.mjtBias
    for actuator in actuators_of(model, joint):
        gain = gains(model.actuator_gaintype[actuator])
        bias = biases(model.actuator_biastype[actuator])
        known = gain in (gains.mjGAIN_FIXED, gains.mjGAIN_AFFINE) and bias in (biases.mjBIAS_NONE, biases.mjBIAS_AFFINE)
        if not known or gain == gains.mjGAIN_AFFINE and model.actuator_gainprm[actuator, 1]:
            return True
        if bias == biases.mjBIAS_AFFINE and model.actuator_biasprm[actuator, 1]:
            return True
    return False


def collides_with_world(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, axis: np.ndarray | None) -> bool:
    """Whether a moving geom can collide with a fixed one other than a plane parallel to ``axis``."""
    fixed = graph.node_of_body[model.geom_bodyid] == 0
    for other in np.flatnonzero(fixed):
        normal = data.geom_xmat[other].reshape(3, 3)[:, 2]
        plane = model.geom_type[other] == mujoco.mjtGeom.mjGEOM_PLANE
        parallel = plane and axis is not None and abs(normal @ axis) < _TOLERANCE
        if not parallel and any(can_collide(model, int(other), int(moving)) for moving in np.flatnonzero(~fixed)):
            return True
    return False


def can_collide(model: mujoco.MjModel, first: int, second: int) -> bool:
    """Whether two geoms' masks, or an explicit pair, let them collide."""
    if model.opt.disableflags & (_Disable.mjDSBL_CONTACT | _Disable.mjDSBL_CONSTRAINT):
        return False
    pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    return bool(
        model.geom_contype[first] & model.geom_conaffinity[second]
        or model.geom_contype[second] & model.geom_conaffinity[first]
        or any({first, second} == set(pair) for pair in pairs)
    )


def acts_on_position(model: mujoco.MjModel, graph: Topology, joints: set[int]) -> bool:
    """Whether an equality constraint, a tendon or a pair of sites acts on the world or on one of ``joints``."""
    constrained = not model.opt.disableflags & (_Disable.mjDSBL_EQUALITY | _Disable.mjDSBL_CONSTRAINT)
    if constrained and any(_equality_acts(model, graph, equality, joints) for equality in range(model.neq)):
        return True
    fixed_site = graph.node_of_body[model.site_bodyid] == 0
    fixed_geom = graph.node_of_body[model.geom_bodyid] == 0
    wrap = mujoco.mjtWrap
    for code, element in zip(model.wrap_type, model.wrap_objid, strict=True):
        match wrap(code):
            case wrap.mjWRAP_JOINT if int(element) in joints:
                return True
            case wrap.mjWRAP_SITE if fixed_site[element]:
                return True
            case wrap.mjWRAP_SPHERE | wrap.mjWRAP_CYLINDER if fixed_geom[element]:
                return True
    between_sites = np.isin(model.actuator_trntype, [int(kind) for kind in (_Trn.mjTRN_SITE, _Trn.mjTRN_SLIDERCRANK)])
    ends = model.actuator_trnid[between_sites]
    return bool(fixed_site[ends[ends[:, 1] >= 0]].any())


def actuators_of(model: mujoco.MjModel, joint: int) -> np.ndarray:
    """Ids of the actuators that act on a joint, other than through tendons."""
    direct = np.isin(model.actuator_trntype, [int(kind) for kind in (_Trn.mjTRN_JOINT, _Trn.mjTRN_JOINTINPARENT)])
    return np.flatnonzero(direct & (model.actuator_trnid[:, 0] == joint))


def _equality_acts(model: mujoco.MjModel, graph: Topology, equality: int, joints: set[int]) -> bool:
    kind = mujoco.mjtEq(model.eq_type[equality])
    ends = (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    if kind == mujoco.mjtEq.mjEQ_JOINT:
        return any(end in joints for end in ends)
    if kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
        sites = model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE
        bodies = [int(model.site_bodyid[end]) if sites else end for end in ends]
        return any(graph.node_of_body[body] == 0 for body in bodies)
    return kind != mujoco.mjtEq.mjEQ_TENDON  # a tendon's ends are checked with the tendon


@dataclass(frozen=True, eq=False)
class YawFrame:
    """Yaw of a rotation-invariant scene: the rotation of its root about a world axis."""

    exact: bool  # False if moving geoms can touch fixed ones, so that contacts depend on the yaw
    node: int  # root node
    axis: int  # 0, 1 or 2 for the world's x, y or z
    pivot: np.ndarray  # [3] a point on the axis, metres; 0 if the scene is translation-invariant across it
    rest: np.ndarray  # [4] the root's orientation at yaw 0


def find_yaw_frame(
    model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, movable: np.ndarray, translation_invariant: np.ndarray
) -> YawFrame | None:
    """Yaw frame of a scene, or None if its dynamics depend on the yaw other than by contacts.

    The scene must be one tree whose root has slides, if any, then a hinge about a world axis. Gravity and wind must be
    parallel to that axis. No limit, spring, tendon, equality constraint or position actuator may depend on the hinge,
    and slides across the axis must be alike and without motors. ``data`` must be at its reference, kinematics done.
    """
    roots = np.flatnonzero(graph.parent == 0)
    if len(roots) != 1 or model.nplugin or model.nflex:
        return None
    node = int(roots[0])
    body = int(graph.body[node])
    first = int(model.body_jntadr[body])
    *slides, hinge = range(first, first + int(model.body_jntnum[body]))
    kinds = [*[mujoco.mjtJoint.mjJNT_SLIDE] * len(slides), mujoco.mjtJoint.mjJNT_HINGE]
    if model.jnt_type[[*slides, hinge]].tolist() != list(map(int, kinds)) or depends_on_position(model, hinge):
        return None
    rest = reference_rotation(model, body)
    directions = np.abs(rest @ model.jnt_axis[hinge])
    axis = int(directions.argmax())
    if abs(directions[axis] - 1) > _TOLERANCE:
        return None
    across = [index for index in range(3) if index != axis]
    flow = model.opt.wind if model.opt.density or model.opt.viscosity else np.zeros(3)
    weight = np.zeros(3) if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY else model.opt.gravity
    if np.abs(flow[across]).max() > _TOLERANCE or np.abs(weight[across]).max() > _TOLERANCE:
        return None
    lateral = [slide for slide in slides if abs((rest @ model.jnt_axis[slide])[axis]) < 1 - _TOLERANCE]
    if lateral and not (_isotropic(model, lateral, rest, across) and translation_invariant[across].all()):
        return None
    if acts_on_position(model, graph, {hinge, *lateral}):
        return None
    vectors = movable.reshape(len(movable), 4, 3)
    if not np.array_equal(vectors[..., across[0]], vectors[..., across[1]]):
        return None
    pivot = np.zeros(3) if lateral else data.xanchor[hinge].copy()
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rest.ravel())
    return YawFrame(not collides_with_world(model, data, graph, None), node, axis, pivot, quat)


def _isotropic(model: mujoco.MjModel, slides: list[int], rest: np.ndarray, across: list[int]) -> bool:
    """Whether slides span the plane across the axis orthogonally, with equal passive forces and no motors."""
    directions = np.array([(rest @ model.jnt_axis[slide])[across] for slide in slides])
    if directions.shape != (2, 2) or np.abs(directions @ directions.T - np.eye(2)).max() > _TOLERANCE:
        return False
    if any(len(actuators_of(model, slide)) for slide in slides):
        return False
    dofs = model.jnt_dofadr[slides]
    names = ("dof_damping", "dof_dampingpoly", "dof_armature", "dof_frictionloss")
    table = [getattr(model, name) for name in names if hasattr(model, name)]  # MuJoCo before 3.7 has no dampingpoly
    return all(np.array_equal(values[dofs[0]], values[dofs[1]]) for values in table)


def movable_components(model: mujoco.MjModel, data: mujoco.MjData, body: np.ndarray, *, samples: int = 8) -> np.ndarray:
    """Mask ``[N, 12]`` of movable components for root bodies ``[N]``; ``data`` is overwritten.

    Components, world frame: position 3, rotation vector 3, linear velocity 3, angular velocity 3. A row of the body
    Jacobian that vanishes at random configurations vanishes everywhere. Constraints are ignored.
    """
    rng = np.random.default_rng(0)
    largest = np.zeros((len(body), 6))  # largest entry of every Jacobian row
    jacobian = np.zeros((6, model.nv))
    free, ball = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
    joints = zip(model.jnt_type, model.jnt_qposadr, strict=True)
    orientations = [start + 3 * (kind == free) for kind, start in joints if kind in (free, ball)]
    for _ in range(samples):
        # Also beyond limits, which do not change the rows that vanish.
        data.qpos[:] = rng.uniform(-np.pi, np.pi, model.nq)
        for start in orientations:
            quat = rng.normal(size=4)
            data.qpos[start : start + 4] = quat / np.linalg.norm(quat)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for node, body_id in enumerate(body):
            mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], int(body_id))
            largest[node] = np.maximum(largest[node], np.abs(jacobian).max(axis=1, initial=0.0))
    moves = largest > _TOLERANCE
    return np.concatenate([moves, moves], axis=1)
