"""Tendons with their own forces: the joints at which they act, and their parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.scenes.force_elements import FAR, known_moments, straight_joints
from torchrl_gn.scenes.lines import geom_in_node, known_tendon, moved_joints, tendon_ends, tendon_pieces
from torchrl_gn.scenes.topology import site_in_node, topology

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

_DISABLE = mujoco.mjtDisableBit


def tendon_joints(scene: Scene, tendon: int) -> list[int]:
    """Return the joints that a tendon moves."""
    model = scene.model
    wraps = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if is_fixed(model, tendon):
        return sorted(set(model.wrap_objid[wraps].tolist()))
    graph = topology(model)
    return moved_joints(graph, tendon_ends(model, graph, tendon))


def is_fixed(model: mujoco.MjModel, tendon: int) -> bool:
    """Return True if a tendon is a sum of joint coordinates."""
    return model.wrap_type[model.tendon_adr[tendon]] == int(mujoco.mjtWrap.mjWRAP_JOINT)


def tendon_laws(model: mujoco.MjModel) -> np.ndarray:
    """Return ``[T, 7]`` of each tendon: 2 limits, 2 ends of its spring's rest range, stiffness, damping, dry friction.

    Limits are where the constraint's force sets in, ``tendon_margin`` inside the range. Forces that the model switches
    off have 0.
    """
    off = model.opt.disableflags
    laws = np.zeros((model.ntendon, 7))
    laws[:, :2] = -FAR, FAR
    if not off & (_DISABLE.mjDSBL_LIMIT | _DISABLE.mjDSBL_CONSTRAINT):
        limited = model.tendon_limited.astype(bool)
        laws[limited, :2] = (model.tendon_range + model.tendon_margin[:, None] * [1, -1])[limited]
    laws[:, 2:4] = model.tendon_lengthspring
    for column, name, flag in ((4, "stiffness", "mjDSBL_SPRING"), (5, "damping", "mjDSBL_DAMPER")):
        if not off & int(getattr(_DISABLE, flag, 0) or _DISABLE.mjDSBL_PASSIVE):  # one flag for both in older MuJoCo
            values = getattr(model, f"tendon_{name}")
            laws[:, column] = values if values.ndim == 1 else values[:, 0]
    if not off & (_DISABLE.mjDSBL_FRICTIONLOSS | _DISABLE.mjDSBL_CONSTRAINT):
        laws[:, 6] = model.tendon_frictionloss
    return laws


def acting_tendons(scene: Scene) -> tuple[list[int], list[int]]:
    """Find tendons with their own forces, and actuated spatial tendons that pull at balls or free bodies.

    Forces of their own come from limits, spring, damping or friction. Returns two lists: tendons whose length and
    moments follow from body states, and the others.
    """
    model = scene.model
    if not model.ntendon:
        return [], []
    laws = tendon_laws(model)
    has_law = (np.abs(laws[:, :2]) < FAR).any(1) | laws[:, 4:].any(1) | curved_tendons(model)
    driven = model.actuator_trnid[model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON), 0]
    straight = straight_joints(scene)
    known, others = [], []
    for tendon in range(model.ntendon):
        joints, fixed = tendon_joints(scene, tendon), is_fixed(model, tendon)
        if not joints or not (has_law[tendon] or (tendon in driven and not fixed and not straight[joints].all())):
            continue
        follows = length_follows(scene, tendon) and not curved_tendons(model)[tendon]
        (known if follows else others).append(tendon)
    return known, others


def length_follows(scene: Scene, tendon: int) -> bool:
    """Return True if a tendon's length and moments follow from body states."""
    joints = tendon_joints(scene, tendon)
    if not is_fixed(scene.model, tendon):
        return known_tendon(scene.model, tendon) and bool(known_moments(scene)[joints].all())
    return bool(straight_joints(scene)[joints].all())


def curved_tendons(model: mujoco.MjModel) -> np.ndarray:
    """Find tendons ``[T]``, bool, with a nonlinear spring or damper."""
    curved = np.zeros(model.ntendon, dtype=bool)
    for name in ("stiffnesspoly", "dampingpoly"):  # since MuJoCo 3.7
        values = getattr(model, f"tendon_{name}", None)
        if values is not None:
            curved |= values.any(axis=tuple(range(1, values.ndim)))
    return curved


def tendon_coefficients(model: mujoco.MjModel) -> np.ndarray:
    """Return the coefficients ``[T, J]`` of joint coordinates in fixed tendons; 0 in spatial ones."""
    coefficients = np.zeros((model.ntendon, model.njnt))
    for tendon in range(model.ntendon):
        for wrap in range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon]):
            if is_fixed(model, tendon):
                coefficients[tendon, model.wrap_objid[wrap]] += model.wrap_prm[wrap]
    return coefficients


def tendon_scales(model: mujoco.MjModel) -> np.ndarray:
    """Return the largest change ``[T]`` of each tendon's length if a joint moves by 0.1 rad or 2 cm; at least 1 mm."""
    data, step, lengths = mujoco.MjData(model), 1e-6, []
    turning = np.ones(model.nv, dtype=bool)
    for joint, kind in enumerate(model.jnt_type.tolist()):
        sliding = {int(mujoco.mjtJoint.mjJNT_SLIDE): 1, int(mujoco.mjtJoint.mjJNT_FREE): 3}.get(kind, 0)
        turning[model.jnt_dofadr[joint] :][:sliding] = False
    for change in (np.zeros(model.nv), *(step * np.eye(model.nv))):
        data.qpos[:] = model.qpos0
        mujoco.mj_integratePos(model, data.qpos, change, 1.0)
        for stage in ("kinematics", "comPos", "tendon"):
            getattr(mujoco, f"mj_{stage}")(model, data)
        lengths.append(data.ten_length.copy())
    arms = np.abs(np.array(lengths[1:]).reshape(model.nv, -1) - lengths[0]) / step
    return (arms * np.where(turning, 0.1, 0.02)[:, None]).max(0, initial=1e-3)


def tendon_numbers(scene: Scene) -> list[list[float]]:
    """Return parameters of tendons, slider-cranks and site actuators that features read but samples lack."""
    at_sites = (int(mujoco.mjtTrn.mjTRN_SITE), int(mujoco.mjtTrn.mjTRN_SLIDERCRANK))
    model, graph, rows = scene.model, topology(scene.model), []
    for tendon, law in enumerate(tendon_laws(model)):
        rows.append([*law, *tendon_coefficients(model)[tendon], model.tendon_length0[tendon]])
        for piece in tendon_pieces(model, tendon):
            sites = [site for site in (piece.first, piece.second, piece.side) if site >= 0]
            rows.append([piece.divisor, *(number for site in sites for number in site_in_node(model, graph, site)[1])])
            if piece.geom >= 0:
                _, position, frame = geom_in_node(model, graph, piece.geom)
                rows.append([*position, *frame.ravel(), model.geom_size[piece.geom, 0]])
    for actuator in np.flatnonzero(np.isin(model.actuator_trntype, at_sites)).tolist():
        sites = [site for site in model.actuator_trnid[actuator].tolist() if site >= 0]
        poses = [number for site in sites for pose in site_in_node(model, graph, site)[1:] for number in pose]
        rows.append([*poses, *model.actuator_gear[actuator], model.actuator_cranklength[actuator]])
    if rows:  # moment arms at the joints
        rows.append(model.jnt_pos.ravel().tolist())
    return [np.round(row, 9).tolist() for row in rows]
