"""Build a scene from an MJCF model: compile it with frame sensors, read its graph."""

from __future__ import annotations

from functools import partial

import mujoco
import numpy as np

from torchrl_gn.scenes.contact_points import find_contact_points
from torchrl_gn.scenes.invariance import movable_components, translation_invariant
from torchrl_gn.scenes.scene import Attachment, Scene, SceneError, StaticGraph, UnsupportedSceneError
from torchrl_gn.scenes.static_features import static_graph
from torchrl_gn.scenes.topology import Topology, find_joint_anchors, offset, topology
from torchrl_gn.scenes.yaw_frame import find_yaw_frame

_FRAME_SENSORS = (  # 3 + 4 + 3 + 3 = 13 numbers a node, in the order of the state
    mujoco.mjtSensor.mjSENS_FRAMEPOS,
    mujoco.mjtSensor.mjSENS_FRAMEQUAT,
    mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    mujoco.mjtSensor.mjSENS_FRAMEANGVEL,
)


def build_scene(
    spec: mujoco.MjSpec, *, name: str, timestep: float | None = None, settle_steps: int = 0, origin: dict | None = None
) -> Scene:
    """Read a scene from an MJCF model.

    Works on a copy of the model: adds the frame sensors of every node last, names their unnamed bodies, switches
    sensors on, and warm starts and sleeping off, so that a step depends on ``(mjSTATE_FULLPHYSICS, ctrl)`` alone.
    Without ``timestep`` [s] a control step is one physics step. Raises as :func:`~torchrl_gn.scenes.load_scene`.
    """
    model, graph = _compile(spec, name)
    actuator_of_joint = _actuator_of_joint(model)
    substeps = _substeps(model, timestep, name)
    named = partial(_named, model)
    node_names = tuple(named(mujoco.mjtObj.mjOBJ_BODY, body) for body in graph.body)
    joint_names = tuple(named(mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in range(model.njnt))
    static = static_graph(model, graph, actuator_of_joint, substeps * model.opt.timestep)
    _refuse_non_finite(static, name, node_names, joint_names)
    data = mujoco.MjData(model)
    movable = movable_components(model, data, graph.body)
    mujoco.mj_resetData(model, data)
    mujoco.mj_kinematics(model, data)
    invariant = translation_invariant(model, data, graph)
    return Scene(
        name=name,
        model=model,
        node_names=node_names,
        joint_names=joint_names,
        actuator_names=tuple(named(mujoco.mjtObj.mjOBJ_ACTUATOR, motor) for motor in range(model.nu)),
        body=graph.body,
        parent=graph.parent,
        senders=graph.senders,
        receivers=graph.receivers,
        edge_action=np.repeat(actuator_of_joint, 2),
        static=static,
        movable=movable,
        translation_invariant=invariant,
        joint_anchors=find_joint_anchors(model, data, graph),
        yaw_frame=find_yaw_frame(model, data, graph, movable),
        contact_points=find_contact_points(model, data, graph),
        action_low=model.actuator_ctrlrange[:, 0].copy(),
        action_high=model.actuator_ctrlrange[:, 1].copy(),
        substeps=substeps,
        attachments=_attachments(model, graph),
        settle_steps=settle_steps,
        origin=origin or {},
    )


def _compile(spec: mujoco.MjSpec, name: str) -> tuple[mujoco.MjModel, Topology]:
    spec = spec.copy()
    flags = mujoco.mjtDisableBit
    spec.option.disableflags |= int(flags.mjDSBL_WARMSTART)
    spec.option.disableflags &= ~int(flags.mjDSBL_SENSOR)
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)  # MuJoCo before 3.4 has none
    spec.option.enableflags &= ~int(sleep)
    try:
        graph = topology(spec.compile())
        for body in spec.bodies:
            if body.id in graph.body:
                body.name = body.name or f"body{body.id}"
                for kind in _FRAME_SENSORS:
                    spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body.name)
        model = spec.compile()
    except ValueError as error:
        raise SceneError(f"MuJoCo cannot compile scene {name!r}: {error}") from error
    if model.njnt == 0:
        raise SceneError(f"Scene {name!r} has no joint, so nothing can move. Add one.")
    return model, graph


def _named(model: mujoco.MjModel, kind: mujoco.mjtObj, element: int) -> str:
    return mujoco.mj_id2name(model, kind, int(element)) or f"{kind.name.removeprefix('mjOBJ_').lower()}{element}"


def _actuator_of_joint(model: mujoco.MjModel) -> np.ndarray:
    """Actuator ``[J]`` of each joint, -1 without; refuse actuators that an edge cannot represent."""
    named = partial(_named, model)
    transmission = mujoco.mjtTrn
    actuators = np.full(model.njnt, -1, dtype=np.int64)
    # MuJoCo before 3.11 has one control an actuator, and before 3.5 no delays.
    controls = getattr(model, "actuator_ctrlnum", np.ones(model.nu, dtype=int))
    delays = getattr(model, "actuator_history", np.zeros((len(controls), 1), dtype=int))[:, 0]
    for motor in range(len(controls)):
        label = f"Actuator {named(mujoco.mjtObj.mjOBJ_ACTUATOR, motor)!r}"
        kind = transmission(model.actuator_trntype[motor])
        if kind not in (transmission.mjTRN_JOINT, transmission.mjTRN_JOINTINPARENT):
            what = kind.name.removeprefix("mjTRN_").lower()
            raise UnsupportedSceneError(
                f"{label} acts through a {what}, but an action must act on one joint."
                " Give it a joint transmission or remove it."
            )
        joint = int(model.actuator_trnid[motor, 0])
        if controls[motor] != 1:
            raise UnsupportedSceneError(f"{label} has {controls[motor]} controls; an edge takes one.")
        if model.actuator_dyntype[motor] != mujoco.mjtDyn.mjDYN_NONE or delays[motor] > 0:
            raise UnsupportedSceneError(
                f"{label} has activation dynamics or a delay, a state that body states do not"
                " show. Use dyntype none and no delay."
            )
        if not model.actuator_ctrllimited[motor]:
            raise UnsupportedSceneError(f"{label} has no bounds. Give it a ctrlrange (and ctrllimited).")
        if actuators[joint] >= 0:
            other = named(mujoco.mjtObj.mjOBJ_ACTUATOR, int(actuators[joint]))
            raise UnsupportedSceneError(
                f"{label} and actuator {other!r} drive the same joint "
                f"{named(mujoco.mjtObj.mjOBJ_JOINT, joint)!r}; an edge takes one action. Remove one."
            )
        actuators[joint] = motor
    if model.npluginstate:
        raise UnsupportedSceneError(
            f"Plugin {named(mujoco.mjtObj.mjOBJ_PLUGIN, 0)!r} has a state that body states do not show. Remove it."
        )
    return actuators


def _refuse_non_finite(static: StaticGraph, name: str, nodes: tuple[str, ...], joints: tuple[str, ...]) -> None:
    """Raise for NaN and infinity (damping="nan"), which MuJoCo compiles with only a warning."""
    parts = (
        (static.nodes, static.node_names, [f"body {node!r}" for node in nodes]),
        (static.edges, static.edge_names, [f"joint {joint!r}" for joint in joints for _ in range(2)]),
        (static.globals_[None], static.global_names, ["the options"]),
    )
    for values, features, owners in parts:
        for row, column in np.argwhere(~np.isfinite(values)):
            raise SceneError(
                f"{features[column]} of {owners[row]} in scene {name!r} is {values[row, column]};"
                " give finite numbers in the model."
            )


def _substeps(model: mujoco.MjModel, timestep: float | None, name: str) -> int:
    physics = model.opt.timestep
    if timestep is None:
        return 1
    substeps = round(timestep / physics) if np.isfinite(timestep) else 0
    if substeps < 1 or abs(substeps * physics - timestep) > 1e-6 * physics:
        raise SceneError(
            f"timestep={timestep} s is not a positive whole multiple of the physics step "
            f"{physics:g} s of scene {name!r}; the nearest is {max(substeps, 1) * physics:g} s."
        )
    return substeps


def _attachments(model: mujoco.MjModel, graph: Topology) -> dict[str, Attachment]:
    attachments = {}
    for body in np.setdiff1d(range(1, model.nbody), graph.body).tolist():
        node = int(graph.node_of_body[body])
        if name := mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body):
            attachments[name] = Attachment(node, *offset(model, body, int(graph.body[node])))
    return attachments
