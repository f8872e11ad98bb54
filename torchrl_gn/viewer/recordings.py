"""Recorded trajectories for playback: the library's files, and logs of robots."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.data import RobotLog, Simulator, load_dataset, load_pose_log, load_robot_log, open_tensors
from torchrl_gn.data.logs.robot_log import unbroken
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.articulation import require_timestep
from torchrl_gn.training.tensor_files import load_tensors

_JUMP = 50.0  # threshold of a jump, as of log_trajectories
_POSES = {"position", "quaternion", "state"}  # arrays of a log of body poses


class Recording:
    """Trajectories of a scene in named parts.

    Args:
        parts: TensorDicts ``[M]`` of ``state`` ``[M, T + 1, N, C]`` and ``action`` ``[M, T, A]``, or lists of
            trajectories of unequal length.

    Raises:
        ValueError: if there is no trajectory.
    """

    def __init__(self, parts: Mapping[str, TensorDictBase | list[TensorDictBase]]) -> None:
        self.parts = {name: part for name, part in parts.items() if len(part)}
        if not self.parts:
            raise ValueError("The recording has no trajectory.")

    def __getitem__(self, place: tuple[str, int]) -> TensorDictBase:
        part, index = place
        return cast(TensorDictBase, self.parts[part][index])


def read_recording(path: str | os.PathLike, scene: Scene) -> Recording:
    """Read trajectories of a scene.

    Args:
        path: a data set or a folder of :func:`~torchrl_gn.data.save_tensors`; a ``.safetensors`` file with ``state``
            and ``action``, such as the episodes of ``recipes/mpc.py``; a log of body poses (``.npz``); or a robot's log
            (:func:`~torchrl_gn.data.load_robot_log`), whose joints are the scene's joints, in order. It is cut at gaps,
            jumps and rows that are not finite, over which nothing is known.

    Raises:
        ValueError: if the file is missing, has another format, or is of another scene.
        OSError: if it cannot be read.
        DatasetError: if a data set or a log is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise ValueError(f"There are no trajectories at {path}.")
    if (path / "manifest.json").is_file():
        data = load_dataset(path, scene)
        if "variant_parameters" in data.test.keys():
            raise ValueError(
                f"{path} has random variants of {scene.name!r}, whose shapes differ: they cannot be shown."
            )
        return Recording({split: getattr(data, split) for split in ("test", "validation", "train")})
    if (path / "meta.json").is_file() and not (path / "meta").is_dir():
        found = open_tensors(path)
        entries = {key: found.get(key) for key in ("state", "action", "physics") if found.get(key, None) is not None}
        return Recording({"trajectories": _checked(entries, scene, path)})
    if path.suffix == ".safetensors":
        tensors = load_tensors(path)
        entries = {key: tensors[key] for key in ("state", "action", "physics") if key in tensors}
        return Recording({"episodes": _checked(entries, scene, path)})
    if path.suffix == ".npz" and _POSES & set(_names(path)):
        log = load_pose_log(path)
        require_timestep(scene, log.timestep, f"The bodies of {path}")
        world = torch.from_numpy(scene.reference_state[:1]).expand(len(log.state), -1, -1)[..., :13]
        states, begins = torch.cat((world, torch.from_numpy(log.state)), 1), np.r_[0, np.cumsum(log.length)]
        actions = torch.from_numpy(log.action)
        cut = [(states[a:b], actions[a : b - 1]) for a, b in zip(begins[:-1], begins[1:], strict=True)]
    else:
        cut = list(_episodes(load_robot_log(path), scene, path))
    made = [_checked({"state": state[None], "action": action[None]}, scene, path)[0] for state, action in cut]
    return Recording({"episodes": cast("list[TensorDictBase]", made)})


def _names(path: Path) -> list[str]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return list(file.files)
    except (OSError, ValueError, EOFError):
        return []  # load_robot_log names the error


def _checked(entries: Mapping[str, Tensor], scene: Scene, path: Path) -> TensorDict:
    """Return trajectories ``[M]``; ValueError if shapes do not fit the scene, or nothing is finite."""
    if missing := {"state", "action"} - entries.keys():
        raise ValueError(f"{path} has no {', '.join(sorted(missing))}: trajectories have state and action.")
    state, action = entries["state"], entries["action"]
    wanted = f"state [M, T + 1, {scene.num_nodes}, {scene.state_size}] and action [M, T, {scene.num_actions}]"
    good = state.ndim == 4 and action.ndim == 3 and state.shape[2:] == (scene.num_nodes, scene.state_size)
    if not good or action.shape != (len(state), state.shape[1] - 1, scene.num_actions):
        raise ValueError(
            f"{path} has state {list(state.shape)} and action {list(action.shape)}; scene {scene.name!r} has {wanted}."
        )
    return TensorDict(dict(entries), batch_size=[len(state)])


def _episodes(log: RobotLog, scene: Scene, path: Path) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield states and actions of a log's unbroken pieces at the scene's control steps, interpolated."""
    model, kinds = scene.model, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    if not np.isin(model.jnt_type, [int(kind) for kind in kinds]).all() or log.num_joints != model.njnt:
        raise ValueError(
            f"{path} has {log.num_joints} joints; to be shown, they must be those of {scene.name!r}, in order:"
            f" {list(scene.joint_names)}, all hinges or slides."
        )
    simulator = Simulator(scene, 1)
    for rows in unbroken(log, _JUMP):
        at = (log.at[rows] - log.at[rows.start]) * log.timestep
        if at[-1] + 1e-9 < scene.timestep:
            continue
        grid = np.arange(0.0, at[-1] + 1e-9, scene.timestep)
        physics = np.tile(scene.rest_physics, (len(grid), 1))
        for joint in range(model.njnt):
            angle = log.angle[rows, joint]
            angle = np.unwrap(angle) if model.jnt_type[joint] == kinds[0] else angle
            physics[:, 1 + model.jnt_qposadr[joint]] = np.interp(grid, at, angle)
            physics[:, 1 + model.nq + model.jnt_dofadr[joint]] = np.interp(grid, at, log.velocity[rows, joint])
        command = np.zeros((len(grid) - 1, scene.num_actions))
        if log.command.shape[1] == scene.num_actions:
            held = np.clip(np.searchsorted(at, grid[:-1] + 1e-9, side="right") - 1, 0, None)
            command = log.command[rows][held]
        yield simulator.observe(physics), torch.from_numpy(command)
