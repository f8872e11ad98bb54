"""Panels rendered by MuJoCo's OpenGL renderer."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from PIL import Image

from torchrl_gn.evaluation.camera import choose_view, follow
from torchrl_gn.evaluation.geometry import SceneGeometry

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene

_BACKENDS = ("egl", "osmesa", "glfw")
_PATIENCE = 600  # seconds
_FIELD_OF_VIEW = 45.0  # degrees, MuJoCo's default


def render(scene: Scene, sequences: list[np.ndarray], size: int) -> Iterator[list[Image.Image]]:
    """Render states with MuJoCo's renderer, in another process.

    A GL backend has to be chosen before MuJoCo loads, and one that fails prints
    at exit or takes its process down: none of that may happen to a training run.

    Args:
        scene: the scene.
        sequences: state sequences ``[T, N, 13]``, the truth first.
        size: width and height of a panel, pixels.

    Returns:
        Iterator of one list of panels a step; states that are not finite give black panels.

    Raises:
        RuntimeError: if no GL backend works; names what each said.
    """
    geometry = SceneGeometry(scene)
    poses = [geometry.poses(states) for states in sequences]
    lookat, camera = _camera(scene, sequences[0], geometry)
    with tempfile.TemporaryDirectory() as folder:
        mujoco.mj_saveModel(scene.model, f"{folder}/model.mjb")
        positions, matrices = (np.stack(arrays) for arrays in zip(*poses, strict=True))
        np.savez(
            f"{folder}/job.npz",
            positions=positions,
            matrices=matrices,
            lookat=lookat,
            camera=camera,
            size=size,
        )
        _run_worker(folder)
        frames = np.load(f"{folder}/frames.npy")
    return ([Image.fromarray(panel) for panel in frames[:, step]] for step in range(frames.shape[1]))


def _run_worker(folder: str) -> None:
    worker = Path(__file__).with_name("gl_worker.py")
    chosen = os.environ.get("MUJOCO_GL")
    failures = []
    for backend in (chosen,) if chosen else _BACKENDS:
        environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        try:
            done = subprocess.run(
                [sys.executable, str(worker), folder],
                env=environment,
                capture_output=True,
                text=True,
                timeout=_PATIENCE,
            )
        except subprocess.TimeoutExpired:
            failures.append(f"{backend}: nothing within {_PATIENCE} s")
            continue
        if done.returncode == 0 and Path(folder, "frames.npy").exists():
            return
        failures.append(f"{backend}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    raise RuntimeError('Cannot render with OpenGL here; use engine="drawn". ' + "; ".join(failures))


def _camera(scene: Scene, truth: np.ndarray, geometry: SceneGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Points looked at ``[T, 3]``, and azimuth and elevation in degrees and distance in metres."""
    view = choose_view(scene)
    center = follow(scene, truth)
    moving = scene.predicted[geometry.geom_node] & (scene.model.geom_rbound > 0)
    positions, _ = geometry.poses(truth)
    relative = positions[:, moving] - center[:, None]
    bound = scene.model.geom_rbound[moving][:, None]
    low, high = (relative - bound).min(axis=(0, 1)), (relative + bound).max(axis=(0, 1))
    ahead = -view.toward
    elevation = np.degrees(np.arcsin(np.clip(ahead[2], -1, 1)))
    # Straight down the azimuth is free: 90 degrees has x to the right.
    azimuth = 90.0 if abs(ahead[2]) > 0.999 else np.degrees(np.arctan2(ahead[1], ahead[0]))
    width = (high - low) @ np.abs(np.stack((view.right, view.up), axis=-1))
    distance = 1.1 * width.max() / 2 / np.tan(np.radians(_FIELD_OF_VIEW / 2))
    return center + (low + high) / 2, np.array([azimuth, elevation, distance])
