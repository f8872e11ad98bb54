"""A value and a policy from the episodes of recipes/mpc.py, and planning with them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from _common.episodes import transitions
from torchrl_gn.training import load_pretrained

EPISODES = ("episodes=3", "steps=8", "horizon=2", "video=false")
SMALL = ("fit.iterations=2", "fit.steps=3", "imitate.steps=10", "hidden=[8]")
PLANNERS = ("gn.warm_up=1", "gn.samples=3", "gn.iterations=1", "ilqr.iterations=1", "mppi.iterations=1")
SAMPLED = ("cem.iterations=1", "cem.candidates=4", "cem.top_k=2", "mppi.candidates=4", "mppi.top_k=2")


@pytest.fixture
def played(tmp_path, call) -> Path:
    code, _, errors = call(*EPISODES, "planner=random", f"run_dir={tmp_path / 'played'}", recipe="mpc")
    assert code == 0, errors
    return tmp_path / "played/random.safetensors"


def test_an_episode_that_became_unstable_ends_before(tmp_path):
    state = torch.randn(3, 5, 2, 13)
    state[1, 3:] = torch.nan
    state[2, 1:] = torch.nan
    kept = {"state": state, "action": torch.randn(3, 4, 1), "reward": torch.randn(3, 4)}
    save_file(kept, tmp_path / "x.safetensors")
    short, whole = transitions(tmp_path / "x.safetensors")
    assert short.shape == (1, 2) and whole.shape == (1, 4)
    assert torch.equal(short["next", "state"][0], state[1, 1:3]) and torch.equal(whole["state"][0], state[0, :4])
    assert torch.equal(short["next", "reward"][0, :, 0], kept["reward"][1, :2])
    save_file({key: value[2:] for key, value in kept.items()}, tmp_path / "x.safetensors")
    with pytest.raises(ValueError, match="has no episode with a stable step"):
        transitions(tmp_path / "x.safetensors")


@pytest.mark.slow
def test_planners_see_further_with_what_was_learned(played, tmp_path, call):
    run = tmp_path / "value"
    for _ in range(2):  # the second repeats it
        code, output, errors = call(f"episodes=[{played}]", *SMALL, f"run_dir={run}", recipe="value")
        assert code == 0, errors
    assert str(run / "value.png") in output
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["steps"] == 24 and metrics["imitation_error"] > 0 and metrics["value"] < 0
    assert load_pretrained(run).config["reward"] == "balance" and load_pretrained(run).value.discount == 0.99
    options = (*EPISODES, *PLANNERS, *SAMPLED, "steps=2", "planner=[gn,ilqr,cem,mppi,ilqg,cem_true]")
    for more in ((), (f"value={run}",), (f"policy={run}", "policy_every_step=true")):
        folder = tmp_path / f"planned{len(more)}{more[:1] == (f'value={run}',)}"
        code, _, errors = call(*options, *more, f"run_dir={folder}", recipe="mpc")
        assert code == 0 and "warning" not in errors.lower(), errors
    plain, valued, proposed = (
        {file.stem: load_file(file)["action"] for file in (tmp_path / name).glob("*.safetensors")}
        for name in ("planned0False", "planned1True", "planned2False")
    )
    assert all(not torch.equal(valued[name], plain[name]) for name in plain)
    assert not torch.equal(proposed["gn"], plain["gn"]) and torch.equal(proposed["cem"], plain["cem"])
    options = ("planner=policy", "delay=1", f"policy={run}", f"run_dir={tmp_path / 'alone'}")
    code, _, errors = call(*EPISODES, *options, recipe="mpc")
    assert code == 0, errors
    alone = load_file(tmp_path / "alone" / "policy.safetensors")
    chosen = load_pretrained(run / "policy.safetensors").policy(TensorDict({"state": alone["state"][:, :-1]}))
    torch.testing.assert_close(alone["action"], chosen["action"])


@pytest.mark.slow
def test_what_does_not_fit_is_refused(played, tmp_path, call):
    code, _, errors = call("episodes=[]", recipe="value")
    assert code == 1 and "Name episodes of recipes/mpc.py" in errors
    code, _, errors = call("episodes=[nowhere.safetensors]", recipe="value")
    assert code == 1 and "episodes=nowhere.safetensors must be a file in a run folder" in errors
    other = tmp_path / "other"
    code, _, errors = call("system=cartpole", *EPISODES, "planner=nothing", f"run_dir={other}", recipe="mpc")
    assert code == 0, errors
    code, _, errors = call(f"episodes=[{played},{other / 'nothing.safetensors'}]", recipe="value")
    assert code == 1 and "has another system than" in errors
    run = tmp_path / "value"
    code, _, errors = call(f"episodes=[{played}]", *SMALL, f"run_dir={run}", recipe="value")
    assert code == 0, errors
    for option, message in (
        ("reward=[{type:Effort}]", "was learned for the reward balance, not"),
        ("system=cartpole", "whose bodies are not those of 'cartpole'"),
    ):
        options = ("planner=nothing", f"value={run}", option, f"run_dir={tmp_path / 'refused'}")
        code, _, errors = call(*EPISODES, *options, recipe="mpc")
        assert code == 1 and message in errors and "Traceback" not in errors
    options = ("planner=policy", f"policy={run}", "timestep=0.04", f"run_dir={tmp_path}/no")
    code, _, errors = call(*EPISODES, *options, recipe="mpc")
    assert code == 1 and f"policy={run}: The policy learned with control steps of 20 ms" in errors
    code, _, errors = call(*EPISODES, "system=cartpole", f"policy={run}", f"run_dir={tmp_path}/no", recipe="mpc")
    assert code == 1 and "is of scene 'pendulum', whose bodies are not those of 'cartpole'" in errors


@pytest.mark.slow
def test_rounds_plan_with_the_value_of_all_episodes_before(tmp_path, load, compose):
    options = ("system=pendulum", "value=true", "discount=0.9", "planner=ilqr", "valuing=['fit.steps=5']")
    learned, executed, valued = load("plan_and_learn").make_runs(
        compose("plan_and_learn", *options, "rounds=2"), tmp_path, "pendulum"
    )
    assert [run and run.folder.name for run in valued] == [None, "valued0", "valued1"]
    files = [f"{tmp_path}/executed{index}/ilqr.safetensors" for index in range(2)]
    assert set(valued[2].overrides) >= {f"episodes=['{files[0]}','{files[1]}']", "discount=0.9", "fit.steps=5"}
    used = [[option for option in run.overrides if option.startswith(("value=", "policy="))] for run in executed]
    assert used == [[], [f"value={tmp_path}/valued0"], [f"value={tmp_path}/valued1"]]
    for of in (*executed, *valued[1:]):
        compose(of.recipe.stem, *of.overrides)  # refuses options that there are not
    more, *_ = load("plan_and_learn").make_runs(
        compose("plan_and_learn", "system=pendulum", "planner=ilqr", "rounds=3"), tmp_path, "pendulum"
    )
    assert more[:3] == learned  # without a value nothing differs
