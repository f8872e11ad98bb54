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
"""How fast random controls are: see :func:`random_controls`."""

_SCALES = (0.2, 1.0)  # of motors, velocity targets and the speed of position targets, by sequence
_FAST, _FULL = 0.3, 1 / 3  # share of the sequences of the mixture, and of these of motors at full amplitude
_HELD = 0.25  # share of the calm sequences
_LEAST_WIDTH, _HELD_WIDTH = 0.05, 0.02  # of the interval of position targets, as a share of the bounds
_LEAST_SIZE = 0.1  # of calm motors, as a share of their limits
_DISTURBANCE = 0.3  # of motors that follow a path, as a share of that


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

    Systems of the paper get :func:`~torchrl_gn.data.spline_controls`. Actuators of other models, by kind and pace:

    - velocity servos: splines whose knots alternate in sign, 1 to 4 ``knot_interval`` apart, scaled in each sequence
      by a factor in [0.2, 1]; as motors if the bounds do not include both directions.
    - ``"full"``, all others: the paper's splines, scaled in each sequence by a factor in [0.2, 1] towards the controls
      of the reference keyframe, or towards 0. A planner may choose such controls.
    - ``"fast"``: position targets are as fast as their joints follow at sane speeds
      (:class:`~torchrl_gn.data.control_limits.ControlLimits`); at any speed if that is sane. Motors have full splines
      if these are sane, else splines of a tenth to all of the amplitude that is, around what balances gravity in the
      given state, if they can.
    - ``"calm"``: position targets from the one that holds the given state, on splines within a random part of the
      bounds around it; in a second they move at most 0.2 to 1 times the bounds' width, pi rad or 1 m of their joint. A
      quarter of the sequences holds the state, within 2 % of the bounds. Motors whose full splines are not sane follow
      such paths of their joints by inverse dynamics, disturbed by splines; where they cannot alone, as of legs, they
      are as fast ones.
    - ``"mixed"``: three tenths of the sequences are fast, of motors a third of these full; the others are calm.

    Poses of mocap bodies follow smooth paths from that of the model, slow ones in calm sequences.

    Args:
        knot_interval: least time between knots, in control steps.
        variant: ``[n]``, scene of each sequence; default: the scenes in turn.

    Raises:
        ValueError: ``knot_interval`` is not above 0 and finite, or ``pace`` is unknown.
        SceneError: an action has no bounds.
    """
    scene, n = simulator.scene, len(physics)
    rng = np.random.default_rng(rng)
    check_pace(pace)
    if len(scene.mocaps):
        given = {"knot_interval": knot_interval, "pace": pace}
        controls = random_controls(simulator.without_mocap_actions, physics, steps, rng, **given, variant=variant)
        calm = rng.random(n) >= {"mixed": _FAST, "calm": 0.0}.get(pace, 1.0)
        paths = mocap_paths(scene, n, steps, rng, knot_interval=knot_interval, calm=calm)
        return np.concatenate((controls, paths), axis=-1)
    if "system" in scene.origin or not (n and steps and scene.num_actions):
        return spline_controls(scene, n, steps, rng, knot_interval=knot_interval)
    check_knot_interval(knot_interval)
    require_bounds(scene)
    model, low, high, rest = scene.model, scene.action_low, scene.action_high, _rest(simulator)
    kinds = np.array([actuator_kind(model, actuator) for actuator in range(model.nu)])
    scale = rng.uniform(*_SCALES, (n, 1, 1))
    splines = spline_controls(scene, n, steps, rng, knot_interval=knot_interval)
    controls = rest + scale * (splines - rest)
    reversing = (kinds == "velocity") & (low < 0) & (high > 0)
    if reversing.any():
        ends = low[reversing], high[reversing]
        controls[..., reversing] = scale * velocity_targets(*ends, n, steps, knot_interval, rng)
    if pace == "full" or not (limits := _limits(simulator, knot_interval)):
        return controls
    variant = np.arange(n) % len(simulator.scenes) if variant is None else variant
    holding = np.clip(pose_holding_controls(simulator, physics, variant, rest), low, high)
    fast = rng.random(n) < {"mixed": _FAST, "calm": 0.0, "fast": 1.0}[pace]
    held = ~fast & (rng.random(n) < _HELD)
    servos, motors = kinds == "position", ~reversing & (kinds != "position")
    if (limits.amplitude < 1).any():
        full = fast & (rng.random(n) < (_FULL if pace == "mixed" else 0.0))
        size = limits.amplitude * _LEAST_SIZE ** rng.uniform(0.0, 1.0, (n, 1, 1))
        noise, rows = size * (splines - rest), np.flatnonzero(~fast)
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
    """Whether random controls of a scene depend on their pace."""
    simulator = simulator.without_mocap_actions
    limits = _limits(simulator, knot_interval)
    kinds = {actuator_kind(simulator.scene.model, actuator) for actuator in range(simulator.scene.model.nu)}
    return limits is not None and ("position" in kinds or bool((limits.amplitude < 1).any()))


def check_pace(pace: str) -> None:
    """Raise ValueError for an unknown pace."""
    if pace not in get_args(Pace):
        raise ValueError(f"pace={pace!r} is not known; use one of {list(get_args(Pace))}.")


def _rest(simulator: Simulator) -> np.ndarray:
    """Controls ``[A]`` of the reference keyframe, or the nearest to 0 within the bounds."""
    scene, key = simulator.scene, reference_keyframe(simulator.scene.model)
    controls = np.zeros(scene.num_actions) if key is None else scene.model.key_ctrl[key]
    return np.clip(controls, scene.action_low, scene.action_high)


def _limits(simulator: Simulator, knot_interval: float) -> ControlLimits | None:
    """Limits of the controls, found once for a simulator; None of the paper's systems and without actions."""
    if "system" in simulator.scene.origin or not simulator.scene.num_actions:
        return None
    if knot_interval not in simulator.control_limits:
        simulator.control_limits[knot_interval] = find_control_limits(simulator, _rest(simulator), knot_interval)
    return simulator.control_limits[knot_interval]
