"""Random paths of mocap bodies whose poses are actions."""

from __future__ import annotations

import numpy as np
import torch

from torchrl_gn.data.servo_targets import position_targets
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes.scene import Scene

_SPEED, _TURN_SPEED = 0.5, 1.5  # largest speeds, m/s and rad/s
_TILT = 0.5  # rad, largest turn about each axis
_LEAST = 0.05  # smallest share of the bounds' width, and of the speed


def mocap_paths(
    scene: Scene, n: int, steps: int, rng: np.random.Generator, *, knot_interval: float, calm: np.ndarray
) -> np.ndarray:
    """Draw smooth pose paths ``[n, T, 7 K]`` from the model's poses, within bounds and at most 0.5 rad off per axis.

    Speeds are at most 0.5 m/s and 1.5 rad/s, times a factor in [0.05, 1] for ``calm`` ``[n]`` sequences and in [0.5, 1]
    for others.
    """
    count = len(scene.mocaps.body)
    rest, low, high = (each.reshape(count, 7) for each in (scene.mocaps.rest, scene.mocaps.low, scene.mocaps.high))
    share = np.where(calm, _LEAST ** rng.uniform(0.0, 1.0, n), rng.uniform(0.5, 1.0, n))[:, None]

    def path(rest: np.ndarray, low: np.ndarray, high: np.ndarray, speed: float) -> np.ndarray:
        width = _LEAST ** rng.uniform(0.0, 1.0, (n, rest.size))
        speeds = np.broadcast_to(share * speed * scene.timestep, width.shape)
        targets = np.tile(rest.ravel(), (n, 1)), low.ravel(), high.ravel()
        paths = position_targets(*targets, width, speeds, steps, knot_interval, rng)
        return paths.reshape(n, steps, count, 3)

    tilt = np.full((count, 3), _TILT)
    positions = path(rest[:, :3], low[:, :3], high[:, :3], _SPEED)
    turned = path(np.zeros((count, 3)), -tilt, tilt, _TURN_SPEED)
    angle = np.linalg.norm(turned, axis=-1, keepdims=True)
    turn = np.concatenate((np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * turned), axis=-1)
    turned = quaternion.product(torch.from_numpy(turn), torch.from_numpy(rest[:, 3:]).expand(*turn.shape)).numpy()
    return np.concatenate((positions, turned), axis=-1).reshape(n, steps, 7 * count)
