"""Simulated robot logs with the imperfections of real ones."""

from __future__ import annotations

from typing import cast

import mujoco
import numpy as np
import torch

from torchrl_gn.checks import check_count, checked_seed
from torchrl_gn.data.controls import spline_controls
from torchrl_gn.data.logs.robot_log import RobotLog
from torchrl_gn.data.simulate import Simulator, UnstableSimulationError
from torchrl_gn.data.start_states import sample_start_states
from torchrl_gn.scenes.scene import Scene


def simulate_log(
    scene: Scene,
    episodes: int,
    steps: int,
    seed: int,
    *,
    delay: int = 2,
    time_constant: float = 0.1,
    play: float = 0.1,
    quantum: float = 1e-3,
    noise: float = 5e-4,
) -> RobotLog:
    """Simulate a robot's encoder log under random commands (:func:`spline_controls`), one row per control step.

    Motors follow commands with a delay of ``delay`` control steps, play (backlash) and a first-order lag. Angles are
    noisy and quantised; velocities are their backward differences.

    Args:
        scene: a robot whose joints are all hinges.
        episodes: number of episodes.
        steps: control steps of an episode; the log has one row fewer.
        seed: seed of starts, commands and noise.
        delay: control steps from a command to its effect.
        time_constant: time constant of the lag, seconds.
        play: width of the play, as a fraction of the command's range.
        quantum: resolution of the encoders, radians; 0: none is rounded.
        noise: standard deviation of the encoders' noise, radians.

    Raises:
        ValueError: if the robot has other joints or no motor, a count is not whole or too small (two rows are lost to
            velocities and the last command), or an amount is negative or not finite.
        UnstableSimulationError: if an episode becomes unstable.
    """
    for name, count, least in (("episodes", episodes, 1), ("steps", steps, 2), ("delay", delay, 0)):
        check_count(name, count, least)
    amounts = {"time_constant": time_constant, "play": play, "quantum": quantum, "noise": noise}
    if wrong := [f"{name}={amount}" for name, amount in amounts.items() if not 0 <= amount < np.inf]:
        raise ValueError(f"{wrong[0]} must be 0 or more, and finite.")
    model = scene.model
    if (model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE).any() or not scene.num_actions:
        raise ValueError(f"Scene {scene.name!r} must have motors and no joints but hinges.")
    rng = np.random.default_rng(checked_seed(seed))
    command = spline_controls(scene, episodes, steps, rng)
    action = _motors(command, scene, delay, time_constant, play)
    rollout = Simulator(scene).rollout(sample_start_states(scene, episodes, rng), action)
    if unstable := int((~rollout["stable"]).sum()):
        raise UnstableSimulationError(f"{unstable} of {episodes} episodes became unstable; try another seed.")
    physics: np.ndarray = cast(torch.Tensor, rollout.get("physics")).numpy()
    angle = physics[:, :, 1 : 1 + model.nq]  # after the time
    measured = angle + noise * rng.normal(size=angle.shape)
    measured = np.round(measured / quantum) * quantum if quantum > 0 else measured
    velocity = np.diff(measured, axis=1) / scene.timestep
    rows = episodes * (steps - 1)  # the first row has no velocity, the last no executed command
    return RobotLog(
        angle=measured[:, 1:-1].reshape(rows, -1),
        velocity=velocity[:, :-1].reshape(rows, -1),
        command=command[:, 1:].reshape(rows, -1),
        length=np.full(episodes, steps - 1),
        timestep=scene.timestep,
    )


def _motors(command: np.ndarray, scene: Scene, delay: int, time_constant: float, play: float) -> np.ndarray:
    width = play * (scene.action_high - scene.action_low) / 2
    share = 1.0 if time_constant <= 0 else 1 - np.exp(-scene.timestep / time_constant)
    rest_command = np.clip(np.zeros(scene.num_actions), scene.action_low, scene.action_high)
    held = np.broadcast_to(rest_command, command[:, 0].shape).copy()
    lagged, action = held.copy(), np.empty_like(command)
    for step in range(command.shape[1]):
        target = command[:, step - delay] if step >= delay else held
        held = np.clip(held, target - width, target + width)
        lagged = lagged + share * (held - lagged)
        action[:, step] = lagged
    return action
