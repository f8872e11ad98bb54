"""Warning about scenes that no action moves, whose data show only free motion."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.data.start_states import draw_start_states
from torchrl_gn.scenes.mocap import leading_mocaps
from torchrl_gn.scenes.topology import named

_STARTS, _STEPS = 4, 5
_SAME = 1e-9  # largest relative difference of equal states


class UncontrolledSceneWarning(UserWarning):
    """No action moves the scene, or the scene follows mocap bodies whose poses are not actions."""


def warn_if_uncontrolled(simulator: Simulator, *, stacklevel: int = 1) -> None:
    """Warn if no action moves an MJCF scene, or the scene follows mocap bodies whose poses are not actions.

    No action moves a scene that has joints but no actions, or whose actions have no effect: simulations from the same
    states are equal under different actions.
    """
    scene = simulator.scene
    if "system" in scene.origin:
        return
    model, reason = scene.model, None
    free = int(mujoco.mjtJoint.mjJNT_FREE)
    joints = [
        named(model, mujoco.mjtObj.mjOBJ_JOINT, joint) for joint in np.flatnonzero(model.jnt_type != free).tolist()
    ]
    led = [named(model, mujoco.mjtObj.mjOBJ_BODY, body) for _, _, body in leading_mocaps(model)]
    if led and not len(scene.mocaps):
        reason = (
            f"bodies {led} are held to mocap bodies, whose poses are not actions: they stay as in the model. Load it"
            " with mocap_actions=True to lead them."
        )
    elif joints and not scene.num_actions:
        reason = (
            f"it has no actions. If it is to be controlled, load it with motors=True, or add <actuator>s for joints of"
            f" {joints}."
        )
    elif scene.num_actions and not _actions_matter(simulator):
        names = list(scene.action_names)
        reason = f"no action moves anything. Look at gains, gears and bounds of {names}, and at damping of joints."
    if reason is not None:
        message = f"Data of scene {scene.name!r} show no control: {reason}"
        warnings.warn(message, UncontrolledSceneWarning, stacklevel=1 + stacklevel)


def _actions_matter(simulator: Simulator) -> bool:
    scene, rng = simulator.scene, np.random.default_rng(0)
    if not np.isfinite([scene.action_low, scene.action_high]).all():
        return True
    variant = np.zeros(_STARTS, dtype=np.int64)
    start, _ = draw_start_states(simulator, variant, rng)
    size = (_STARTS, _STEPS + int(scene.delays.age.max(initial=0)), scene.num_actions)
    first, second = (
        simulator.rollout(start, rng.uniform(scene.action_low, scene.action_high, size), variant) for _ in range(2)
    )
    there, other = first["state"], second["state"]
    if not bool((first["stable"] & second["stable"]).all()):
        return True
    return not bool(((there - other).abs() <= _SAME * (1 + there.abs())).all())
