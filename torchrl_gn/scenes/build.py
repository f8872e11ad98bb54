"""Build a scene from an MJCF model: compile it with frame sensors, read its graph."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from torchrl_gn.scenes.activations import find_activations
from torchrl_gn.scenes.contact_points import find_contact_points
from torchrl_gn.scenes.control_bounds import ActionBounds, set_control_bounds
from torchrl_gn.scenes.delays import find_delays, round_delays
from torchrl_gn.scenes.invariance import movable_components, translation_invariant
from torchrl_gn.scenes.keyframes import reference_keyframe
from torchrl_gn.scenes.mocap import NO_MOCAP_ACTIONS, MocapActions, find_mocap_actions
from torchrl_gn.scenes.mocap_checks import refuse_mocap_actions
from torchrl_gn.scenes.scene import Attachment, Scene, SceneError, StaticGraph
from torchrl_gn.scenes.simulated_invariance import confirmed
from torchrl_gn.scenes.static_features import static_graph
from torchrl_gn.scenes.topology import EdgePair, Topology, find_joint_anchors, free_name, named, offset, topology
from torchrl_gn.scenes.transmissions import Transmissions, find_transmissions
from torchrl_gn.scenes.unwrapped_angles import find_unwrapped_angles
from torchrl_gn.scenes.yaw_frame import find_yaw_frame

_FRAME_SENSORS = (  # 3 + 4 + 3 + 3 = 13 numbers a node, in the order of the state
    mujoco.mjtSensor.mjSENS_FRAMEPOS,
    mujoco.mjtSensor.mjSENS_FRAMEQUAT,
    mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    mujoco.mjtSensor.mjSENS_FRAMEANGVEL,
)
_REFERRING = ("actuators", "tendons", "equalities", "sensors", "excludes", "pairs")  # they refer to others by name
_CONTROL_STEP, _LONGEST_CONTROL_STEP = 0.02, 0.025  # seconds, by default
_MOST_SUBSTEPS = 10_000  # physics steps in a control step

# ctrlspec of an actuator with one control: a position, a velocity, a force or a voltage.
_POSITION_INPUT, _VELOCITY_INPUT, _FORCE_INPUT, _VOLTAGE_INPUT = 1, 2, 4, 8
_PARAMETERS = 10  # numbers of an actuator's gain, and of its bias
_TEXTURE = 128  # largest width and height, pixels
_LARGEST = 1e30  # largest static feature: networks read float32


def build_scene(
    spec: mujoco.MjSpec,
    *,
    name: str,
    timestep: float | None = None,
    settle_steps: int = 0,
    wide_starts: float = 0.5,
    action_bounds: ActionBounds | None = None,
    mocap_actions: bool = False,
    origin: dict | None = None,
) -> Scene:
    """Read a scene from an MJCF model.

    Works on a copy of the model: replaces its sensors by frame sensors of every node, names unnamed root bodies of
    nodes, switches warm starts and sleeping off, so that a step depends on ``(mjSTATE_FULLPHYSICS, ctrl)`` alone, lets
    MuJoCo clamp controls, as models do, and replaces PID controllers and DC motors without state by affine actuators.
    See :func:`~torchrl_gn.scenes.load_scene` for the default ``timestep`` [s] and the errors.
    """
    model, graph = _compile(spec, name)
    substeps = _substeps(model, timestep, name)
    _place_mocap_bodies(model)
    transmissions = find_transmissions(model, graph)
    pairs = transmissions.pairs
    actuator_names = tuple(named(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator) for actuator in range(model.nu))
    mocaps = find_mocap_actions(model, action_bounds) if mocap_actions else NO_MOCAP_ACTIONS
    if mocap_actions and not len(mocaps):
        raise SceneError(f"No mocap body of scene {name!r} leads others by a weld or connect: none can be an action.")
    refuse_mocap_actions(model, graph, mocaps)
    bounds = action_bounds
    if isinstance(bounds, Mapping):
        bounds = {key: pair for key, pair in bounds.items() if key not in mocaps.names}
    low, high = set_control_bounds(model, actuator_names, bounds)
    node_names = tuple(named(model, mujoco.mjtObj.mjOBJ_BODY, body) for body in graph.body)
    node_pairs = np.array([(pair.first, pair.second) for pair in pairs])
    numbers = read_numbers(model, transmissions, substeps, mocaps, is_system="system" in (origin or {}))
    _refuse_non_finite(numbers["static"], name, node_names, pairs)
    return Scene(
        name=name,
        model=model,
        node_names=node_names,
        joint_names=tuple(pair.name for pair in graph.pairs),
        actuator_names=actuator_names,
        body=graph.body,
        parent=graph.parent,
        pairs=pairs,
        senders=node_pairs.flatten(),
        receivers=node_pairs[:, ::-1].flatten(),
        edge_action=np.repeat(transmissions.action, 2, axis=0),
        mocaps=mocaps,
        action_low=np.concatenate((low, mocaps.low)),
        action_high=np.concatenate((high, mocaps.high)),
        substeps=substeps,
        settle_steps=settle_steps,
        wide_starts=wide_starts,
        origin=origin or {},
        **numbers,
    )


def read_numbers(
    model: mujoco.MjModel, acting: Transmissions, substeps: int, mocaps: MocapActions, *, is_system: bool
) -> dict[str, Any]:
    """Return a scene's fields that depend on lengths, masses and other numbers of its model, by name."""
    graph, data, at = topology(model), mujoco.MjData(model), (acting.pairs, acting.action)
    channels = {
        "activations": find_activations(model, *at),
        "delays": find_delays(model, *at, substeps),
        "unwrapped": find_unwrapped_angles(model, graph, acting.action),
    }
    bodies_move = movable_components(model, data, graph.body)
    mujoco.mj_resetData(model, data)
    mujoco.mj_kinematics(model, data)
    invariant, yaw_frame = translation_invariant(model, data, graph), find_yaw_frame(model, data, graph, bodies_move)
    if not is_system:  # systems' invariances are known, and they are built by the thousand
        invariant, yaw_frame = confirmed(model, graph, invariant, yaw_frame)
    return {
        "static": static_graph(model, graph, acting, substeps * model.opt.timestep),
        "movable": np.concatenate((bodies_move, *(each.mask(len(graph.body)) for each in channels.values())), axis=1),
        "translation_invariant": invariant,
        "yaw_frame": yaw_frame,
        "joint_anchors": find_joint_anchors(model, data, graph),
        "contact_points": find_contact_points(model, data, graph),
        "attachments": _attachments(model, graph, mocaps),
        **channels,
    }


def _compile(spec: mujoco.MjSpec, name: str) -> tuple[mujoco.MjModel, Topology]:
    flags = mujoco.mjtDisableBit
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)  # MuJoCo before 3.4 has none
    try:
        spec = _copy(spec)
        shrink_textures(spec, _TEXTURE)
        _simplify_controllers(spec)
        spec.option.disableflags |= int(flags.mjDSBL_WARMSTART)
        _converge(spec.option)
        spec.option.disableflags &= ~int(flags.mjDSBL_SENSOR | flags.mjDSBL_CLAMPCTRL)
        spec.option.enableflags &= ~int(sleep)
        graph = topology(compiled(spec))
        for sensor in list(spec.sensors):  # rays and contact forces can cost more than the rest of a step
            spec.delete(sensor)
        round_delays(spec)
        for body in spec.bodies:
            if body.id in graph.body:
                body.name = body.name or free_name(f"body{body.id}", lambda name: spec.body(name) is not None)
                for kind in _FRAME_SENSORS:
                    spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname=body.name)
        model = compiled(spec)
    except ValueError as error:
        raise SceneError(f"MuJoCo cannot compile scene {name!r}: {error}") from error
    if model.njnt == 0:
        raise SceneError(f"Scene {name!r} has no joint, so nothing can move. Add one.")
    return model, graph


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model without MuJoCo's deprecation warnings."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "compiler attribute .* is deprecated")
        return spec.compile()


def _simplify_controllers(spec: mujoco.MjSpec) -> None:
    """Make affine actuators of PID controllers and DC motors without state: their force is the same."""
    for actuator in spec.actuators:
        if (law := _affine_law(actuator)) is not None:
            gain, bias = law
            actuator.gaintype, actuator.gainprm = mujoco.mjtGain.mjGAIN_FIXED, [gain, *[0.0] * (_PARAMETERS - 1)]
            actuator.biastype, actuator.biasprm = mujoco.mjtBias.mjBIAS_AFFINE, [*bias, *[0.0] * (_PARAMETERS - 3)]
            actuator.dyntype, actuator.ctrlspec = mujoco.mjtDyn.mjDYN_NONE, _POSITION_INPUT


def _affine_law(actuator: mujoco.MjsActuator) -> tuple[float, list[float]] | None:
    """Return gain and bias ``[3]`` of a PID controller or DC motor without state; None for other actuators."""
    if not hasattr(actuator, "ctrlspec"):  # before MuJoCo 3.12
        return None
    kinds, gain, dynamics = mujoco.mjtGain, list(actuator.gainprm), list(actuator.dynprm)
    by_voltage, signal = None, int(actuator.ctrlspec)
    if actuator.gaintype == getattr(kinds, "mjGAIN_PID", None):
        if actuator.dyntype != mujoco.mjtDyn.mjDYN_NONE:
            return None
        bias = list(actuator.biasprm)[:3]
    elif actuator.gaintype == getattr(kinds, "mjGAIN_DCMOTOR", None):
        resistance, constant, stiffness, damping = gain[0], gain[1], gain[4], gain[6]
        if any([*gain[2:4], gain[5], *gain[7:], *dynamics, *actuator.biasprm]):  # heat, integral, cogging, ...
            return None
        bias, by_voltage, signal = [0.0, -stiffness, -damping], constant / resistance, signal or _VOLTAGE_INPUT
        if signal == _VOLTAGE_INPUT:
            bias = [0.0, 0.0, -constant * by_voltage]  # back electromotive force
    else:
        return None
    gains = {_POSITION_INPUT: -bias[1], _VELOCITY_INPUT: -bias[2], _FORCE_INPUT: 1.0, _VOLTAGE_INPUT: by_voltage}
    found = gains.get(signal)
    # Of affine actuators at sites, MuJoCo takes the error of an orientation within half a turn.
    at_site = actuator.trntype == mujoco.mjtTrn.mjTRN_SITE and (by_voltage or signal != _POSITION_INPUT)
    return None if found is None or at_site else (found, bias)


def shrink_textures(spec: mujoco.MjSpec, pixels: int) -> None:
    """Shrink generated textures; the suite's cost 80 ms and 12 MB per model, most of the loading time."""
    for texture in spec.textures:
        if texture.builtin != mujoco.mjtBuiltin.mjBUILTIN_NONE:
            texture.width, texture.height = min(texture.width, pixels), min(texture.height, pixels)


def _converge(option: mujoco.MjOption) -> None:
    """Give the constraint solver at least MuJoCo's default iterations and precision, so that it converges.

    Scenes have no warm starts, so that state and action determine the next state. Files that rely on warm starts, such
    as MJX's, ask for one to three iterations, which are too few from a cold start.
    """
    default = mujoco.MjSpec().option
    for name in ("iterations", "ls_iterations"):
        setattr(option, name, max(getattr(option, name), getattr(default, name)))
    for name in ("tolerance", "ls_tolerance"):
        setattr(option, name, min(getattr(option, name), getattr(default, name)))


def _place_mocap_bodies(model: mujoco.MjModel) -> None:
    """Set mocap bodies to their poses in the reference keyframe, from which simulations start."""
    if model.nmocap and (key := reference_keyframe(model)) is not None:
        bodies = np.flatnonzero(model.body_mocapid >= 0)
        which = model.body_mocapid[bodies]
        model.body_pos[bodies] = model.key_mpos[key].reshape(-1, 3)[which]
        model.body_quat[bodies] = model.key_mquat[key].reshape(-1, 4)[which]
        for quat in model.body_quat[bodies]:
            mujoco.mju_normalize4(quat)


def _copy(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Copy a model; ValueError if an element refers to a name that does not exist."""
    copied = spec.copy()
    # MuJoCo's copy drops such elements; compiling the original raises an error that names them.
    if any(len(getattr(copied, kind)) != len(getattr(spec, kind)) for kind in _REFERRING):
        spec.compile()
    return copied


def _refuse_non_finite(static: StaticGraph, name: str, nodes: tuple[str, ...], pairs: tuple[EdgePair, ...]) -> None:
    """Raise SceneError for NaN (damping="nan"), infinity and numbers beyond float32, all of which MuJoCo compiles."""
    parts = (
        (static.nodes, static.node_names, [f"body {node!r}" for node in nodes]),
        (static.edges, static.edge_names, [f"{pair.element} {pair.name!r}" for pair in pairs for _ in range(2)]),
        (static.globals_[None], static.global_names, ["the options"]),
    )
    for values, features, owners in parts:
        for row, column in np.argwhere(~(np.abs(values) < _LARGEST)):
            raise SceneError(
                f"{features[column]} of {owners[row]} in scene {name!r} is {values[row, column]};"
                f" give finite numbers below {_LARGEST:g} in the model."
            )


def _substeps(model: mujoco.MjModel, timestep: float | None, name: str) -> int:
    physics = model.opt.timestep
    control_step = _CONTROL_STEP if timestep is None or not np.isfinite(timestep) else timestep
    if not (0 < physics < np.inf and control_step / physics < _MOST_SUBSTEPS + 0.5):
        raise SceneError(
            f"The physics step of scene {name!r} is {physics:g} s, and a control step of {control_step:g} s may take at"
            f' most {_MOST_SUBSTEPS} of them: set <option timestep="0.002"/>, say, or another control step, timestep=.'
        )
    if timestep is None:
        nearest = max(1, round(_CONTROL_STEP / physics))
        return nearest - 1 if nearest > 1 and nearest * physics > _LONGEST_CONTROL_STEP * (1 + 1e-9) else nearest
    substeps = round(timestep / physics) if np.isfinite(timestep) else 0
    if substeps < 1 or abs(substeps * physics - timestep) > 1e-6 * physics:
        raise SceneError(
            f"timestep={timestep} s is not a positive whole multiple of the physics step "
            f"{physics:g} s of scene {name!r}; the nearest is {max(substeps, 1) * physics:g} s."
        )
    return substeps


def _attachments(model: mujoco.MjModel, graph: Topology, mocaps: MocapActions) -> dict[str, Attachment]:
    attachments, led = {}, np.flatnonzero(np.isin(model.body_rootid, mocaps.body))  # states lack their poses
    for body in np.setdiff1d(range(1, model.nbody), [*graph.body, *led]).tolist():
        node = int(graph.node_of_body[body])
        if name := mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, body):
            attachments[name] = Attachment(node, *offset(model, body, int(graph.body[node])))
    return attachments
