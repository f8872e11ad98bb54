"""Random controls that fit their actuators: torques, positions or velocities."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from torchrl_gn.data.control_limits import ControlLimits, find_control_limits, slow_targets
from torchrl_gn.data.controls import check_knot_interval, spline_controls
from torchrl_gn.data.holding import pose_holding_controls
from torchrl_gn.data.mocap_paths import mocap_paths
from torchrl_gn.data.servo_targets import position_targets, velocity_targets
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.tracking import tracking_controls
from torchrl_gn.scenes.actuator_kinds import actuator_kind
from torchrl_gn.scenes.control_bounds import require_bounds
from torchrl_gn.scenes.keyframes import reference_keyframe

Pace = Literal["mixed", "calm", "fast", "full"]
"""Speed of random controls; see :func:`random_controls`."""

_SCALES = (0.2, 1.0)  # factor per sequence of motors, velocity targets and position target speeds
_FAST, _FULL = 0.3, 1 / 3  # share of fast sequences if mixed, and of these with motors at full amplitude
_HELD = 0.25  # share of the calm sequences that hold the state
_LEAST_WIDTH, _HELD_WIDTH = 0.05, 0.02  # share of the bounds in which position targets stay: least, held
_LEAST_SIZE = 0.1  # least amplitude of limited motors, as a share of their limits
_DISTURBANCE = 0.3  # of motors that follow a path, as a share of that amplitude


def random_controls(
    simulator: Simulator,
    physics: np.ndarray,
    steps: int,
    rng: int | np.random.Generator,
    *,
    knot_interval: float = 10.0,
    pace: Pace = "mixed",
    variant: np.ndarray | None = None,
) -> np.ndarray:
    """Draw smooth action sequences ``[n, T, A]`` from states ``[n, S]``, float64, in the actuators' units.

    Systems of the paper get :func:`~torchrl_gn.data.spline_controls`. Controls of other models depend on ``pace``:

    - ``"full"``: the paper's splines, scaled in each sequence by a factor in [0.2, 1] towards the controls of the
      reference keyframe, or towards 0. A planner may choose such controls.
    - ``"fast"``: Position targets move as fast as their joints can follow within their speed limits
      (:class:`~torchrl_gn.data.control_limits.ControlLimits`), or as in ``"full"`` if no target needs a limit. Motors
      get full splines if joints then keep their speed limits. Otherwise the splines of motors have a tenth to all of
      the limited amplitude, around the controls that balance gravity in the start state, if these exist.
    - ``"calm"``: Position targets start at the target that holds the start state. They follow splines within a random
      part of the bounds around that target. Their speed is at most 0.2 to 1 times pi rad/s or 1 m/s of their joint, or
      the bounds' width per second if less. A quarter of the sequences hold the state, within 2 % of the bounds. Motors
      whose full splines exceed the speed limits follow such joint paths by inverse dynamics, disturbed by splines.
      Where motors cannot do so alone, as in legs, they get the splines of ``"fast"``.
    - ``"mixed"``: Three tenths of the sequences are fast; motors get full splines in a third of the fast sequences. The
      other sequences are calm.

    Velocity servos at every pace follow splines whose knots alternate in sign, 1 to 4 ``knot_interval`` apart, scaled
    in each sequence by a factor in [0.2, 1]. They are treated as motors if their bounds exclude one direction. Poses of
    mocap bodies follow smooth paths from the model's pose, slower in calm sequences.

    Args:
        knot_interval: least time between knots, in control steps.
        variant: scene ``[n]`` of each sequence; default: the scenes in turn.

    Raises:
        ValueError: ``knot_interval`` is not above 0 and finite, or ``pace`` is unknown.
        SceneError: an action has no bounds.
    """
    scene, n = simulator.scene, len(physics)
    rng = np.random.default_rng(rng)
    check_pace(pace)
    if len(scene.mocaps):
        options = {"knot_interval": knot_interval, "pace": pace}
        controls = random_controls(simulator.without_mocap_actions, physics, steps, rng, **options, variant=variant)
        calm = rng.random(n) >= {"mixed": _FAST, "calm": 0.0}.get(pace, 1.0)
        paths = mocap_paths(scene, n, steps, rng, knot_interval=knot_interval, calm=calm)
        return np.concatenate((controls, paths), axis=-1)
    if "system" in scene.origin or not (n and steps and scene.num_actions):
        return spline_controls(scene, n, steps, rng, knot_interval=knot_interval)
    check_knot_interval(knot_interval)
    require_bounds(scene)
    model, low, high, rest_control = scene.model, scene.action_low, scene.action_high, _rest_controls(simulator)
    kinds = np.array([actuator_kind(model, actuator) for actuator in range(model.nu)])
    scale = rng.uniform(*_SCALES, (n, 1, 1))
    splines = spline_controls(scene, n, steps, rng, knot_interval=knot_interval)
    controls = rest_control + scale * (splines - rest_control)
    reversing = (kinds == "velocity") & (low < 0) & (high > 0)
    if reversing.any():
        low_high = low[reversing], high[reversing]
        controls[..., reversing] = scale * velocity_targets(*low_high, n, steps, knot_interval, rng)
    if pace == "full" or not (limits := _limits(simulator, knot_interval)):
        return controls
    variant = np.arange(n) % len(simulator.scenes) if variant is None else variant
    holding = np.clip(pose_holding_controls(simulator, physics, variant, rest_control), low, high)
    fast = rng.random(n) < {"mixed": _FAST, "calm": 0.0, "fast": 1.0}[pace]
    held = ~fast & (rng.random(n) < _HELD)
    servos, motors = kinds == "position", ~reversing & (kinds != "position")
    if (limits.amplitude < 1).any():
        full = fast & (rng.random(n) < (_FULL if pace == "mixed" else 0.0))
        size = limits.amplitude * _LEAST_SIZE ** rng.uniform(0.0, 1.0, (n, 1, 1))
        noise, rows = size * (splines - rest_control), np.flatnonzero(~fast)
        bounded = np.clip(holding[:, None] + noise, low, high)
        share = np.where(held, _HELD_WIDTH, _LEAST_WIDTH ** rng.uniform(0.0, 1.0, n))[:, None]
        paths = {"width": share[rows], "speed": scale[rows, 0], "knot_interval": knot_interval}
        states, drawn = (physics[rows], variant[rows]), (controls[rows], _DISTURBANCE * noise[rows])
        if (tracking := tracking_controls(simulator, *states, *drawn, rng, **paths)) is not None:
            bounded[rows] = tracking
        controls = np.where(~full[:, None, None] & motors, bounded, controls)
    if servos.any():
        slow = scale[:, 0] * slow_targets(model)
        speed = (np.where(fast[:, None], np.fmax(limits.target_speed, slow), slow) * scene.timestep)[:, servos]
        width = _LEAST_WIDTH ** rng.uniform(0.0, 1.0, speed.shape)
        width[held] = _HELD_WIDTH * rng.uniform(0.0, 1.0, (int(held.sum()), width.shape[1]))
        bounds = low[servos], high[servos]
        targets = position_targets(holding[:, servos], *bounds, width, speed, steps, knot_interval, rng)
        free = (fast[:, None] & np.isinf(limits.target_speed[servos]))[:, None]
        controls[..., servos] = np.where(free, controls[..., servos], targets)
    return controls


def has_paces(simulator: Simulator, knot_interval: float = 10.0) -> bool:
    """Return True if random controls of a scene depend on their pace."""
    simulator = simulator.without_mocap_actions
    limits = _limits(simulator, knot_interval)
    kinds = {actuator_kind(simulator.scene.model, actuator) for actuator in range(simulator.scene.model.nu)}
    return limits is not None and ("position" in kinds or bool((limits.amplitude < 1).any()))


def check_pace(pace: str) -> None:
    """Raise ValueError for an unknown pace."""
    if pace not in get_args(Pace):
        raise ValueError(f"pace={pace!r} is not known; use one of {list(get_args(Pace))}.")


def _rest_controls(simulator: Simulator) -> np.ndarray:
    """Return the controls ``[A]`` of the reference keyframe, or those nearest to 0 within the bounds."""
    scene, key = simulator.scene, reference_keyframe(simulator.scene.model)
    controls = np.zeros(scene.num_actions) if key is None else scene.model.key_ctrl[key]
    return np.clip(controls, scene.action_low, scene.action_high)


def _limits(simulator: Simulator, knot_interval: float) -> ControlLimits | None:
    """Return the control limits, found once per simulator; None for the paper's systems and without actions."""
    if "system" in simulator.scene.origin or not simulator.scene.num_actions:
        return None
    if knot_interval not in simulator.control_limits:
        simulator.control_limits[knot_interval] = find_control_limits(
            simulator, _rest_controls(simulator), knot_interval
        )
    return simulator.control_limits[knot_interval]
