"""Static features of a scene (paper, SM "Mujoco variables included in the graph conversion").

All scenes share one set of columns, which differs from the paper's list:

* no ``opt.collision``, and ``actuator_acc0`` for ``actuator_invweight0``: MuJoCo dropped both;
* ``timestep`` is the control step;
* ``dof_damping``, ``dof_armature`` and ``dof_frictionloss`` of the joint's first degree of freedom are added;
* a node's mass, inertia, ipos and iquat are composites of its bodies, in the root body's frame; pos and quat are
  relative to the parent node's root;
* one-hot types and option bits are named after the enumerations of the installed MuJoCo.

Some scenes have further columns: the actuators' columns again for the second and further control slots of an edge,
named ``name/1``, ``name/2``, ...; ``actuator_trntype`` of every slot if some actuator does not act through a joint; and
``eq_...`` if a constraint has edges. Edges without a joint have zeros in the joint's columns.
"""

from __future__ import annotations

import re

import mujoco
import numpy as np

from torchrl_gn.scenes.actuator_kinds import drive_joints
from torchrl_gn.scenes.constraints import joined_frames
from torchrl_gn.scenes.scene import StaticGraph
from torchrl_gn.scenes.topology import Topology, offset
from torchrl_gn.scenes.transmissions import Transmissions

Columns = list[tuple[str, np.ndarray]]


def static_graph(model: mujoco.MjModel, graph: Topology, acting: Transmissions, timestep: float) -> StaticGraph:
    """Compute the static features; ``timestep`` is the control step in seconds."""
    nodes, node_names = _join(_node_columns(model, graph), len(graph.body))
    pairs, pair_names = _join(_pair_columns(model, graph, acting), len(acting.pairs))
    globals_, global_names = _join(_global_columns(model, timestep), 1)
    direction = np.tile([1.0, -1.0], len(pairs))
    edges = np.concatenate([direction[:, None], np.repeat(pairs, 2, axis=0)], axis=1)
    return StaticGraph(nodes, edges, globals_[0], node_names, ("direction", *pair_names), global_names)


def _join(columns: Columns, rows: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """Concatenate ``[rows]`` and ``[rows, k]`` columns; the latter are named ``name[i]``, or ``name[i]/slot``."""
    arrays, names = [], []
    for name, values in columns:
        values = np.asarray(values, dtype=np.float64)
        arrays.append(values.reshape(rows, -1))
        base, slash, slot = name.partition("/")
        names += [name] if values.ndim < 2 else [f"{base}[{i}]{slash}{slot}" for i in range(values.shape[1])]
    return np.concatenate(arrays, axis=1), tuple(names)


def _members(enum: type, prefix: str) -> list[tuple[str, int]]:
    return [(key.removeprefix(prefix), int(value)) for key, value in enum.__members__.items()]


def is_member(name: str) -> bool:
    """Return True if a feature is one type of several or one flag, such as ``"actuator_biastype[SO3]"``."""
    return re.fullmatch(r"(\w+type|enableflags|disableflags)\[[A-Z]\w*\](/\d+)?", name) is not None


def _one_hot(name: str, values: np.ndarray, enum: type, prefix: str) -> Columns:
    return [(f"{name}[{key}]", (values == code).astype(float)) for key, code in _members(enum, prefix)]


def _bits(name: str, value: int, enum: type, prefix: str) -> Columns:
    return [
        (f"{name}[{key}]", np.array([float(bool(value & code))]))
        for key, code in _members(enum, prefix)
        if not key.startswith("mjN")  # the number of bits, not a bit
    ]


def _global_columns(model: mujoco.MjModel, timestep: float) -> Columns:
    opt = model.opt
    scalars = ("density", "viscosity", "impratio", "o_margin")
    vectors = ("gravity", "wind", "magnetic", "o_solref", "o_solimp")
    return [
        ("timestep", np.array([timestep])),
        *[(name, np.array([getattr(opt, name)])) for name in scalars],
        *[(name, getattr(opt, name)[None]) for name in vectors],
        *_bits("enableflags", opt.enableflags, mujoco.mjtEnableBit, "mjENBL_"),
        *_bits("disableflags", opt.disableflags, mujoco.mjtDisableBit, "mjDSBL_"),
    ]


def _node_columns(model: mujoco.MjModel, graph: Topology) -> Columns:
    rows = []
    for node, root in enumerate(graph.body):
        parent = int(graph.body[graph.parent[node]]) if node else 0
        bodies = np.flatnonzero(graph.node_of_body == node)
        rows.append((*offset(model, int(root), parent), *_composite(model, bodies, int(root))))
    pos, quat, mass, inertia, ipos, iquat = (np.array(column) for column in zip(*rows, strict=True))
    return [("mass", mass), ("pos", pos), ("quat", quat), ("inertia", inertia), ("ipos", ipos), ("iquat", iquat)]


def _composite(
    model: mujoco.MjModel, bodies: np.ndarray, root: int
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Return the mass, principal inertia ``[3]``, its origin ``[3]`` and its frame ``[4]`` of welded bodies."""
    heavy = [int(body) for body in bodies if model.body_mass[body] > 0]
    if len(heavy) <= 1 and (not heavy or heavy[0] == root):
        return model.body_mass[root], model.body_inertia[root], model.body_ipos[root], model.body_iquat[root]

    mass = model.body_mass[heavy].sum()
    centers, tensors = [], []
    for body in heavy:
        pos, quat = offset(model, body, root)
        center, principal, matrix = np.empty(3), np.empty(4), np.empty(9)
        mujoco.mju_rotVecQuat(center, model.body_ipos[body], quat)
        mujoco.mju_mulQuat(principal, quat, model.body_iquat[body])
        mujoco.mju_quat2Mat(matrix, principal)
        rotation = matrix.reshape(3, 3)
        centers.append(pos + center)
        tensors.append(rotation @ np.diag(model.body_inertia[body]) @ rotation.T)
    center = np.average(centers, axis=0, weights=model.body_mass[heavy])
    total = np.zeros((3, 3))
    for body, point, tensor in zip(heavy, centers, tensors, strict=True):
        shift = point - center
        total += tensor + model.body_mass[body] * (shift @ shift * np.eye(3) - np.outer(shift, shift))  # Steiner
    inertia, vectors, iquat = np.empty(3), np.empty(9), np.empty(4)
    mujoco.mju_eig3(inertia, vectors, iquat, total.reshape(-1))
    return mass, inertia, center, iquat


def _pair_columns(model: mujoco.MjModel, graph: Topology, acting: Transmissions) -> Columns:
    motorized = acting.action >= 0
    dof, count = model.jnt_dofadr, len(acting.pairs)
    vectors = ("axis", "pos", "solimp", "solref", "stiffness", "limited", "range", "margin")
    joints: Columns = [
        *_one_hot("jnt_type", model.jnt_type, mujoco.mjtJoint, "mjJNT_"),
        *[(f"jnt_{name}", getattr(model, f"jnt_{name}")) for name in vectors],
        *[(f"dof_{name}", getattr(model, f"dof_{name}")[dof]) for name in ("damping", "armature", "frictionloss")],
    ]
    is_joint = np.arange(count) < model.njnt
    columns: Columns = [(name, _placed(values, is_joint)) for name, values in joints]
    actuators = _actuator_columns(model)
    for slot, (acts, actuator) in enumerate(zip(motorized.T, acting.action.T, strict=True)):
        actuator_columns: Columns = [("motorized", acts.astype(float))]
        for name, values in actuators:
            exerted = acting.gear[acts, slot] if name == "actuator_gear" else values[actuator[acts]]
            actuator_columns.append((name, _placed(exerted, acts)))
        suffixed = [(f"{name}/{slot}", values) for name, values in actuator_columns]
        columns = [actuator_columns[0], *columns, *actuator_columns[1:]] if slot == 0 else [*columns, *suffixed]
    return columns + _constraint_columns(model, graph, acting.equality)


def _placed(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Place the rows of ``values`` at the pairs ``where`` ``[P]``, bool; zeros elsewhere."""
    placed = np.zeros((len(where), *values.shape[1:]))
    placed[where] = values
    return placed


def _constraint_columns(model: mujoco.MjModel, graph: Topology, equality: np.ndarray) -> Columns:
    constrained, which = equality >= 0, equality[equality >= 0]
    if not len(which):
        return []
    positions = [
        [position for _, position, _ in sorted(joined_frames(model, graph, one), key=lambda end: end[0])]
        for one in which.tolist()
    ]
    first, second = np.array(positions).transpose(1, 0, 2)
    columns: Columns = [
        *_one_hot("eq_type", model.eq_type[which], mujoco.mjtEq, "mjEQ_"),
        *[("eq_first_anchor", first), ("eq_second_anchor", second)],
        *[("eq_solref", model.eq_solref[which]), ("eq_solimp", model.eq_solimp[which])],
    ]
    return [(name, _placed(values, constrained)) for name, values in columns]


def _actuator_columns(model: mujoco.MjModel) -> Columns:
    vectors = (
        *("biasprm", "cranklength", "ctrllimited", "ctrlrange", "dynprm", "forcelimited", "forcerange"),
        *("gainprm", "gear", "acc0", "length0", "lengthrange"),
    )
    return [
        *_one_hot("actuator_biastype", model.actuator_biastype, mujoco.mjtBias, "mjBIAS_"),
        *_one_hot("actuator_dyntype", model.actuator_dyntype, mujoco.mjtDyn, "mjDYN_"),
        *_one_hot("actuator_gaintype", model.actuator_gaintype, mujoco.mjtGain, "mjGAIN_"),
        *[(f"actuator_{name}", getattr(model, f"actuator_{name}")) for name in vectors],
        *(
            _one_hot("actuator_trntype", model.actuator_trntype, mujoco.mjtTrn, "mjTRN_")
            if not drive_joints(model).all()
            else ()
        ),
    ]
