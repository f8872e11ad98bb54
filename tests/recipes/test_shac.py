"""Policies by a short-horizon actor-critic, round by round and resumed."""

from __future__ import annotations

import json
from dataclasses import fields
from inspect import signature
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from torchrl_gn.actor_critic import ActorCriticOptions, ActorCriticTask, EvaluationEpisodes, FirstTrajectories
from torchrl_gn.atomic import read_json, write_json
from torchrl_gn.data import Simulator
from torchrl_gn.planners import SamplingPlanner
from torchrl_gn.scenes.suite_tasks import full_physics, load_suite_task
from torchrl_gn.training import load_pretrained, save_checkpoint

SMALL = (
    "system=pendulum",
    "reward=balance",
    "timestep=null",
    "first.trajectories=4",
    "first.length=50",
    "first.steps=5",
)
SMALL += ("updates=3", "batch_size=8", "horizon=3", "hidden=[8]", "episodes=2", "steps=50", "model_steps=3")
FORWARD = ("system=pendulum", "data.train=4", "data.validation=2", "data.test=2", "model.hidden=8", "minutes=1")
SMALL += ("model={hidden:8,latent:8}", "evaluate.episodes=2", "evaluate.steps=20")


OWN = {"system", "zero_shot", "timestep", "action_bounds", "wide_starts", "mocap_actions", "motors", "reward"}
OWN |= {"evaluation_reward", "target_squares", "rounds", "plan", "planner", "threads", "logger", "run_dir"}
"""Options of the recipe that its trainer does not read."""


def test_its_defaults_are_those_of_the_library(load, compose):
    config = compose("shac")
    assert load("shac").options_of(config) == ActorCriticOptions()
    assert {each.name for each in fields(ActorCriticOptions)} == set(config) - OWN
    assert {each.name for each in fields(FirstTrajectories)} == set(config.first)
    assert {each.name for each in fields(EvaluationEpisodes)} == set(config.evaluate) - {"suite_seed"}
    defaults = {name: each.default for name, each in signature(SamplingPlanner).parameters.items()}
    assert all(defaults[name] == value for name, value in config.planner.items() if name != "horizon")
    assert config.planner.horizon == signature(ActorCriticTask.planner).parameters["horizon"].default
    changed = compose("shac", "horizon=3", "first.steps=7", "evaluate.steps=9", "hidden=[8]")
    wanted = {"first": FirstTrajectories(steps=7), "evaluate": EvaluationEpisodes(steps=9)}
    assert load("shac").options_of(changed) == ActorCriticOptions(horizon=3, hidden=(8,), **wanted)


@pytest.mark.slow
def test_a_resumed_run_equals_one_that_was_not_stopped(tmp_path, call):
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    for folder, rounds in ((whole, 3), (resumed, 1), (resumed, 3)):
        code, output, errors = call(*SMALL, f"rounds={rounds}", f"run_dir={folder}", recipe="shac")
        assert code == 0 and "warning" not in errors.lower(), errors
        assert str(folder / "policy.safetensors") in output and str(folder / "curve.png") in output
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (whole, resumed)]
    for name in ("reward", "return", "frames", "error", "entropy", "loss_value"):
        assert metrics[0][name] == metrics[1][name]
    assert abs(metrics[0]["return"] - 20 * metrics[0]["reward"]) < 1e-4 and metrics[0]["imagined_reward"] < 0
    assert metrics[0]["frames"] == 4 * 50 + 3 * 2 * 50
    assert metrics[0]["round 2/return"] == metrics[0]["return"]
    first, second = (load_file(folder / "policy.safetensors") for folder in (whole, resumed))
    assert all(torch.equal(first[name], second[name]) for name in first if name != "description")  # it has run_dir
    one = load_file(whole / "rounds/001/policy.safetensors")
    assert any(not torch.equal(one[name], first[name]) for name in first if name.startswith("model.network"))

    # Of three rounds the last alone is kept, of nine the mean of the last two.
    last = load_file(whole / "rounds/002/policy.safetensors")
    assert torch.equal(first["model.log_std"], last["model.log_std"])
    code, _, errors = call(*SMALL, "rounds=9", f"run_dir={whole}", recipe="shac")
    assert code == 0, errors
    two = [load_file(whole / f"rounds/{index:03}/policy.safetensors")["model.log_std"] for index in (7, 8)]
    torch.testing.assert_close(load_file(whole / "policy.safetensors")["model.log_std"], (two[0] + two[1]) / 2)

    # The networks are what the planning recipe takes.
    assert load_pretrained(whole).model is not None
    given = (f"checkpoint={whole}", f"policy={whole}", f"value={whole}")
    planning = ("horizon=2", "steps=2", "episodes=2", "video=false", "gn.warm_up=1", "gn.samples=3", "gn.iterations=1")
    code, _, errors = call("system=pendulum", *given, *planning, f"run_dir={tmp_path / 'mpc'}", recipe="mpc")
    assert code == 0, errors


@pytest.mark.slow
def test_an_ensemble_resumes_too(tmp_path, call):
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    options = ("members=2", "pessimism=1.0")
    for folder, rounds in ((whole, 2), (resumed, 1), (resumed, 2)):
        code, _, errors = call(*SMALL, *options, f"rounds={rounds}", f"run_dir={folder}", recipe="shac")
        assert code == 0 and "warning" not in errors.lower(), errors
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (whole, resumed)]
    for name in ("reward", "return", "frames", "error", "entropy", "loss_value", "rounds_fallen_back"):
        assert metrics[0][name] == metrics[1][name]
    assert len(load_pretrained(whole).ensemble.models) == 2
    code, _, errors = call(*SMALL, "rounds=1", "pessimism=1.0", f"run_dir={tmp_path / 'one'}", recipe="shac")
    assert code == 1 and "pessimism=1.0 needs an ensemble" in errors


def test_rounds_that_fall_back_are_counted(load):
    count = load("shac").fallen_back
    assert count([1.0, 2.0, 1.8, 1.6, 3.0, 2.5]) == 2 and count([-3.0, -5.0]) == 0


def forge(path, change) -> None:
    """Write a checkpoint again, with another state to resume from."""
    honest = load_pretrained(path)
    change(honest.training)
    scenes = honest.scenes()
    save_checkpoint(path, honest.trained, scene=scenes, config=honest.config, training=honest.training)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "small", "more", "file", "change"),
    [
        ("shac", SMALL, "rounds={}", "rounds/001/policy.safetensors", lambda of: of["log_alphas"].clear()),
        ("forward_model", FORWARD, "steps={}", "checkpoint/checkpoint.safetensors", lambda of: of.pop("curves")),
        (
            "forward_model",
            FORWARD,
            "steps={}",
            "checkpoint/checkpoint.safetensors",
            lambda of: of["optimizer"]["0"]["state"][0].update(momentum_buffer=torch.zeros(2)),
        ),
    ],
    ids=["shac", "curves", "moments"],
)
def test_a_forged_state_to_resume_from_is_refused_by_name(tmp_path, call, recipe, small, more, file, change):
    assert call(*small, more.format(2), f"run_dir={tmp_path}", recipe=recipe)[0] == 0
    forge(tmp_path / file, change)
    code, _, errors = call(*small, more.format(3), f"run_dir={tmp_path}", recipe=recipe)
    assert code == 1 and f"CheckpointError: Checkpoint {tmp_path / file} cannot resume this training: " in errors


@pytest.mark.slow
def test_one_evaluation_episode_has_no_spread(tmp_path, call):
    code, _, errors = call(*SMALL, "rounds=1", "evaluate.episodes=1", f"run_dir={tmp_path}", recipe="shac")
    assert code == 0 and "warning" not in errors.lower(), errors
    assert json.loads((tmp_path / "metrics.json").read_text())["std"] == 0.0


SUITE = (*SMALL[3:], "system=suite:cartpole/swingup", "timestep=null", "action_repeat=2")


@pytest.mark.slow
@pytest.mark.parametrize("reward", ["null", "learned"])
def test_a_policy_reads_the_target_of_an_episode(reward, tmp_path, call):
    pytest.importorskip("dm_control.suite")
    options = (f"reward={reward}", "reward_steps=3", "system=suite:reacher/easy")
    code, _, errors = call(*SUITE, *options, "rounds=2", f"run_dir={tmp_path}", recipe="shac")
    assert code == 0 and "warning" not in errors.lower(), errors
    played = load_file(tmp_path / "rounds/001/played.safetensors")
    assert played["target"].shape == (2 * 2, 3) and not torch.equal(played["target"][0], played["target"][1])
    policy, state = load_pretrained(tmp_path / "policy.safetensors").policy, played["state"][:, 0]
    assert policy.in_keys == ["state", "target"]
    actions = [policy.act(state, target) for target in (played["target"], played["target"].flip(0))]
    assert (actions[0] - actions[1]).abs().max() > 1e-4
    with pytest.raises(ValueError, match=r"need a target \[4, 3\], got None"):
        policy.act(state)

    # Plan with the finished run; options of the planner may change.
    planner = ("plan=true", "planner.samples=4", "planner.proposals=2", "planner.elites=2", "planner.iterations=1")
    found = []
    for horizon in (1, 2, 2):
        options_now = (*options, *planner, f"planner.horizon={horizon}", "rounds=2", f"run_dir={tmp_path}")
        code, output, errors = call(*SUITE, *options_now, recipe="shac")
        assert code == 0 and "warning" not in errors.lower(), errors
        assert "reacher-easy with a planner: return" in output and (tmp_path / "episode_planned.gif").is_file()
        metrics = json.loads((tmp_path / "metrics.json").read_text())
        assert metrics["planned/milliseconds"] > 0 and metrics["frames"] == 2 * (4 * 50 + 2 * 2 * 50)
        found.append(metrics["planned/return"])
    assert found[1] == found[2] and 0 <= found[0] <= 1000


@pytest.mark.slow
@pytest.mark.parametrize(("reward", "per_frame"), [("null", "true"), ("learned", "true"), ("learned", "false")])
def test_a_task_of_the_suite_is_paid_by_dm_control(reward, per_frame, tmp_path, call):
    pytest.importorskip("dm_control.suite")
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    options = (f"reward={reward}", f"per_frame={per_frame}", "reward_steps=3", "evaluate.steps=null")
    for folder, rounds in ((whole, 2), (resumed, 1), (resumed, 2)):
        code, output, errors = call(*SUITE, *options, f"rounds={rounds}", f"run_dir={folder}", recipe="shac")
        assert code == 0 and "warning" not in errors.lower(), errors
        assert (str(folder / "reward.safetensors") in output) == (reward == "learned")
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (whole, resumed)]
    for name in ("reward", "return", "frames", "error", "entropy", "loss_value"):
        assert metrics[0][name] == metrics[1][name]
    assert metrics[0]["frames"] == 2 * (4 * 50 + 2 * 2 * 50)
    assert abs(metrics[0]["return"] - 1000 * metrics[0]["reward"]) < 1e-3

    # The same policy in dm_control itself, from the starts that evaluated it.
    policy, env = load_pretrained(whole / "policy.safetensors").policy, load_suite_task("cartpole", "swingup", 0)
    returns = []
    for seed in np.random.SeedSequence(10_000).generate_state(2):
        env.task.random.seed(int(seed))
        step, total = env.reset(), 0.0
        while not step.last():
            state = Simulator(policy.scene).observe(torch.from_numpy(full_physics(env)).unsqueeze(0))
            with torch.no_grad():
                action = policy.act(state)[0].double().numpy()
            for _ in range(2):
                step = env.step(action)
                total += step.reward
        returns.append(total)
    assert abs(metrics[0]["return"] - np.mean(returns)) < 1e-2
    played = load_file(whole / "rounds/001/played.safetensors")
    assert played["reward"].shape == (*played["action"].shape[:2], 1) and played["reward"].abs().max() > 0
    assert len(played["action"]) == (4 if per_frame == "true" else 2)  # windows of 50 steps of the model
    assert load_pretrained(whole).scene().timestep == (0.01 if per_frame == "true" else 0.02)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("timestep=0.02",), "timestep=0.02: suite:cartpole/swingup has its own"),
        (("evaluation_reward=run",), "evaluation_reward=run: suite:cartpole/swingup has its own"),
        (("target_squares=[1]",), "has starts of its own"),
        (("action_repeat=4", "evaluate.steps=300"), "evaluate.steps=300: an episode of suite:cartpole/swingup has 250"),
        (("action_repeat=25",), "steps=50: an episode of suite:cartpole/swingup has 40 control steps"),
        (("system=suite:dog/run",), "There is no scene of the suite's dog/run"),
        (("system=suite:humanoid_CMU/stand",), "is not a task of the suite whose reward is known"),
        (("system=suite:reacher/easy", "policy=graph"), "which policy=graph does not read"),
        (("system=pendulum", "reward=learned"), "no reward 'learned' for scene 'pendulum'"),
        (("system=pendulum",), "'pendulum' is not a task of the suite whose reward is known"),
    ],
)
def test_refuses_options_that_the_suites_tasks_have(options, message, tmp_path, call):
    code, _, errors = call(*SUITE, "reward=null", *options, f"run_dir={tmp_path / 'x'}", recipe="shac")
    assert code == 1 and message in errors, errors


SWIMMERS = (
    *SMALL,
    "system=[swimmer3,swimmer4]",
    "policy=graph",
    "graph={hidden:[8],latent:8}",
    "timestep=0.1",
    "reward=near",
    "target_squares=[0.3,2]",
    "evaluate.suite_seed=10000",
    "action_repeat=1",
)


@pytest.mark.slow
def test_one_graph_policy_learns_on_several_systems(tmp_path, call):
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    for folder, rounds in ((whole, 2), (resumed, 1), (resumed, 2)):
        code, output, errors = call(*SWIMMERS, f"rounds={rounds}", f"run_dir={folder}", recipe="shac")
        assert code == 0 and "warning" not in errors.lower(), errors
        assert str(folder / "swimmer4/value.safetensors") in output and str(folder / "swimmer3.gif") in output
    metrics = [json.loads((folder / "metrics.json").read_text()) for folder in (whole, resumed)]
    for name in ("return swimmer3", "return swimmer4", "return", "error", "entropy"):
        assert metrics[0][name] == metrics[1][name]
    assert metrics[0]["return"] == (metrics[0]["return swimmer3"] + metrics[0]["return swimmer4"]) / 2
    assert metrics[0]["frames"] == 2 * (4 * 50 + 2 * 2 * 50)
    played = load_file(whole / "rounds/001/swimmer3/played.safetensors")
    away = played["state"][:, 0, 1, :2].norm(dim=-1)
    assert away.min() > 0 and away.max() > 0.05 and away.max() < 3  # the target is the origin
    assert load_pretrained(whole / "swimmer4").model is not None

    # A finished run is evaluated on other systems; one that it learned on scores the same.
    others = ("rounds=2", "zero_shot=[swimmer4,swimmer5]", f"run_dir={whole}")
    code, output, errors = call(*SWIMMERS, *others, recipe="shac")
    assert code == 0 and "zero_shot/swimmer5" in output, errors
    zero_shot = json.loads((whole / "metrics.json").read_text())
    assert zero_shot["zero_shot/swimmer4"] == metrics[0]["return swimmer4"] != zero_shot["zero_shot/swimmer5"]

    # The policy proposes plans for a length that it has not learned on.
    planning = ("timestep=0.1", "horizon=2", "steps=2", "video=false", "planner=ilqg", "ilqg.iterations=1")
    code, _, errors = call("system=swimmer5", f"policy={whole}", *planning, f"run_dir={tmp_path / 'mpc'}", recipe="mpc")
    assert code == 0, errors


@pytest.mark.slow
def test_a_round_that_was_cut_short_is_done_again(tmp_path, call):
    call(*SMALL, "rounds=2", f"run_dir={tmp_path}", recipe="shac")
    before = json.loads((tmp_path / "metrics.json").read_text())
    (tmp_path / "rounds/001/numbers.json").unlink()  # what is written last
    code, _, errors = call(*SMALL, "rounds=2", f"run_dir={tmp_path}", recipe="shac")
    assert code == 0, errors
    assert json.loads((tmp_path / "metrics.json").read_text())["reward"] == before["reward"]


@pytest.mark.slow
def test_what_is_derived_of_the_last_round_is_made_again(tmp_path, call):
    """A run may be killed right after it wrote the last round's numbers."""
    call(*SMALL, "rounds=2", f"run_dir={tmp_path}", recipe="shac")
    names = (
        "policy.safetensors",
        "value.safetensors",
        "checkpoint/checkpoint.safetensors",
        "curve.json",
        "episode.gif",
    )

    def contents() -> dict[str, bytes]:
        """Return the files' contents without the description, whose order safetensors leaves open."""
        kept = {name: load_file(tmp_path / name) for name in names[:3]}
        tensors = {name: b"".join(of[key].numpy().tobytes() for key in sorted(of)) for name, of in kept.items()}
        return tensors | {name: (tmp_path / name).read_bytes() for name in names[3:]}

    whole = contents()
    for name, stale in zip(names, ("policy", "value", "model"), strict=False):
        (tmp_path / name).write_bytes((tmp_path / f"rounds/000/{stale}.safetensors").read_bytes())
    (tmp_path / "curve.json").write_text("{}")
    (tmp_path / "episode.gif").unlink()
    code, _, errors = call(*SMALL, "rounds=2", f"run_dir={tmp_path}", recipe="shac")
    assert code == 0, errors
    assert [name for name, content in contents().items() if content != whole[name]] == []


@pytest.mark.slow
def test_refuses_other_options_and_targets(tmp_path, call):
    call(*SMALL, "rounds=1", f"run_dir={tmp_path}", recipe="shac")
    code, _, errors = call(*SMALL, "updates=4", f"run_dir={tmp_path}", recipe="shac")
    assert code == 1 and "updates=4 (was 3)" in errors
    code, _, errors = call("system=swimmer3", "reward=reach", "timestep=null", recipe="shac")
    assert code == 1 and "does not read the target" in errors
    code, _, errors = call(*SMALL, "steps=70", f"run_dir={tmp_path / 'x'}", recipe="shac")
    assert code == 1 and "steps=70" in errors


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("policy=cnn",), "policy=cnn must be mlp or graph"),
        (("system=[pendulum,pendulum]",), "graph to learn on several systems"),
        (("zero_shot=cartpole",), "zero_shot= is for policy=graph"),
        (("target_squares=[0.3]",), "slides freely along x and y, not 'pendulum'"),
        (("system=swimmer3", "reward=near", "target_squares=[-1]"), "must be positive half sides"),
        (("evaluate.suite_seed=0",), "is for a target: pass target_squares= too"),
    ],
)
def test_refuses_tasks_that_do_not_fit(options, message, tmp_path, call):
    code, _, errors = call(*SMALL, *options, f"run_dir={tmp_path / 'x'}", recipe="shac")
    assert code == 1 and message in errors


@pytest.mark.parametrize("option", ["rounds=0", "policy_lr=-1", "horizon=0"])
def test_checks_options_before_data_are_collected(option, tmp_path, call):
    code, _, errors = call(*SMALL, option, f"run_dir={tmp_path / 'x'}", recipe="shac")
    assert code == 1 and option.partition("=")[0] in errors and not (tmp_path / "x/rounds").exists()


@pytest.mark.slow
def test_a_round_whose_episodes_all_became_unstable_does_not_end_the_run(tmp_path, call):
    code, _, errors = call(*SMALL, "rounds=1", f"run_dir={tmp_path}", recipe="shac")
    assert code == 0, errors
    kept = tmp_path / "rounds/000"
    played = load_file(kept / "played.safetensors")
    save_file({name: value[:0].clone() for name, value in played.items()}, kept / "played.safetensors")
    numbers = read_json(kept / "numbers.json")
    write_json(kept / "numbers.json", {**numbers, "error": None})
    code, output, errors = call(*SMALL, "rounds=2", f"run_dir={tmp_path}", recipe="shac")
    assert code == 0, errors
    assert len(load_file(tmp_path / "rounds/001/played.safetensors")["action"]) == 2
    assert json.loads((tmp_path / "metrics.json").read_text())["round 0/error"] is None and "| - |" in output


def test_an_evaluation_episode_ends_where_it_becomes_unstable(load):
    """Rewards of the episode that the environment starts then do not count."""
    rewards = torch.tensor([[1.0, 1.0, 1.0, 1.0], [2.0, -8.0, 9.0, 9.0]]).unsqueeze(-1)
    terminated = torch.tensor([[False] * 4, [False, True, False, True]]).unsqueeze(-1)
    played = TensorDict({"next": {"reward": rewards, "terminated": terminated}}, [2, 4])
    task = SimpleNamespace(evaluate=lambda policy: played, frames_per_step=2)
    _, numbers = load("shac").evaluate(task, None)
    assert numbers["return"] == 2 * (4 - 6) / 2 and numbers["reward"] == pytest.approx((4 - 6) / 6)
    assert numbers["std"] == pytest.approx(np.std([1, -3], ddof=1))
