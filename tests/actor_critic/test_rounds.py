"""Rounds in a run folder: a run resumes after the last finished one."""

from __future__ import annotations

import math

import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.actor_critic import ActorCritic, ActorCriticTask, Rounds

from .test_trainer import balancing, make_task, weights


def learn(rounds: Rounds, options, until: int) -> ActorCritic:
    """Learn until so many rounds are finished."""
    learner = rounds.begin(options)
    rounds.collect()
    for index in range(rounds.finished, until):
        torch.manual_seed(index)
        losses = learner.learn(index)
        played = [task.play(learner.playing(), seed=index) for task in rounds.tasks]
        for task, trajectories in zip(rounds.tasks, played, strict=True):
            task.add(trajectories)
        rounds.save(learner, played, losses)
    return learner


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scene", "suite"])
def test_resumes_after_the_last_finished_round(kind, small, tmp_path):
    """Bit for bit, after a round that was stopped before its last file."""
    options, config = small(), {"kind": kind}
    torch.manual_seed(0)
    whole = Rounds(tmp_path, [make_task(kind, options)], config)
    learner, numbers = learn(whole, options, 2), whole.numbers()
    assert whole.finished == len(numbers) == 2
    torch.manual_seed(5)  # a resumed run uses no new networks
    resumed = Rounds(tmp_path, [make_task(kind, options)], config)
    assert resumed.finished == 2 and torch.equal(weights(resumed.begin(options).policy), weights(learner.policy))

    (tmp_path / "rounds/001/numbers.json").unlink()
    resumed = Rounds(str(tmp_path), [make_task(kind, options)], config)
    assert resumed.finished == 1 and resumed.numbers() == numbers[:1]
    again = learn(resumed, options, 2)
    assert resumed.numbers() == numbers
    for one, other in zip((learner, *whole.tasks), (again, *resumed.tasks), strict=True):
        networks = {"policy": one.policy} if isinstance(one, ActorCritic) else one.networks
        others = {"policy": other.policy} if isinstance(other, ActorCritic) else other.networks
        assert [name for name in networks if not torch.equal(weights(networks[name]), weights(others[name]))] == []
    for before, after in zip(whole.tasks[0].data, resumed.tasks[0].data, strict=True):
        assert all(torch.equal(before[name], after[name]) for name in before.keys())


def test_keeps_the_averaged_policy_beside_the_last_networks(small, tmp_path):
    """Every task has its own folder if there are several."""
    options = small(policy="graph", graph={"hidden": [8], "latent": 8})
    scenes = {name: gn.load_scene(name, timestep=0.02) for name in ("pendulum", "cartpole")}
    rewards = {name: gn.make_reward("balance", scene) for name, scene in scenes.items()}
    tasks = [ActorCriticTask(scene, options, rewards[name]) for name, scene in scenes.items()]
    rounds = Rounds(tmp_path, tasks, {"seed": 3})
    learner = rounds.begin(options)
    rounds.collect()
    for index in range(2):
        rounds.save(learner, [task.newest for task in tasks], {"index": index})
    first, second = rounds.policies([0, 1])
    with torch.no_grad():
        first.log_std.fill_(7.0)
    rounds.keep_latest(first)
    assert [file.relative_to(tmp_path).as_posix() for file in rounds.latest] == [
        "policy.safetensors",
        *(f"{name}/{file}" for name in scenes for file in ("value.safetensors", "checkpoint/checkpoint.safetensors")),
    ]
    kept = gn.load_pretrained(rounds.latest[0])
    assert (kept.policy.log_std == 7).all() and kept.config == {"seed": 3} and len(kept.scenes()) == 2
    for task in tasks:
        folder = tmp_path / rounds.folder(task)
        model = gn.load_pretrained(folder).model
        assert torch.equal(weights(model), weights(task.networks["model"]))
        assert (folder / "value.safetensors").read_bytes() == (
            tmp_path / "rounds/001" / task.scene.name / "value.safetensors"
        ).read_bytes()
    assert torch.equal(second.log_std, learner.playing().log_std)


def test_a_round_with_other_numbers_than_finite_ones_is_not_finished(small, tmp_path):
    rounds = Rounds(tmp_path, [balancing(options := small())], {})
    learner = rounds.begin(options)
    rounds.collect()
    with pytest.raises(ValueError, match=r"numbers\.json: .* finite numbers only"):
        rounds.save(learner, [rounds.tasks[0].newest], {"return": math.nan})
    assert rounds.finished == Rounds(tmp_path, rounds.tasks, {}).finished == 0


def test_damaged_trajectories_are_named(small, tmp_path):
    rounds = Rounds(tmp_path, [balancing(options := small())], {})
    learner = rounds.begin(options)
    rounds.collect()
    rounds.save(learner, [rounds.tasks[0].newest], {})
    file = tmp_path / "rounds/000/played.safetensors"
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(ValueError, match=r"played\.safetensors is damaged"):
        rounds.collect()
