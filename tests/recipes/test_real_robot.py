"""Forward models of a robot's logs, as a user trains them: of any robot, from options alone."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from torchrl_gn.data import log_trajectories, log_tree, simulate_log
from torchrl_gn.dynamics import MujocoPhysics
from torchrl_gn.scenes import KinematicTree, load_scene
from torchrl_gn.training import load_pretrained

SMALL = (
    "steps=2",
    "length=12",
    "history=0",
    "burn_in=4",
    "bptt_steps=2",
    "unroll_steps=3",
    "batch_size=16",
    "sequence_batch_size=4",
    "model.hidden=[8]",
    "models.recurrent.hidden_state=[4, 4, 4]",
)


@pytest.fixture(scope="module")
def recipe(load):
    return load("real_robot")


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    """One episode of a double pendulum with one motor."""
    log = simulate_log(load_scene("acrobot"), 1, 400, 0)
    path = tmp_path_factory.mktemp("log") / "double.npz"
    time = np.arange(len(log.angle)) * log.timestep
    np.savez(path, q=log.angle, dq=log.velocity, u=log.command, time=time, motor=np.array(2))
    return path


@pytest.mark.slow
def test_a_double_pendulum_needs_options_alone(pendulum, call, tmp_path):
    names, run = "names={angle: q, velocity: dq, command: u}", tmp_path / "run"
    code, output, errors = call(f"log={pendulum}", names, f"run_dir={run}", *SMALL, recipe="real_robot")
    assert code != 0 and "commands=[[0], []]" in output + errors
    options = (f"log={pendulum}", names, "commands=[[0], []]", f"run_dir={run}", *SMALL)
    code, output, errors = call(*options, recipe="real_robot")
    assert code == 0, errors
    assert "1 episodes are too few" in output and "cut at 0 gaps" in output and "not read: 'motor'" in output
    # 398 transitions are 33 trajectories.
    assert "validation: 1 trajectories, test: 3 trajectories, train: 29 trajectories" in output
    tree = load_pretrained(run / "recurrent").scene()
    assert tree.num_actions == 1 and tree.edge_action[:, 0].tolist() == [0, 0, -1, -1]
    before = (run / "config.yaml").read_text()
    # Other options, with which the folder must stay as it is: of the first model, and of one that was not resumed.
    (run / "feed-forward" / "checkpoint" / "checkpoint.safetensors").unlink()
    code, output, errors = call(*options, "lr=0.5", recipe="real_robot")
    assert code != 0 and "lr=0.5 (was None)" in output + errors
    assert (run / "config.yaml").read_text() == before and not any((run / "feed-forward" / "checkpoint").iterdir())
    # A log of the same name with other rows, whose test set may hold what the model was trained on.
    recorded = pendulum.read_bytes()
    with np.load(pendulum) as file:
        arrays = dict(file)
    try:
        np.savez(pendulum, **arrays | {name: arrays[name][20:] for name in ("q", "dq", "u", "time")})
        code, output, errors = call(*options, recipe="real_robot")
    finally:
        pendulum.write_bytes(recorded)
    assert code != 0 and "holds a run on other data: log= has changed since" in output + errors
    assert (run / "config.yaml").read_text() == before


@pytest.mark.slow
def test_an_ensemble_says_how_sure_it_is_of_a_log(pendulum, call, tmp_path):
    run, names = tmp_path / "run", "names={angle: q, velocity: dq, command: u}"
    options = (f"log={pendulum}", names, "commands=[[0], []]", f"run_dir={run}", *SMALL)
    assert call(*options, recipe="real_robot")[0] == 0
    # A finished run grows to an ensemble.
    code, output, errors = call(*options, "members=3", recipe="real_robot")
    assert code == 0, errors
    assert "within 1 / 2 std" in output and output.count("is finished") == 2
    assert len(load_pretrained(run / "ensemble").ensemble.members) == 3
    metrics = json.loads((run / "metrics.json").read_text())
    assert 0 <= metrics["ensemble/coverage/one_1/velocity"] <= 1 and metrics["ensemble/one_step_error"] > 0
    seeds = [load_pretrained(run / name).config["seed"] for name in ("feed-forward", "member-1", "member-2")]
    assert seeds == [0, 1, 2]
    code, output, errors = call(*options, "members=3", "lr=0.5", recipe="real_robot")
    assert code != 0 and "lr=0.5 (was None)" in output + errors
    code, output, errors = call(*options, "members=0", recipe="real_robot")
    assert code != 0 and "members" in output + errors


@pytest.mark.slow
def test_a_robot_without_motors_at_other_steps(pendulum, call, tmp_path):
    names = "names={angle: q, velocity: dq, command: '', u: ''}"
    run = tmp_path / "run"
    code, output, errors = call(
        f"log={pendulum}", names, "resample=0.015", f"run_dir={run}", *SMALL, recipe="real_robot"
    )
    assert code == 0, errors
    assert "0 commands, step 15 ms" in output and "interpolated between rows, at steps of 15 ms" in output


@pytest.mark.slow
def test_delay_and_filter_follow_the_measurements(pendulum, call, tmp_path):
    """The models also read past commands."""
    options = (f"log={pendulum}", "names={angle: q, velocity: dq, command: u}", "commands=[[0], []]")
    run, more = tmp_path / "run", ("lag=auto", "filter=auto", "history=2")
    code, output, errors = call(*options, f"run_dir={run}", *SMALL, *more, recipe="real_robot")
    assert code == 0, errors
    assert "Hz, a row every" in output and "delay (rows)" in output
    tree = load_pretrained(run / "feed-forward").scene()
    assert isinstance(tree, KinematicTree) and tree.commands == ((0, 1, 2), ()) and tree.history == 2


SPLIT = {"length": 10, "resample": None, "lag": 0, "jump": 50.0, "history": 0, "filter": 0, "data_seed": 0}


@pytest.mark.parametrize(
    ("share", "episodes"), [("{validation: 0.4, test: 0.4}", 5), ("{validation: 0.2, test: 0.2}", 4)]
)
def test_episodes_stay_whole_where_there_are_enough(share, episodes, recipe):
    log = simulate_log(load_scene("acrobot"), episodes, 62, 0)
    parts = recipe.split(OmegaConf.create({**SPLIT, "share": OmegaConf.create(share)}), log)
    which = {part: set(data["episode"].tolist()) for part, data in parts.items()}
    if episodes == 5:
        assert sorted(map(len, which.values())) == [1, 2, 2] and set.union(*which.values()) == set(range(5))
    else:  # 24 trajectories in time: of the first episodes to train with, of the last to test
        assert {part: len(data) for part, data in parts.items()} == {"validation": 4, "test": 4, "train": 16}
        assert which == {"train": {0, 1, 2}, "validation": {2, 3}, "test": {3}}


def test_shares_that_leave_nothing_are_refused(recipe):
    log = simulate_log(load_scene("acrobot"), 1, 62, 0)
    for share in ({"validation": 0.6, "test": 0.6}, {"validation": 0.0, "test": 0.5}):
        cfg = OmegaConf.create({**SPLIT, "share": share})
        with pytest.raises(ValueError, match="1 episodes cannot be split by share="):
            recipe.split(cfg, log)


def test_horizons_end_with_the_trajectories(recipe):
    options = OmegaConf.create({"length": 40, "burn_in": 20, "horizons": [1, 10, 50]})
    assert recipe.rollout_horizons(options) == {1, 10, 20}
    with pytest.raises(ValueError, match="length=40 leaves no step to predict after burn_in=40"):
        recipe.rollout_horizons(OmegaConf.merge(options, {"burn_in": 40}))


COASTING = """
import torch
from torch import nn


class Coasting(nn.Module):
    def __init__(self, robot, damping=1.0):
        super().__init__()
        self.step, self.logarithm = robot.timestep, nn.Parameter(torch.tensor(float(damping)).log())

    def forward(self, state, action):
        joints = state[..., 1:, :]
        velocity = joints[..., 2] * (1 - self.step * self.logarithm.exp())
        angle = torch.atan2(joints[..., 1], joints[..., 0]) + self.step * velocity
        return torch.cat((state[..., :1, :], torch.stack((angle.cos(), angle.sin(), velocity), dim=-1)), dim=-2)


def still(state, action):
    return state
"""


@pytest.mark.slow
def test_physics_are_fitted_corrected_and_resumed(pendulum, call, tmp_path):
    run, file = tmp_path / "run", tmp_path / "coasting.py"
    file.write_text(COASTING)
    options = (
        f"log={pendulum}",
        "names={angle: q, velocity: dq, command: u}",
        "commands=[[0], []]",
        f"physics={file}:Coasting",
        "physics_options={damping: 2.0}",
        "physics_fit=3",
        f"run_dir={run}",
        *SMALL,
    )
    code, output, errors = call(*options, recipe="real_robot")
    assert code == 0, errors
    for row in ("constant velocity", "physics", "fitted physics", "feed-forward", "recurrent", "residual"):
        assert f"\n{row} " in output
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["physics/rollout_error_8"] != metrics["fitted physics/rollout_error_8"]
    path = run / "residual" / "checkpoint" / "checkpoint.safetensors"
    with pytest.raises(ValueError, match="coasting:Coasting"):
        load_pretrained(path)
    assert call(*options, "steps=3", recipe="real_robot")[0] == 0
    again = json.loads((run / "metrics.json").read_text())
    for name in ("physics", "fitted physics"):  # not fitted again
        assert again[f"{name}/rollout_error_8"] == metrics[f"{name}/rollout_error_8"]


def test_what_names_no_physics_is_refused(tmp_path):
    from _common.models import load_physics

    file, robot = tmp_path / "coasting.py", load_scene("pendulum")
    file.write_text(COASTING)
    assert load_physics(None, None, robot) is None
    state = torch.ones(3)
    still = load_physics(f"{file}:still", None, robot)
    assert still is not None and still(state, state) is state
    for source, options, message in (
        (f"{file}:moving", None, "no function or class 'moving'"),
        (f"{file}:still", {"damping": 1.0}, "takes no physics_options"),
        ("nowhere.py:still", None, "no file nowhere.py"),
    ):
        with pytest.raises(ValueError, match=message):
            load_physics(source, options, robot)
    heavy = load_physics("scene", {"scale": {"mass": 2.0}}, robot)
    assert isinstance(heavy, MujocoPhysics) and heavy.scale == {"mass": 2.0}


def test_the_mirror_image_of_a_pendulum_is_a_pendulum(load):
    mirrored = load("real_robot").mirrored
    log = simulate_log(load_scene("acrobot"), 2, 30, 0)
    data, tree = log_trajectories(log, 10, smooth=2)[0], log_tree(log, "acrobot", commands=[[], [0]])
    both_ways, both = mirrored(tree, data)
    assert (both_ways.action_low == -both_ways.action_high).all() and both_ways.action_high[0] >= tree.action_high[0]
    angles = [torch.atan2(s[..., 1:, 1], s[..., 1:, 0]) for s in both["state"].chunk(2)]
    torch.testing.assert_close(angles[1], -angles[0])
    signs = torch.tensor([1.0, -1.0, -1.0])  # of cosine, sine and velocity; the targets of training are mirrored, too
    assert torch.equal(both["smoothed"][len(data) :, :, 1:], signs * data["smoothed"][:, :, 1:])
    assert torch.equal(both["action"][len(data) :], -data["action"])
    assert torch.equal(both["state"][: len(data)], data["state"])
    with pytest.raises(ValueError, match="not the channels"):
        mirrored(log_tree(dataclasses.replace(log, extra={"torque": log.angle}), "acrobot", commands=[[], [0]]), data)
