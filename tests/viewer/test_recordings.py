"""Recordings: the library's files come back unchanged, and others are refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.data import DatasetError, save_tensors, simulate_log
from torchrl_gn.scenes import load_scene
from torchrl_gn.training.tensor_files import write_tensors
from torchrl_gn.viewer import read_recording

ARM = """<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0"
  size=".02"/><body name="lower" pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0"
  size=".02"/></body></body></worldbody><actuator><motor name="a" joint="a" ctrlrange="-1 1"/>
  <motor name="b" joint="b" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def pendulum(scenes):
    return scenes["pendulum"]


@pytest.fixture(scope="module")
def trajectories(pendulum):
    return gn.collect_trajectories(pendulum, 3, steps=4, seed=0)


def test_data_sets_have_their_splits(pendulum, tmp_path):
    data = gn.create_dataset(tmp_path / "data", pendulum, train=2, validation=3, test=4, steps=5)
    recording = read_recording(tmp_path / "data", pendulum)
    assert {name: len(part) for name, part in recording.parts.items()} == {"test": 4, "validation": 3, "train": 2}
    assert torch.equal(recording["validation", 2]["state"], data.validation["state"][2])


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_saved_trajectories_come_back(pendulum, trajectories, tmp_path, kind):
    path = tmp_path / ("data" if kind == "folder" else "episodes.safetensors")
    if kind == "folder":
        save_tensors(path, trajectories)
    else:
        write_tensors(path, dict(trajectories.select("state", "action", "physics")))
    recording = read_recording(path, pendulum)
    (name,) = recording.parts
    for key in ("state", "action", "physics"):
        assert torch.equal(recording[name, 1][key], trajectories[key][1])


def test_robot_logs_move_the_scenes_joints(tmp_path):
    scene = load_scene(ARM)
    log = simulate_log(scene, 2, 12, 0, delay=0, time_constant=0.0, play=0.0, quantum=0.0, noise=0.0)
    path = tmp_path / "log.npz"
    arrays = {"angle": log.angle, "velocity": log.velocity, "command": log.command, "length": log.length}
    np.savez(path, **arrays, timestep=log.timestep)
    recording = read_recording(path, scene)
    assert len(recording.parts["episodes"]) == 2
    episode = recording["episodes", 1]
    first = log.angle[log.begins[1] : log.begins[2], 0]
    upper = episode["state"][:, 1, 3:7]  # turns about -y by the angle
    expected = np.stack((np.cos(first / 2), np.sin(first / 2)), axis=-1)
    sign = np.sign(upper[:, :1].numpy() * expected[:, :1])
    np.testing.assert_allclose(sign * upper[:, [0, 2]].numpy(), expected, atol=1e-9)
    np.testing.assert_allclose(episode["action"], log.command[log.begins[1] : log.begins[2] - 1])


def test_robot_logs_are_cut_where_nothing_is_known(tmp_path):
    scene = load_scene(ARM)
    log = simulate_log(scene, 1, 41, 0, delay=0, time_constant=0.0, play=0.0, quantum=0.0, noise=0.0)
    time, angle = log.timestep * np.arange(40.0), (log.angle + np.pi) % (2 * np.pi) - np.pi
    time[10:] += 2.0  # rows are missing
    time[20] = time[19]  # a row with the time of the one before stands alone
    angle[30] = np.nan
    arrays = {"angle": angle, "velocity": log.velocity, "command": log.command, "time": time}
    np.savez(tmp_path / "log.npz", **arrays)
    episodes = read_recording(tmp_path / "log.npz", scene).parts["episodes"]
    pieces = [(0, 10), (10, 20), (21, 30), (31, 40)]
    assert [len(episode["state"]) for episode in episodes] == [stop - start for start, stop in pieces]
    for episode, (start, stop) in zip(episodes, pieces, strict=True):
        expected = np.cos(log.angle[start:stop, 0] / 2)
        np.testing.assert_allclose(np.abs(episode["state"][:, 1, 3]), np.abs(expected), atol=1e-9)


def test_logs_of_poses_come_back(pendulum, trajectories, tmp_path):
    path, state = tmp_path / "poses.npz", trajectories["state"].numpy()
    action = np.pad(trajectories["action"].numpy(), ((0, 0), (0, 1), (0, 0)))
    np.savez(path, state=state[:, :, 1:], action=action, length=np.full(3, 5), timestep=pendulum.timestep)
    recording = read_recording(path, pendulum)
    assert len(recording.parts["episodes"]) == 3
    np.testing.assert_allclose(recording["episodes", 2]["state"][..., :3], state[2][..., :3], atol=1e-12)


@pytest.mark.parametrize(
    ("write", "error", "message"),
    [
        (lambda path: None, ValueError, "There are no trajectories at"),
        (lambda path: path.write_text("[]"), DatasetError, "robot log is a"),
        (lambda path: path.mkdir(), DatasetError, "cannot be read as a robot log"),
    ],
    ids=["missing", "text", "empty folder"],
)
def test_other_files_are_refused(pendulum, tmp_path, write, error, message):
    write(tmp_path / "thing")
    with pytest.raises(error, match=message):
        read_recording(tmp_path / "thing", pendulum)


def test_trajectories_of_other_scenes_are_refused(scenes, trajectories, tmp_path):
    path = tmp_path / "episodes.safetensors"
    write_tensors(path, dict(trajectories.select("state", "action")))
    with pytest.raises(ValueError, match=r"state \[3, 5, 2, 13\] .* scene 'cheetah' has state \[M, T \+ 1, 8, 13\]"):
        read_recording(path, scenes["cheetah"])
    write_tensors(path, {"state": trajectories["state"]})
    with pytest.raises(ValueError, match="has no action"):
        read_recording(path, scenes["pendulum"])


def test_logs_of_other_robots_are_refused(scenes, tmp_path):
    path = tmp_path / "log.npz"
    rows = np.zeros((5, 3))
    np.savez(path, angle=rows, velocity=rows, command=rows, timestep=0.02)
    with pytest.raises(ValueError, match="has 3 joints; to be shown, they must be those of 'pendulum'"):
        read_recording(path, scenes["pendulum"])
