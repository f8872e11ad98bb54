"""Checks of trajectories before a model learns from them, or is measured on them."""

from __future__ import annotations

import numpy as np
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.maths.state_layout import BODY_STATE, StateLayout
from torchrl_gn.scenes.articulation import Articulation
from torchrl_gn.scenes.kinematic_tree import KinematicTree

_ROWS = 1000  # trajectories that are checked at once
ENDS = ("done", "terminated", "truncated")
"""Flags under ``"next"`` that end an episode; Gymnasium has no ``done``."""
_TOLERANCE = 1e-2  # of a control step; times may be in float32


def require_trajectories(trajectories: object) -> None:
    """Raise TypeError for trajectories that are no TensorDict, such as a log."""
    if not isinstance(trajectories, TensorDictBase):
        raise TypeError(
            f"Trajectories must be a TensorDict [M] of state and action, got {type(trajectories).__name__}; logs become"
            " trajectories by log_trajectories or pose_trajectories."
        )


def check_trajectories(trajectories: TensorDictBase, scene: Articulation, *, layout: StateLayout = BODY_STATE) -> None:
    """Refuse trajectories ``[M]`` from which a scene's model cannot learn.

    Raises:
        TypeError: if they are not a TensorDict.
        ValueError: if there are none, states have another scene's shape, actions have another number of steps, a number
            is not finite, a quaternion is zero (padding), an episode ends inside (:func:`check_episodes`), or the
            control step differs (:func:`check_control_step`). The message names the trajectory.
    """
    require_trajectories(trajectories)
    state_shape, action_shape = list(trajectories["state"].shape), list(trajectories["action"].shape)
    if state_shape[2:] != [scene.num_nodes, layout.size]:
        expected = f"[M, T + 1, {scene.num_nodes}, {layout.size}]"
        raise ValueError(f"States of scene {scene.name!r} must be {expected}, got {state_shape}.")
    if action_shape[:-1] != [state_shape[0], state_shape[1] - 1] or min(action_shape[:2]) < 1:
        raise ValueError(
            "Trajectories must be [M], at least one, of states [M, T + 1, N, C] and actions [M, T, A] with a T of at"
            f" least 1; got {state_shape} and {action_shape}."
        )
    check_episodes(trajectories)
    check_control_step(trajectories, scene)
    for start in range(0, len(trajectories), _ROWS):
        rows = slice(start, start + _ROWS)
        check_numbers(trajectories["state"][rows], trajectories["action"][rows], layout, first=start)


def check_numbers(state: Tensor, action: Tensor, layout: StateLayout, *, first: int = 0) -> None:
    """Raise ValueError if states ``[M, T + 1, N, C]`` or actions ``[M, T, A]`` are not finite, or have no orientation.

    The message counts trajectories from ``first``.
    """
    for what, good in (
        ("states that are not finite", state.isfinite()),
        ("states with a zero quaternion", ~layout.without_angle(state)),
        ("actions that are not finite", action.isfinite()),
    ):
        if not bool(good.all()):
            bad = first + int((~good.flatten(1).all(1)).nonzero()[0])
            raise ValueError(f"Trajectory {bad} contains {what}.")


def check_episodes(trajectories: TensorDictBase) -> None:
    """Raise ValueError if an episode ends before the last step of a trajectory ``[M]``, or steps are missing.

    It ends by one of :data:`ENDS`. The times of ``physics`` ``[M, T + 1, S]``, if there, show resets without a flag.
    """
    for name in ENDS:
        ends = trajectories.get(("next", name), None)
        if ends is not None and bool(ends.flatten(1)[:, :-1].any()):
            raise ValueError(f"there are ends ('next', {name!r}) inside the trajectories: give one for each episode")
    physics = trajectories.get("physics", None)
    if physics is None or physics.ndim != 3 or physics.shape[1] < 3:
        return
    intervals = physics[..., 0].detach().diff(dim=1)  # the time is the first number
    even = (intervals - intervals[:, :1]).abs() <= _TOLERANCE * intervals[:, :1].abs()  # False of NaN
    if not bool(even.all()):
        row, step = (~even).nonzero()[0].tolist()
        raise ValueError(
            f"States {step} and {step + 1} of trajectory {row} are {1000 * float(intervals[row, step]):.4g} ms apart,"
            f" its first two {1000 * float(intervals[row, 0]):.4g} ms: steps are missing, or another episode begins."
            " Cut it."
        )


def check_control_step(trajectories: TensorDictBase, scene: Articulation) -> None:
    """Raise ValueError if the time between states is not the scene's control step.

    Trajectories of logs state this time as ``timestep`` ``[M]``. Simulated trajectories have ``physics``
    ``[M, T + 1, S]``, of which this check reads the first two times, and :func:`check_episodes` all. Trajectories
    without either entry are not checked.
    """
    intervals, physics = trajectories.get("timestep", None), trajectories.get("physics", None)
    if intervals is None and (physics is None or physics.ndim != 3 or physics.shape[1] < 2):
        return
    if intervals is None:
        intervals = physics[:, :2, 0].diff(dim=1)  # the time is the first number
    intervals = intervals.detach().flatten().cpu().numpy()
    wrong = ~(np.abs(intervals - scene.timestep) <= _TOLERANCE * scene.timestep)  # also where times are NaN
    if wrong.any():
        index = int(wrong.argmax())
        remedy = "give log_tree(..., resample={})" if isinstance(scene, KinematicTree) else "load it with timestep={}"
        raise ValueError(
            f"States of trajectory {index} are {1000 * intervals[index]:.4g} ms apart, but the control step of scene"
            f" {scene.name!r} is {1000 * scene.timestep:.4g} ms: {remedy.format(f'{intervals[index]:.4g}')}, or make"
            " the trajectories anew."
        )
