"""Numbers of a MuJoCo model that change nothing, whatever their value."""

from __future__ import annotations

import re

import mujoco
import numpy as np

from torchrl_gn.scenes.actuator_kinds import in_disabled_group

_COMPUTED = (  # by MuJoCo, from the model's other numbers
    "actuator_acc0",
    "actuator_length0",
    "body_invweight0",
    "body_margin",
    "body_subtreemass",
    "dof_M0",
    "dof_invweight0",
    "dof_length",
    "geom_aabb",
    "geom_rbound",
    "tendon_invweight0",
    "tendon_length0",
)
_UNIT = ("body_quat", "body_iquat", "geom_quat", "jnt_axis")
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_WITHOUT_ANCHOR = (_FREE, int(mujoco.mjtJoint.mjJNT_SLIDE))
_SHAPED_BY_DATA = {
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
    int(mujoco.mjtGeom.mjGEOM_HFIELD): "height field",
    int(mujoco.mjtGeom.mjGEOM_SDF): "signed distance field",
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
}
_WRAPS = (int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER))
_WITHOUT_PARAMETERS = (int(mujoco.mjtDyn.mjDYN_NONE), int(mujoco.mjtDyn.mjDYN_INTEGRATOR))
_LOOKS = r"\w+_user|\w+_rgba|tendon_width"
_SWITCHES = {  # parts of the physics that <flag> switches off
    "SPRING": r"(jnt|tendon)_(stiffness|stiffnesspoly)|tendon_lengthspring",
    "DAMPER": r"(dof|tendon)_(damping|dampingpoly)",
    "FRICTIONLOSS": r"(dof|tendon)_frictionloss|dof_sol(ref|imp)|tendon_sol(ref|imp)_fri",
    "LIMIT": r"(jnt|tendon)_(range|margin)|jnt_sol(ref|imp)|tendon_sol(ref|imp)_lim",
    "CONTACT": r"geom_(friction|margin|gap|sol\w+|adhesion|surfacevel)",
    "GRAVITY": r"body_gravcomp",
    "ACTUATION": r"actuator_(gear|gainprm|biasprm|dynprm|ctrlrange|forcerange|actrange|cranklength|lengthrange|delay)",
}
_SWITCHES["CONSTRAINT"] = "|".join(_SWITCHES[switch] for switch in ("FRICTIONLOSS", "LIMIT", "CONTACT"))


def why_idle(model: mujoco.MjModel, array: str, index: int) -> str | None:
    """Return why a number of the body, joint, geom, actuator or tendon ``index`` changes no motion, or None."""
    if array in _COMPUTED:
        return "MuJoCo computes it from other numbers"
    if array in _UNIT:
        return "it is a direction, which a factor does not turn"
    if re.fullmatch(_LOOKS, array):
        return "physics does not read it"
    for switch, arrays in _SWITCHES.items():
        bit = getattr(mujoco.mjtDisableBit, f"mjDSBL_{switch}", None)
        if re.fullmatch(arrays, array) and bit is not None and model.opt.disableflags & int(bit):
            return f"the model's disableflags switch {switch.lower()} off"
    return {"body": _body, "jnt": _joint, "dof": _dof, "geom": _geom, "actuator": _actuator, "tendon": _tendon}[
        array.split("_")[0]
    ](model, array.split("_", 1)[1], index)


def _body(model: mujoco.MjModel, name: str, index: int) -> str | None:
    if name in ("mass", "inertia", "ipos", "gravcomp") and model.body_treeid[index] < 0:
        return "no joint moves the body"
    if name == "pos" and model.body_jntnum[index] and model.jnt_type[model.body_jntadr[index]] == _FREE:
        return "a free joint places the body"
    if name in ("inertia", "ipos") and not (_turns(model, index) or model.opt.density or model.opt.viscosity):
        return "no joint turns the body"
    return None


def _turns(model: mujoco.MjModel, body: int) -> bool:
    """Return True if a joint of a body, or of one that carries it, is not a slide."""
    dof = int(model.body_dofadr[body]) + int(model.body_dofnum[body]) - 1
    if model.body_dofnum[body] == 0:
        return body != 0 and _turns(model, int(model.body_parentid[body]))
    while dof >= 0:
        if model.jnt_type[model.dof_jntid[dof]] != int(mujoco.mjtJoint.mjJNT_SLIDE):
            return True
        dof = int(model.dof_parentid[dof])
    return False


def _joint(model: mujoco.MjModel, name: str, index: int) -> str | None:
    if name in ("range", "margin", "solref", "solimp") and not model.jnt_limited[index]:
        return "the joint has no limits"
    if name == "pos" and int(model.jnt_type[index]) in _WITHOUT_ANCHOR:
        return "a free or slide joint has no anchor"
    if name == "actfrcrange" and not model.jnt_actfrclimited[index]:
        return "the joint's actuator force has no limits"
    return None


def _dof(model: mujoco.MjModel, name: str, index: int) -> str | None:
    if name in ("solref", "solimp") and not model.dof_frictionloss[model.dof_jntid == index].any():
        return "the joint has no friction loss"
    return None


def _geom(model: mujoco.MjModel, name: str, index: int) -> str | None:
    shape = _SHAPED_BY_DATA.get(int(model.geom_type[index]))
    if name == "size" and shape is not None:
        return f"the shape of a {shape} does not depend on it"
    off = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    collides = not model.opt.disableflags & off
    touches = collides and (model.geom_contype[index] or model.geom_conaffinity[index])
    if name in ("friction", "margin", "gap", "solref", "solimp", "solmix"):
        if not touches:
            return "the geom touches nothing, apart from <pair>s, which have their own numbers"
        if name not in ("solmix", "gap") and model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_OVERRIDE):
            return "the model overrides it for all contacts"
    paired = collides and (index in model.pair_geom1 or index in model.pair_geom2)
    wraps = index in model.wrap_objid[np.isin(model.wrap_type, _WRAPS)]
    if name in ("size", "pos") and not (touches or paired or wraps or model.geom_fluid[index].any()):
        return "the geom touches nothing"
    return None


def _actuator(model: mujoco.MjModel, name: str, index: int) -> str | None:
    if in_disabled_group(model, index) and re.fullmatch(_SWITCHES["ACTUATION"], f"actuator_{name}"):
        return "the model switches the actuator's group off"
    for each, limited in (("ctrlrange", "ctrllimited"), ("forcerange", "forcelimited"), ("actrange", "actlimited")):
        if name == each and not getattr(model, f"actuator_{limited}")[index]:
            return "this range is not a limit of the actuator"
    crank = int(mujoco.mjtTrn.mjTRN_SLIDERCRANK)
    if name == "cranklength" and model.actuator_trntype[index] != crank:
        return "the actuator is not a slider-crank"
    if name == "dynprm" and model.actuator_dyntype[index] in _WITHOUT_PARAMETERS:
        return "the actuator has no activation, or only integrates its control"
    if name == "gear" and model.actuator_trntype[index] == int(mujoco.mjtTrn.mjTRN_BODY):
        return "adhesion has no gear"
    if name == "biasprm" and model.actuator_biastype[index] == int(mujoco.mjtBias.mjBIAS_NONE):
        return "the actuator has no bias force"
    if name == "lengthrange" and model.actuator_gaintype[index] != int(mujoco.mjtGain.mjGAIN_MUSCLE):
        return "the actuator is not a muscle"
    return None


def _tendon(model: mujoco.MjModel, name: str, index: int) -> str | None:
    limits = ("range", "margin", "solref_lim", "solimp_lim")
    if name in limits and not model.tendon_limited[index]:
        return "the tendon has no limits"
    if name in ("solref_fri", "solimp_fri") and not model.tendon_frictionloss[index]:
        return "the tendon has no friction loss"
    if name == "actfrcrange" and not model.tendon_actfrclimited[index]:
        return "the tendon's actuator force has no limits"
    return None
