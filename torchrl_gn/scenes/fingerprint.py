"""Fingerprint of a scene: a hash of the physical quantities its motion depends on.

It reads an explicit list of MuJoCo arrays, by names of elements, without visuals, sensors, keyframes and derived
quantities. Zero quantities give no text, so adding an array to the list keeps the fingerprints of models where it is
zero.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from torchrl_gn.scenes.actuator_kinds import in_disabled_group
from torchrl_gn.scenes.topology import Topology, offset, topology

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

_OBJECT, _GEOM, _WRAP, _JOINT = mujoco.mjtObj, mujoco.mjtGeom, mujoco.mjtWrap, mujoco.mjtJoint

_TARGETS = {"TENDON": _OBJECT.mjOBJ_TENDON, "BODY": _OBJECT.mjOBJ_BODY}  # of transmissions; all others act at sites

_OPTIONS = (
    *("timestep", "gravity", "wind", "density", "viscosity", "impratio"),
    *("tolerance", "ls_tolerance", "noslip_tolerance", "ccd_tolerance"),
    *("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations", "sdf_initpoints"),
)
_OVERRIDES = ("o_margin", "o_solref", "o_solimp", "o_friction")
_REPORTING_FLAGS = {"mjDSBL_SENSOR", "mjENBL_ENERGY", "mjENBL_FWDINV"}  # no effect on motion
_JOINTS = ("stiffness", "stiffnesspoly", "margin", "solref", "solimp", "actgravcomp")
_DOFS = ("damping", "dampingpoly", "armature", "frictionloss", "solref", "solimp")
_ACTUATORS = ("gear", "gainprm", "biasprm", "ctrlrange", "armature", "damping", "dampingpoly", "cranklength", "delay")
_CONTACTS = ("friction", "solref", "solimp", "solmix", "margin", "gap", "condim", "priority", "contype", "conaffinity")
_GEOMS = (*_CONTACTS, "adhesion", "surfacevel", "fluid")
_PAIRS = ("friction", "solref", "solreffriction", "solimp", "margin", "gap", "dim", "adhesion")
_TENDONS = (
    *("stiffness", "stiffnesspoly", "damping", "dampingpoly", "armature", "frictionloss", "margin"),
    *("solref_lim", "solimp_lim", "solref_fri", "solimp_fri"),
)
_FLEXES = (
    *("contype", "conaffinity", "condim", "priority", "friction", "solref", "solimp", "solmix", "margin", "gap"),
    *("dim", "radius", "edgestiffness", "edgedamping", "damping", "selfcollide", "rigid", "edgeequality"),
)


def physics(scene: Scene) -> list[str]:
    """List every element and quantity, one per line, numbers to six significant digits."""
    model, graph = scene.model, topology(scene.model)
    names = _Names(scene, graph)
    return [
        *(*scene.node_names, *scene.joint_names, *scene.actuator_names),
        f"substeps {scene.substeps}",
        *_line("bounds", _digits([*scene.action_low, *scene.action_high])),
        *_options(model),
        *_bodies(model, graph, names),
        *_joints(model, names),
        *_actuators(model, names),
        *_geoms(model, names),
        *_tendons(model, names),
        *_equalities(model, names),
        *_flexes_and_plugins(model),
    ]


def _options(model: mujoco.MjModel) -> Iterable[str]:
    option = model.opt
    for name in _OPTIONS:
        yield from _line(name, _digits(_field(option, name)))
    kinds = (mujoco.mjtIntegrator(option.integrator), mujoco.mjtCone(option.cone), mujoco.mjtSolver(option.solver))
    yield from (kind.name for kind in kinds)
    flags = [
        key
        for kind, value in ((mujoco.mjtDisableBit, option.disableflags), (mujoco.mjtEnableBit, option.enableflags))
        for key, bit in kind.__members__.items()
        if value & int(bit) and not key.startswith("mjN") and key not in _REPORTING_FLAGS
    ]
    yield from flags
    if "mjENBL_OVERRIDE" in flags:
        for name in _OVERRIDES:
            yield from _line(name, _digits(getattr(option, name)))


def _bodies(model: mujoco.MjModel, graph: Topology, names: _Names) -> Iterable[str]:
    for node, root in enumerate(graph.body[1:], 1):
        parent = int(graph.parent[node])
        pos, quat = offset(model, int(root), int(graph.body[parent]))
        yield from _line(f"node {names.nodes[node]} on {names.nodes[parent]}", _clean_digits([*pos, *_matrix(quat)]))
        for body in np.flatnonzero((graph.node_of_body == node) & (model.body_mass > 0)):
            # Rotated inertia, as the principal axes of a round body are rounding noise.
            pos, rotation = names.pose(int(body), model.body_ipos[body], model.body_iquat[body])
            inertia = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
            element = f"body of {names.nodes[node]}"
            yield from _line(f"{element} mass", _digits(model.body_mass[body]))
            yield from _line(f"{element} center", _clean_digits(pos))
            yield from _line(f"{element} inertia", _clean_digits(inertia, np.abs(inertia).max()))
            yield from _line(f"{element} gravcomp", _digits(model.body_gravcomp[body]))


def _joints(model: mujoco.MjModel, names: _Names) -> Iterable[str]:
    for joint, label in enumerate(names.joints):
        kind = _JOINT(model.jnt_type[joint])
        element, dof, qpos = f"joint {label}", int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        yield f"{element} {kind.name} {names.body(int(model.jnt_bodyid[joint]))}"
        dofs, numbers = {_JOINT.mjJNT_FREE: (6, 7), _JOINT.mjJNT_BALL: (3, 4)}.get(kind, (1, 1))
        yield from _line(f"{element} axis", _clean_digits(model.jnt_axis[joint]))
        yield from _line(f"{element} pos", _clean_digits(model.jnt_pos[joint]))
        if numbers == 1:
            yield from _line(f"{element} reference", _clean_digits(model.qpos0[qpos]))
        if np.any(model.jnt_stiffness[joint]) or np.any(_field(model, "jnt_stiffnesspoly", joint)):
            yield from _line(f"{element} spring", _clean_digits(model.qpos_spring[qpos : qpos + numbers]))
        yield from _arrays(element, model, "jnt", joint, _JOINTS)
        yield from _arrays(f"{element} freedom", model, "dof", slice(dof, dof + dofs), _DOFS)
        yield from _limits(element, model, "jnt", joint, ("range", "limited"), ("actfrcrange", "actfrclimited"))


def _actuators(model: mujoco.MjModel, names: _Names) -> Iterable[str]:
    kinds = (("trntype", mujoco.mjtTrn), ("gaintype", mujoco.mjtGain), ("biastype", mujoco.mjtBias))
    for motor in range(len(model.actuator_trntype)):
        element = f"actuator {names.of(_OBJECT.mjOBJ_ACTUATOR, motor)}"
        types = [kind(getattr(model, f"actuator_{name}")[motor]).name for name, kind in kinds]
        targets, kind = model.actuator_trnid[motor].tolist(), types[0].removeprefix("mjTRN_")
        joint = [names.joints[targets[0]]] if kind.startswith("JOINT") else []
        yield " ".join([element, *joint, *types, *["off"] * in_disabled_group(model, motor)])
        for at in () if joint else targets:
            yield from names.element(_TARGETS.get(kind, _OBJECT.mjOBJ_SITE), at)
        yield from _arrays(element, model, "actuator", motor, _ACTUATORS)
        yield from _limits(element, model, "actuator", motor, ("forcerange", "forcelimited"))
        if model.actuator_actnum[motor] > 0:
            kind, count = mujoco.mjtDyn(model.actuator_dyntype[motor]).name, int(model.actuator_actnum[motor])
            yield " ".join([element, kind, str(count), *["early"] * bool(model.actuator_actearly[motor])])
            yield from _arrays(element, model, "actuator", motor, ("dynprm",))
            yield from _limits(element, model, "actuator", motor, ("actrange", "actlimited"))
        if "mjGAIN_MUSCLE" in types:
            yield from _arrays(element, model, "actuator", motor, ("lengthrange",))


def _geoms(model: mujoco.MjModel, names: _Names) -> Iterable[str]:
    """List geoms that can collide or feel a fluid, explicit contact pairs, and excluded pairs of bodies."""
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    for geom in np.flatnonzero(colliding | (model.geom_fluid[:, 0] > 0)):
        yield from _geom(model, int(geom), names)
    for pair in range(model.npair):
        for geom in (int(model.pair_geom1[pair]), int(model.pair_geom2[pair])):
            yield from ("pair", *_geom(model, geom, names))
        yield from _arrays("pair", model, "pair", pair, _PAIRS)
    for signature in model.exclude_signature:
        yield "exclude " + " ".join(names.of(_OBJECT.mjOBJ_BODY, int(body)) for body in divmod(int(signature), 1 << 16))


def _geom(model: mujoco.MjModel, geom: int, names: _Names) -> Iterable[str]:
    kind, body = _GEOM(model.geom_type[geom]), int(model.geom_bodyid[geom])
    element = f"geom of {names.body(body)}"
    yield f"{element} {kind.name}"
    pos, rotation = names.pose(body, model.geom_pos[geom], model.geom_quat[geom])
    if kind in (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_SDF):
        yield from _mesh(element, model, int(model.geom_dataid[geom]), pos, rotation)
    else:
        yield from _line(f"{element} pose", _clean_digits([*pos, *rotation.flat]))
        if kind != _GEOM.mjGEOM_PLANE:  # a plane's size is only drawn
            yield from _line(f"{element} size", _digits(model.geom_size[geom]))
    if kind == _GEOM.mjGEOM_HFIELD:
        field = int(model.geom_dataid[geom])
        yield from _line(f"{element} extent", _digits(model.hfield_size[field]))
        start, shape = int(model.hfield_adr[field]), (int(model.hfield_nrow[field]), int(model.hfield_ncol[field]))
        heights = model.hfield_data[start : start + shape[0] * shape[1]]
        digest = hashlib.sha256(heights.round(4).tobytes()).hexdigest()[:16]  # heights have single precision
        yield f"{element} heights {shape} {digest}"
    yield from _arrays(element, model, "geom", geom, _GEOMS)


def _mesh(element: str, model: mujoco.MjModel, mesh: int, pos: np.ndarray, rotation: np.ndarray) -> Iterable[str]:
    """List moments of a mesh's vertices in the node's frame; the mesh's own principal axes may be rounding noise."""
    start = int(model.mesh_vertadr[mesh])
    vertices = model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])].astype(np.float64) @ rotation.T + pos
    center = vertices.mean(0)
    covariance = (vertices - center).T @ (vertices - center) / len(vertices)
    size = np.sqrt(np.trace(covariance))
    shape = np.concatenate((center / size, covariance.ravel() / size**2)).round(4) + 0.0
    yield from _line(f"{element} mesh", [f"{size:.4g}", *(f"{value:.4f}" for value in shape)])


def _tendons(model: mujoco.MjModel, names: _Names) -> Iterable[str]:
    for tendon in range(model.ntendon):
        element, first = f"tendon {names.of(_OBJECT.mjOBJ_TENDON, tendon)}", int(model.tendon_adr[tendon])
        for wrap in range(first, first + int(model.tendon_num[tendon])):
            kind, at = _WRAP(model.wrap_type[wrap]), int(model.wrap_objid[wrap])
            objects = {_WRAP.mjWRAP_JOINT: _OBJECT.mjOBJ_JOINT, _WRAP.mjWRAP_SITE: _OBJECT.mjOBJ_SITE}
            around = (_WRAP.mjWRAP_SPHERE, _WRAP.mjWRAP_CYLINDER)
            yield f"{element} {kind.name}"
            yield from names.element(_OBJECT.mjOBJ_GEOM if kind in around else objects.get(kind), at)
            if kind in around:  # the site that selects the side
                yield from names.element(_OBJECT.mjOBJ_SITE, int(model.wrap_prm[wrap]))
            else:
                yield from _line(f"{element} factor", _digits(model.wrap_prm[wrap]))
        if np.any(model.tendon_stiffness[tendon]) or np.any(_field(model, "tendon_stiffnesspoly", tendon)):
            yield from _line(f"{element} spring", _clean_digits(model.tendon_lengthspring[tendon]))
        yield from _arrays(element, model, "tendon", tendon, _TENDONS)
        yield from _limits(element, model, "tendon", tendon, ("range", "limited"), ("actfrcrange", "actfrclimited"))


def _equalities(model: mujoco.MjModel, names: _Names) -> Iterable[str]:
    for equality in range(model.neq):
        element = f"equality {mujoco.mjtEq(model.eq_type[equality]).name}"
        yield f"{element} {'on' if model.eq_active0[equality] else 'off'}"
        for at in (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])):
            yield from names.element(_OBJECT(model.eq_objtype[equality]), at)
        yield from _line(f"{element} data", _clean_digits(model.eq_data[equality]))
        yield from _arrays(element, model, "eq", equality, ("solref", "solimp"))


def _flexes_and_plugins(model: mujoco.MjModel) -> Iterable[str]:
    for flex in range(model.nflex):
        yield from _arrays("flex", model, "flex", flex, _FLEXES)
    for name in ("elem", "stiffness", "bending"):
        values = getattr(model, f"flex_{name}").astype(np.float64)
        yield from _line(f"flex {name}", _clean_digits(values, np.abs(values).max(initial=0.0)))
    if model.nplugin:
        yield "plugins " + bytes(model.plugin_attr).decode(errors="replace")


class _Names:
    """Names of a scene's elements, and their poses in the frame of their node."""

    def __init__(self, scene: Scene, graph: Topology) -> None:
        self.model, self.graph = scene.model, graph
        self.nodes, self.joints = scene.node_names, scene.joint_names

    def of(self, kind: mujoco.mjtObj, element: int) -> str:
        return mujoco.mj_id2name(self.model, kind, element) or ""

    def body(self, body: int) -> str:
        """Return the name of a body's node."""
        return self.nodes[int(self.graph.node_of_body[body])]

    def pose(self, body: int, pos: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return position ``[3]`` and rotation ``[3, 3]``, in the node's frame, of an element fixed to a body."""
        origin, orientation = offset(self.model, body, int(self.graph.body[self.graph.node_of_body[body]]))
        frame = _matrix(orientation).reshape(3, 3)
        return origin + frame @ pos, frame @ _matrix(quat).reshape(3, 3)

    def element(self, kind: mujoco.mjtObj | None, element: int) -> Iterable[str]:
        """List the element that a tendon or constraint acts on."""
        model = self.model
        if kind is None or element < 0:
            return
        if kind == _OBJECT.mjOBJ_GEOM:
            yield from _geom(model, element, self)
        elif kind == _OBJECT.mjOBJ_SITE:
            body = int(model.site_bodyid[element])
            pos, rotation = self.pose(body, model.site_pos[element], model.site_quat[element])
            yield from _line(f"site of {self.body(body)}", _clean_digits([*pos, *rotation.flat]))
        elif kind == _OBJECT.mjOBJ_BODY:
            pos, rotation = self.pose(element, np.zeros(3), np.array([1.0, 0, 0, 0]))
            yield from _line(f"body of {self.body(element)}", _clean_digits([*pos, *rotation.flat]))
        elif kind == _OBJECT.mjOBJ_JOINT:
            yield f"joint {self.joints[element]}"
        else:
            yield f"{kind.name} {self.of(kind, element)}"


def _arrays(
    element: str, model: mujoco.MjModel, prefix: str, index: int | slice, names: Iterable[str]
) -> Iterable[str]:
    for name in names:
        yield from _line(f"{element} {name}", _digits(_field(model, f"{prefix}_{name}", index)))


def _field(owner: mujoco.MjModel | mujoco.MjOption, name: str, index: int | slice | None = None) -> Any:
    """Return a field, or zero if this version of MuJoCo lacks it."""
    values = getattr(owner, name, None)
    return 0.0 if values is None else values if index is None else values[index]


def _limits(element: str, model: mujoco.MjModel, prefix: str, index: int, *limits: tuple[str, str]) -> Iterable[str]:
    """List the ranges that are in force."""
    for name, flag in limits:
        if getattr(model, f"{prefix}_{flag}")[index]:
            yield f"{element} {flag}"
            yield from _line(f"{element} {name}", _digits(getattr(model, f"{prefix}_{name}")[index]))


def _line(what: str, numbers: list[str]) -> Iterable[str]:
    """Join numbers, without trailing zeros, as their count depends on MuJoCo's version; nothing if all are zero."""
    while numbers and numbers[-1] == "0":
        numbers.pop()
    if numbers:
        yield " ".join([what, *numbers])


def _digits(values) -> list[str]:
    """Format numbers to six significant digits, without -0."""
    # The factor moves decimals such as 0.001234375 off rounding ties, where compilers differ.
    return [f"{value:.6g}" for value in np.asarray(values, dtype=np.float64).ravel() * (1 + 1.4142e-7) + 0.0]


def _clean_digits(values, scale: float = 1.0) -> list[str]:
    """Format like :func:`_digits`, with magnitudes below 1e-9 of ``scale``, rounding noise, set to zero."""
    values = np.asarray(values, dtype=np.float64)
    return _digits(np.where(np.abs(values) < 1e-9 * scale, 0.0, values))


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Return a quaternion's rotation matrix ``[9]``, which has no sign ambiguity."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix
