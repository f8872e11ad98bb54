"""Models of logs of body poses, as a user trains them."""

from __future__ import annotations

import json
from itertools import product

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from torchrl_gn.data import UnstableSimulationError
from torchrl_gn.maths import quaternion

from .. import zoo

SMALL = ("steps=3", "length=10", "window=4", "unroll_steps=2", "batch_size=8", "unroll_batch_size=4", "model.hidden=8")
EPISODES = "episodes={train: 3, validation: 2, test: 2}"


@pytest.fixture(scope="module")
def recipe(load):
    return load("contacts")


@pytest.fixture(scope="module")
def log(recipe, tmp_path_factory):
    """Seven throws of the recipe's cube."""
    options = {"system": None, "timestep": 0.00675676, "length": 14, "train_length": None, "data_seed": 0}
    cfg = OmegaConf.create(
        options | {"throw": {"lift": [0.1, 0.2], "turn": None, "speed": 1.0, "spin": 5.0, "joints": 0.0}}
    )
    state = recipe.throws(cfg, recipe.make_scene(cfg), 0, 7)["state"]
    path = tmp_path_factory.mktemp("log") / "falls.npz"
    np.savez(path, state=np.asarray(state)[:, :, 1], length=np.full(7, 15))
    return path


def test_splits_share_no_episode(recipe, log):
    options = {"log": str(log), "system": None, "timestep": 0.00675676, "order": "wxyz", "frame": "world"}
    options |= {"length": 10, "window": 4, "stride": 3, "data_seed": 0}
    cfg = OmegaConf.create(options | {"episodes": {"train": 3, "validation": 2, "test": 2}})
    data = recipe.make_data(cfg, recipe.make_scene(cfg))
    members = [set(data[split]["episode"].tolist()) for split in recipe.SPLITS]
    assert list(map(len, members)) == [3, 2, 2] and not any(a & b for a, b in product(members, members) if a is not b)
    # Trajectories of 4 steps begin at rows 0, 3, 6, 9 of 15; those that are measured at row 0.
    assert data["train"]["state"].shape == (12, 5, 2, 13) and data["test"]["state"].shape == (2, 11, 2, 13)
    cfg.episodes.train = 4
    with pytest.raises(ValueError, match="more than the log's 7"):
        recipe.make_data(cfg, recipe.make_scene(cfg))


def test_robots_are_thrown_with_moving_joints(recipe):
    scene = zoo.load("tumbler")
    cfg = OmegaConf.create({"length": 3, "train_length": None, "data_seed": 0})
    for joints in (0.0, 2.0):
        cfg.throw = {"lift": [0.1, 0.2], "turn": None, "speed": 1.0, "spin": 5.0, "joints": joints}
        state = recipe.throws(cfg, scene, 0, 40)["state"][:, 0]
        moved = (state[:, 2:, 10:13] - state[:, 1:2, 10:13]).norm(dim=-1)  # relative to the base, rad/s
        assert moved.max() < 1e-9 if joints == 0 else 0.5 < moved.square().mean().sqrt() < 5


def test_unstable_throws_are_no_data(recipe):
    scene = zoo.load("tumbler")
    cfg = OmegaConf.create({"length": 3, "train_length": None, "data_seed": 0})
    cfg.throw = {"lift": [0.1, 0.2], "turn": None, "speed": 1e11, "spin": 5.0, "joints": 0.0}
    with pytest.raises(UnstableSimulationError, match="8 of 8 throws became unstable"):
        recipe.throws(cfg, scene, 0, 8)


def test_throws_turn_bodies_as_far_as_asked(recipe):
    scene = zoo.load("tumbler")
    cfg = OmegaConf.create({"length": 4, "train_length": 1, "data_seed": 0})
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    for turn, least, most in ((90, 80, 90), (10, 8, 10), (None, 150, 180)):
        cfg.throw = {"lift": [0.1, 0.2], "turn": turn, "speed": 0.0, "spin": 0.0, "joints": 0.0}
        state = recipe.throws(cfg, scene, 0, 60)["state"]
        assert state.shape[1] == 2 and recipe.throws(cfg, scene, 1, 2)["state"].shape[1] == 5
        base = state[:, 0, 1, 3:7]
        degrees = torch.rad2deg(quaternion.angle(base, upright.expand_as(base)))
        assert least < degrees.max() <= most + 1e-6 and degrees.min() < most / 4


def test_copies_are_cubes_on_other_faces(recipe, log):
    state = torch.from_numpy(np.load(log)["state"])[:, :, None].repeat(1, 1, 2, 1)  # node 0 is the world
    data = recipe.alike(TensorDict({"state": state, "action": torch.zeros(7, 14, 0)}, [7]), 20, 0)
    copies = data["state"].unflatten(0, (21, 7))
    assert copies[0].equal(state) and copies[:, :, :, 0].equal(state[:, :, 0].expand(21, -1, -1, -1))
    assert copies[..., :3].equal(state[..., :3].expand(21, -1, -1, -1, -1))
    assert copies[..., 7:].equal(state[..., 7:].expand(21, -1, -1, -1, -1))
    # Corners of the cube go onto corners, not each onto itself.
    corners = torch.tensor(list(product((-1.0, 1.0), repeat=3)), dtype=torch.float64)
    before, after = (quaternion.rotate(each[:, 0, 1, None, 3:7], corners) for each in (state, copies[1]))
    distance = torch.cdist(before, after)
    assert distance.amin(-1).max() < 1e-9 and distance.diagonal(dim1=1, dim2=2).max() > 1


@pytest.mark.slow
def test_a_log_is_learned_and_measured(log, call, tmp_path):
    run = tmp_path / "run"
    code, output, errors = call(f"log={log}", f"run_dir={run}", EPISODES, *SMALL, recipe="contacts")
    assert code == 0, errors
    assert "'cube', means over 10 steps of 2 test rollouts" in output
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["MuJoCo/position_error"] < 1e-9 < metrics["model/position_error"]  # what made the log
    assert metrics["MuJoCo/rotation_error"] < 1e-6


def test_copies_are_for_one_cube(call, tmp_path):
    arm = tmp_path / "two.xml"
    body = '<body pos="{} 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
    arm.write_text(f"<mujoco><worldbody>{body.format(0)}{body.format(2)}</worldbody></mujoco>")
    options = (f"system={arm}", "timestep=0.02", EPISODES, *SMALL, "cube_copies=2", f"run_dir={tmp_path / 'run'}")
    code, output, errors = call(*options, recipe="contacts")
    assert code == 1 and "cube_copies=2 is for one cube" in output + errors
