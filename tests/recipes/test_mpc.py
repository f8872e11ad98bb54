"""The planning recipe, as a user would try it."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors.torch import load_file

from torchrl_gn.data import spline_controls
from torchrl_gn.scenes import load_scene

SMALL = ("episodes=2", "horizon=4", "gn.warm_up=2", "gn.samples=3", "gn.iterations=1", "ilqg.iterations=1")
SAMPLED = ("cem.iterations=1", "cem.candidates=4", "cem.top_k=2", "mppi.iterations=1", "mppi.candidates=4")


def test_planners_play_the_same_starts_and_an_episode_goes_on(tmp_path, run, call):
    options = (*SMALL, *SAMPLED, "mppi.top_k=2", f"run_dir={tmp_path}")
    code, output, errors = run(*options, "steps=2", "planner=[gn,random]", "video=false", recipe="mpc")
    assert code == 0, errors
    first = load_file(tmp_path / "gn.safetensors")["state"]
    code, output, errors = call(*options, "steps=4", "planner=[gn,ilqg,mppi,cem_true,random]", recipe="mpc")
    assert code == 0, errors
    assert "warning" not in errors.lower()
    played = {path.stem: load_file(path)["state"] for path in tmp_path.glob("*.safetensors")}
    controls = torch.from_numpy(spline_controls(load_scene("pendulum"), 2, 4, 2)).float()
    # The rest of an episode, and not one anew.
    assert torch.equal(load_file(tmp_path / "random.safetensors")["action"][:, 2:], controls[:, 2:])
    assert len(played) == 5 and {len(states[0]) for states in played.values()} == {5}
    assert (played["gn"][:, :3] == first).all()
    assert all((states[:, 0] == first[:, 0]).all() for states in played.values())
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert all(metrics[f"{name}/mean_reward"] < 0 for name in played)
    printed = {Path(line).name for line in output.splitlines() if Path(line).is_file()}
    assert printed >= {"metrics.json", "rewards.png", "gn.gif", "ilqg.gif"}

    code, _, errors = call(*options, "steps=4", "horizon=5", recipe="mpc")
    assert code == 1 and "other options: horizon=5 (was 4)" in errors and "Traceback" not in errors
    code, _, errors = call(*options, "steps=3", "planner=random", recipe="mpc")
    assert code == 1 and "random.safetensors has 4 steps, more than steps=3" in errors


def test_targets_that_are_poses(tmp_path, call):
    options = ("system=jaco", "planner=nothing", "episodes=2", "video=false", f"run_dir={tmp_path}")
    for steps in (1, 2):  # the second goes on from what the first saved
        code, _, errors = call(*options, f"steps={steps}", recipe="mpc")
        assert code == 0, errors
        kept = load_file(tmp_path / "nothing.safetensors")
        assert kept["now.target"].shape == (2, 10, 13) and kept["state"].shape[1] == steps + 1


def test_bad_options_are_named(tmp_path, call):
    for option, message in (
        ("planner=gradient", "There is no planner 'gradient'"),
        ("system=two_poles", "'two_poles' is no system of the paper; those with rewards are ['pendulum', "),
    ):
        code, _, errors = call(*SMALL[:1], option, f"run_dir={tmp_path / option.split(chr(61))[0]}", recipe="mpc")
        assert code == 1 and message in errors and "Traceback" not in errors, errors
