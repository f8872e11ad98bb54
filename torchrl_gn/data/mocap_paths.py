"""Random paths of mocap bodies whose poses are actions."""

from __future__ import annotations

import numpy as np
import torch

from torchrl_gn.data.servo_targets import position_targets
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes.scene import Scene

_SPEED, _TURN_SPEED = 0.5, 1.5  # largest, m/s and rad/s
_TILT = 0.5  # rad about each axis, largest
_LEAST = 0.05  # of the bounds' width, and of the speed


def mocap_paths(
    scene: Scene, n: int, steps: int, rng: np.random.Generator, *, knot_interval: float, calm: np.ndarray
) -> np.ndarray:
    """Smooth poses ``[n, T, 7 K]`` from those of the model: within their bounds, turned by up to half a radian.

    ``calm`` ``[n]`` sequences are up to twenty times slower, the others as fast as half a metre a second.
    """
    count = len(scene.mocaps.body)
    rest, low, high = (each.reshape(count, 7) for each in (scene.mocaps.rest, scene.mocaps.low, scene.mocaps.high))
    share = np.where(calm, _LEAST ** rng.uniform(0.0, 1.0, n), rng.uniform(0.5, 1.0, n))[:, None]

    def path(rest: np.ndarray, low: np.ndarray, high: np.ndarray, speed: float) -> np.ndarray:
        width = _LEAST ** rng.uniform(0.0, 1.0, (n, rest.size))
        speeds = np.broadcast_to(share * speed * scene.timestep, width.shape)
        given = np.tile(rest.ravel(), (n, 1)), low.ravel(), high.ravel()
        found = position_targets(*given, width, speeds, steps, knot_interval, rng)
        return found.reshape(n, steps, count, 3)

    tilt = np.full((count, 3), _TILT)
    place = path(rest[:, :3], low[:, :3], high[:, :3], _SPEED)
    turned = path(np.zeros((count, 3)), -tilt, tilt, _TURN_SPEED)
    angle = np.linalg.norm(turned, axis=-1, keepdims=True)
    turn = np.concatenate((np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * turned), axis=-1)
    turned = quaternion.product(torch.from_numpy(turn), torch.from_numpy(rest[:, 3:]).expand(*turn.shape)).numpy()
    return np.concatenate((place, turned), axis=-1).reshape(n, steps, 7 * count)
