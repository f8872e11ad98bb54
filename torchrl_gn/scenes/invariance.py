"""Translation invariance (shifts of a scene that leave its dynamics unchanged), and movable components."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.scenes.actuator_kinds import drive_joints
from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.topology import Topology, offset

TOLERANCE = 1e-9
_LOCKED = 1e8  # damping [N s/m or N m s/rad] or armature [kg or kg m2] that locks a joint
_Disable = mujoco.mjtDisableBit
_Transmission = mujoco.mjtTrn


def translation_invariant(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology) -> np.ndarray:
    """Find the world axes ``[3]``, bool, along which a shift of the scene leaves its dynamics unchanged.

    Along such an axis, slide or free joints without limit, spring or position actuator move every root, moving geoms
    touch no fixed geoms except parallel planes, and no equality constraint or tendon acts on the world or those joints.
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
    """Return the joints that shift a root body along ``axis``; None if the body cannot move along it."""
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
    if np.abs(matrix @ amounts - axis).max() > TOLERANCE:
        return None
    return [joint for joint, amount in zip(slides, amounts, strict=True) if abs(amount) > TOLERANCE]


def reference_rotation(model: mujoco.MjModel, body: int) -> np.ndarray:
    """Return the world orientation ``[3, 3]`` at the reference of a body whose ancestors are fixed."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, offset(model, body, 0)[1])
    return matrix.reshape(3, 3)


def depends_on_position(model: mujoco.MjModel, joint: int) -> bool:
    """Return True if a limit, spring or actuator of a joint depends on the joint's position."""
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


def actuators_of(model: mujoco.MjModel, *joints: int) -> np.ndarray:
    """Return the actuators that drive one of the joints directly."""
    return np.flatnonzero(drive_joints(model) & np.isin(model.actuator_trnid[:, 0], joints))


def collides_with_world(model: mujoco.MjModel, data: mujoco.MjData, graph: Topology, axis: np.ndarray) -> bool:
    """Return True if a moving geom can collide with a fixed one, except a non-turning plane parallel to ``axis``."""
    fixed = graph.node_of_body[model.geom_bodyid] == 0
    plane = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & ~surface_velocities(model)[:, 3:].any(1)
    parallel = plane & (np.abs(data.geom_xmat[:, 2::3] @ axis) < TOLERANCE)
    return bool(colliding_geoms(model)[np.ix_(fixed & ~parallel, ~fixed)].any())


def surface_velocities(model: mujoco.MjModel) -> np.ndarray:
    """Return surface velocities ``[G, 6]`` in the geoms' frames, linear and angular, as on conveyors or turntables."""
    return getattr(model, "geom_surfacevel", np.zeros((model.ngeom, 6))).reshape(model.ngeom, 6)  # since MuJoCo 3.11


def acts_on_position(model: mujoco.MjModel, graph: Topology, joints: set[int]) -> bool:
    """Return True if a constraint or tendon acts on the world or ``joints``, or an actuator of sites on the world."""
    if any(_actuator_acts(model, graph, actuator) for actuator in range(len(model.actuator_trntype))):
        return True
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
    return False


def _actuator_acts(model: mujoco.MjModel, graph: Topology, actuator: int) -> bool:
    """Return True if an actuator, except of a joint or tendon, depends on positions relative to the world."""
    sites = model.actuator_trnid[actuator]
    match int(model.actuator_trntype[actuator]):
        case _Transmission.mjTRN_JOINT | _Transmission.mjTRN_JOINTINPARENT | _Transmission.mjTRN_TENDON:
            return False  # checked with the joint or tendon
        case _Transmission.mjTRN_BODY:
            return False  # acts along contact normals
        case _Transmission.mjTRN_SITE if sites[1] < 0:
            return False  # acts in the site's own frame
        case _Transmission.mjTRN_SITE | _Transmission.mjTRN_SLIDERCRANK:
            return bool((graph.node_of_body[model.site_bodyid[sites]] == 0).any())
        case _:
            return True


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


def movable_components(model: mujoco.MjModel, data: mujoco.MjData, body: np.ndarray, *, samples: int = 8) -> np.ndarray:
    """Return the mask ``[N, 12]`` of movable components for root bodies ``[N]``; ``data`` is overwritten.

    Components, world frame: position 3, rotation vector 3, linear velocity 3, angular velocity 3. A row of the body
    Jacobian that vanishes at random configurations vanishes everywhere. Constraints are ignored; locked joints count
    as fixed.
    """
    rng, locked = np.random.default_rng(0), locked_dofs(model)
    largest = np.zeros((len(body), 6))  # largest entry of every Jacobian row
    jacobian = np.zeros((6, model.nv))
    free, ball = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
    joints = zip(model.jnt_type, model.jnt_qposadr, strict=True)
    orientations = [start + 3 * (kind == free) for kind, start in joints if kind in (free, ball)]
    for _ in range(samples):
        # Configurations may exceed joint limits, which do not change the rows that vanish.
        data.qpos[:] = rng.uniform(-np.pi, np.pi, model.nq)
        for start in orientations:
            quat = rng.normal(size=4)
            data.qpos[start : start + 4] = quat / np.linalg.norm(quat)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for node, body_id in enumerate(body):
            mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], int(body_id))
            jacobian[:, locked] = 0.0
            largest[node] = np.maximum(largest[node], np.abs(jacobian).max(axis=1, initial=0.0))
    moves = largest > TOLERANCE
    return np.concatenate([moves, moves], axis=1)


def locked_dofs(model: mujoco.MjModel) -> np.ndarray:
    """Find degrees of freedom ``[nv]``, bool, that damping or armature locks, as in Gymnasium's Fetch (1e11).

    A force of 1,000 N moves them by under 1e-5 m in a second.
    """
    return np.maximum(model.dof_damping, model.dof_armature) > _LOCKED
