"""The planning recipe, as a user would try it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from torchrl_gn.data import Simulator, collect_trajectories, spline_controls, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.envs import SceneEnv
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import save_checkpoint

SMALL = ("episodes=2", "horizon=4", "gn.warm_up=2", "gn.samples=3", "gn.iterations=1", "ilqg.iterations=1")
SAMPLED = (
    *("sampling.iterations=1", "sampling.samples=4", "sampling.elites=2"),
    *("cem.iterations=1", "cem.candidates=4", "cem.top_k=2", "mppi.iterations=1", "mppi.candidates=4"),
)


@pytest.mark.slow
def test_planners_play_the_same_starts_and_an_episode_goes_on(tmp_path, run, call):
    options = (*SMALL, *SAMPLED, "mppi.top_k=2", f"run_dir={tmp_path}")
    code, output, errors = run(*options, "steps=2", "planner=[gn,random]", "video=false", recipe="mpc")
    assert code == 0, errors
    first = load_file(tmp_path / "gn.safetensors")["state"]
    code, output, errors = call(*options, "steps=4", "planner=[gn,sampling,ilqg,mppi,cem_true,random]", recipe="mpc")
    assert code == 0, errors
    assert "warning" not in errors.lower()
    executed = {path.stem: load_file(path)["state"] for path in tmp_path.glob("*.safetensors")}
    controls = torch.from_numpy(spline_controls(load_scene("pendulum"), 2, 4, 2)).float()
    # As of an uninterrupted run: fewer steps have other random controls.
    assert torch.equal(load_file(tmp_path / "random.safetensors")["action"], controls)
    assert len(executed) == 6 and {len(states[0]) for states in executed.values()} == {5}
    assert (executed["gn"][:, :3] == first).all()
    assert all((states[:, 0] == first[:, 0]).all() for states in executed.values())
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert all(metrics[f"{name}/mean_reward"] < 0 for name in executed)
    printed = {Path(line).name for line in output.splitlines() if Path(line).is_file()}
    assert printed >= {"metrics.json", "rewards.png", "gn.gif", "sampling.gif", "ilqg.gif"}

    code, _, errors = call(*options, "steps=4", "horizon=5", recipe="mpc")
    assert code == 1 and "other options: horizon=5 (was 4)" in errors and "Traceback" not in errors
    code, _, errors = call(*options, "steps=3", "planner=random", recipe="mpc")
    assert code == 1 and "random.safetensors has 4 steps, more than steps=3" in errors


def test_random_control_goes_on_as_without_interruption(tmp_path, call):
    options = ("system=pendulum", "planner=random", "episodes=2", "video=false", "horizon=4")
    for steps, folder in ((3, "twice"), (6, "twice"), (6, "once")):
        assert call(*options, f"steps={steps}", f"run_dir={tmp_path / folder}", recipe="mpc")[0] == 0
    twice, once = (load_file(tmp_path / name / "random.safetensors") for name in ("twice", "once"))
    assert all(torch.equal(twice[name], once[name]) for name in ("action", "state", "reward"))

    assert call(*options, "steps=6", f"run_dir={tmp_path / 'once'}", recipe="mpc")[0] == 0  # which plays nothing
    assert load_file(tmp_path / "once" / "random.safetensors")["seconds"].equal(once["seconds"])


@pytest.mark.slow
def test_variants_start_alike_whoever_plans(tmp_path, call):
    """Variants are identified first, even if the planner does not use the model."""
    options = (*SMALL, "variants=true", "context_length=5", "steps=1", "video=false", f"run_dir={tmp_path}")
    for planners in ("random", "[gn,random]"):
        code, _, errors = call(*options, f"planner={planners}", recipe="mpc")
        assert code == 0, errors
    states = [load_file(tmp_path / f"{name}.safetensors")["state"][:, 0] for name in ("gn", "random")]
    assert torch.equal(*states)
    saved = load_file(tmp_path / "random.safetensors")
    moved = {name: saved[name] + 0.1 for name in ("state", "now.state")}
    save_file(saved | moved, tmp_path / "random.safetensors")
    code, _, errors = call(*options, "planner=random", recipe="mpc")
    assert code == 1 and "random.safetensors began in other states" in errors and "Traceback" not in errors


@pytest.mark.slow
def test_counts_the_starts_that_reach_a_goal_and_hold_it(tmp_path, call):
    options = ("system=pendulum", "planner=random", "episodes=4", "steps=30", "video=false", f"run_dir={tmp_path}")
    code, output, errors = call(*options, recipe="mpc")
    assert code == 0 and "goal" not in output, errors
    rewards = load_file(tmp_path / "random.safetensors")["reward"]
    goal = float(rewards[0].max())  # reached by the first start, and by others that do better
    code, output, errors = call(*options, f"goal={goal}", recipe="mpc")
    assert code == 0, errors
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    reached = (rewards >= goal).any(1)
    held = int((rewards[:, -3:] >= goal).all(1).sum())
    assert metrics["random/reached"] == reached.sum() and metrics["random/held"] == held
    assert f"reached by {reached.sum()}, held by {held}" in output
    first = [(row >= goal).nonzero()[0].item() for row in rewards[reached]]
    assert metrics["random/steps_to_goal"] == 1 + max(first)


@pytest.mark.slow
def test_targets_that_are_poses(tmp_path, call):
    options = ("system=jaco", "planner=nothing", "episodes=2", "video=false", f"run_dir={tmp_path}")
    for steps in (1, 2):  # the second goes on from what the first saved
        code, _, errors = call(*options, f"steps={steps}", recipe="mpc")
        assert code == 0, errors
        kept = load_file(tmp_path / "nothing.safetensors")
        assert kept["now.target"].shape == (2, 10, 13) and kept["state"].shape[1] == steps + 1


@pytest.mark.slow
def test_an_episode_ends_where_its_simulation_becomes_unstable(tmp_path, call, monkeypatch):
    """Instead of standing still for a million each step; the others go on."""
    step, threads = SceneEnv._step, []

    def explodes(env, tensordict):
        threads.append(env.num_threads)
        out = step(env, tensordict)
        if len(threads) == 4:
            out["terminated"][0], out["reward"][0] = True, env.unstable_reward
        return out

    monkeypatch.setattr(SceneEnv, "_step", explodes)
    options = (*SMALL, "planner=random", "simulation_threads=1", f"run_dir={tmp_path}")
    for steps in (6, 8):  # the second goes on from what the first saved
        code, output, errors = call(*options, f"steps={steps}", recipe="mpc")
        assert code == 0 and "warning" not in errors.lower(), errors
        assert "1 of 2 episodes" in output and "became unstable" in output
        kept = load_file(tmp_path / "random.safetensors")
        assert kept["reward"].isnan().tolist() == [[False] * 3 + [True] * (steps - 3), [False] * steps]
        assert (kept["state"].isnan().flatten(2).any(2).sum(1) == torch.tensor([steps - 3, 0])).all()
        metrics = json.loads((tmp_path / "metrics.json").read_text())
        executed = kept["reward"][~kept["reward"].isnan()]
        assert metrics["random/unstable"] == 1
        assert metrics["random/mean_reward"] == pytest.approx(executed.mean().item())
    assert set(threads) == {1} and len(threads) == 8


@pytest.mark.slow
def test_a_system_that_explodes_is_not_identified(tmp_path, call, monkeypatch):
    rollout = Simulator.rollout

    def explodes(*inputs):
        out = rollout(*inputs)
        out["stable"][0], out["state"][0] = False, torch.nan
        return out

    monkeypatch.setattr(Simulator, "rollout", explodes)
    code, _, errors = call(*SMALL, "variants=true", "steps=1", f"run_dir={tmp_path}", recipe="mpc")
    assert code == 1 and "1 of 2 simulations became unstable under the 20 random controls" in errors


@pytest.mark.slow
def test_a_recurrent_model_plans_too_and_videos_show_plans(tmp_path, call):
    torch.manual_seed(0)
    scene = load_scene("pendulum")
    model = ForwardModel.for_scene(scene, core="recurrent", hidden=8, layers=1, hidden_state=[4, 4, 4])
    bound, seen = model.bind(scene), collect_trajectories(scene, 5, 20, seed=0)
    ForwardModelLoss(bound).fit_normalizers(trajectory_buffer(seen, batch_size=100, seed=0).sample())
    save_checkpoint(tmp_path / "model.safetensors", model, scene=scene)
    options = (
        f"checkpoint={tmp_path / 'model.safetensors'}",
        "planner=[gn,ilqg,random]",
        f"run_dir={tmp_path / 'run'}",
    )
    code, output, errors = call(*SMALL, *options, "horizon=1", "steps=4", recipe="mpc")
    assert code == 0, errors
    assert "more slowly" not in output  # it is specialised as others are
    kept = load_file(tmp_path / "run" / "gn.safetensors")
    _, hidden = bound.teacher_forced(kept["state"][:, :-1], kept["action"])
    torch.testing.assert_close(kept["now.hidden_state.nodes"], hidden["nodes"])
    widths = {}
    for name in ("gn", "ilqg", "random"):
        with Image.open(tmp_path / "run" / f"{name}.gif") as film:
            widths[name] = film.width
    assert widths["gn"] == widths["ilqg"] > 1.8 * widths["random"]
    kept = load_file(tmp_path / "run" / "ilqg.safetensors")
    assert torch.equal(kept["planned"], kept["state"][0, 1:])  # of one step on the true physics, that comes true


@pytest.mark.slow
def test_bad_options_are_named(tmp_path, call):
    for option, message in (
        ("planner=gradient", "There is no planner 'gradient'"),
        ("system=two_poles", "'two_poles' is not a system of the paper, whose tasks this recipe has (['pendulum', "),
        ("system=my.xml", "'Plan for your own robot'"),
        ("system=my.xml reward=[{type:Effort}] horizon=3", "is not a system of the paper"),
        ("planner=policy", "planner=policy acts by a learned policy: pass policy=PATH"),
        ("steps=0", "steps=0 must be a whole number, 1 or more"),
        ("steps=2.5", "steps=2.5 must be a whole number, 1 or more"),
        ("horizon=0", "horizon=0 must be a whole number, 1 or more"),
        ("episodes=-1", "episodes=-1 must be a whole number, 1 or more"),
        ("cem.top_k=1 planner=cem_true", "cem.top_k=1 must be a whole number, 2 or more"),
        ("mppi.candidates=4 planner=mppi_true", "mppi.candidates=4 must be a whole number, 32 or more"),
    ):
        folder = tmp_path / option.split("=")[0]
        code, _, errors = call(*SMALL[:1], *option.split(), f"run_dir={folder}", recipe="mpc")
        assert code == 1 and message in errors and "Traceback" not in errors, errors


@pytest.mark.slow
def test_planners_that_go_on_draw_what_they_would_have_drawn(tmp_path, call):
    options = ("system=pendulum", "planner=[gn,sampling,cem]", "horizon=2", "episodes=2", "video=false")
    options += ("gn.candidates=2", "gn.samples=2", "gn.warm_up=1", "gn.iterations=1")
    options += ("sampling.samples=4", "cem.iterations=1", "cem.candidates=4", "cem.top_k=2")
    for folder, steps in (("whole", 4), ("resumed", 2), ("resumed", 4)):
        code, _, errors = call(*options, f"steps={steps}", f"run_dir={tmp_path / folder}", recipe="mpc")
        assert code == 0, errors
    for name in ("gn", "sampling", "cem"):
        whole, resumed = (load_file(tmp_path / folder / f"{name}.safetensors") for folder in ("whole", "resumed"))
        assert torch.equal(whole["action"], resumed["action"]) and torch.equal(whole["state"], resumed["state"])
