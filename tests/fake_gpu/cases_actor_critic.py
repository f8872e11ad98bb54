"""Rounds of recipes/shac.py with networks on the device, and MuJoCo beside it."""

from __future__ import annotations

from functools import partial

import pytest
import torch

import torchrl_gn as gn
import torchrl_gn.actor_critic.task as task_module
from torchrl_gn.actor_critic import (
    ActorCritic,
    ActorCriticOptions,
    ActorCriticTask,
    EvaluationEpisodes,
    FirstTrajectories,
    Rounds,
    SuiteActorCriticTask,
    TargetSquares,
)
from torchrl_gn.actor_critic.novelty import novelty

from .device import NAME, without_waits

SMALL = {
    "first": FirstTrajectories(trajectories=4, length=50, steps=2),
    "model": {"hidden": 8, "latent": 8},
    "graph": {"hidden": [8], "latent": 8},
    "evaluate": EvaluationEpisodes(episodes=2, steps=5),
    **{"updates": 3, "batch_size": 8, "horizon": 3, "hidden": [8], "episodes": 2, "steps": 50, "model_steps": 2},
    "reward_steps": 3,
    "novelty_rounds": 0,  # a model of two steps barely heeds controls: which are most novel is rounding
}


def options_of(device: str, **others) -> ActorCriticOptions:
    return ActorCriticOptions(**{**SMALL, "device": device, **others})


def make_task(system: str, options: ActorCriticOptions) -> ActorCriticTask:
    torch.manual_seed(0)
    if system.startswith("suite:"):
        return SuiteActorCriticTask(system, options)
    scene = gn.load_scene(system, timestep=0.1 if system == "swimmer3" else 0.02)
    if system == "swimmer3":
        squares = TargetSquares(scene, [0.3, 2])
        return ActorCriticTask(scene, options, gn.make_reward("near", scene), squares=squares)
    return ActorCriticTask(scene, options, gn.make_reward("forward" if options.policy == "graph" else "run", scene))


TASKS = [
    ("cheetah", {}),
    ("cheetah", {"policy": "graph"}),
    ("swimmer3", {}),
    ("suite:reacher/easy", {"per_frame": True, "outlier": 2.0}),
]
NAMES = ["run", "graph", "near", "learned"]


@pytest.mark.parametrize(("system", "others"), TASKS, ids=NAMES)
def test_rounds_are_those_of_the_cpu(gpu, tmp_path, system, others):
    found = []
    for device in ("cpu", NAME):
        options, losses = options_of(device, **others), []
        for index in range(2):
            task = make_task(system, options)
            kept = Rounds(tmp_path / device, [task], {})
            made = kept.begin(options)  # the second from files
            assert kept.finished == index
            kept.collect()
            torch.manual_seed(index)
            losses.append(made.learn(index))
            played = task.play(made.playing(), seed=index)
            assert played["state"].is_cpu and len(played)
            kept.save(made, [played], {})
        assert {each.device.type for each in [*made.policy.parameters(), task.loss.log_alpha]} == {device}
        evaluated = task.evaluate(made.averaged(kept.policies(made.averaged_rounds(1))))
        numbers = {f"{name} {index}": of[name] for index, of in enumerate(losses) for name in of}
        found.append((numbers, evaluated["next", "reward"]))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-2, abs=1e-3)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize(("system", "others"), TASKS, ids=NAMES)
def test_novelty_is_that_of_the_cpu(gpu, calls, system, others):
    found = []
    for device in ("cpu", NAME):
        asked = calls(task_module, "novelty", lambda *given: novelty(*given).cpu())
        options = options_of(device, **others, novelty_rounds=1)
        task = make_task(system, options)
        made = ActorCritic([task], options)
        task.collect()
        torch.manual_seed(0)
        made.learn(0)
        assert len(task.play(made.playing(), seed=0))
        found.append(asked[0])  # later ones start where these controls led
    assert found[0].std() > 0
    torch.testing.assert_close(found[1], found[0], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("system", "others"), TASKS, ids=NAMES)
def test_what_is_recorded_never_waits(gpu, monkeypatch, system, others):
    weights, numbers = [], []
    for recorded in (False, True):
        options = options_of(NAME, **others)
        made = ActorCritic([make_task(system, options)], options)
        made.tasks[0].collect()
        torch.manual_seed(0)
        made.learn(0)
        optimizer, draw = made.optimizer, made.tasks[0].starts()
        with without_waits():
            states = draw(8)
        torch.manual_seed(1)
        if recorded:
            optimizer._states = [states]
            optimizer.optimizer.zero_grad()
            for name in ("is_initialized", "is_current_stream_capturing"):  # what says that a graph is recorded
                monkeypatch.setattr(torch.cuda, name, lambda: True)
            with without_waits():
                found = optimizer._on_device()
            monkeypatch.undo()
            numbers.append(found[:3].tolist())
        else:
            numbers.append(
                [float(each) for each in optimizer._update([partial(torch.clone, states)], "now")[0].values()]
            )
        weights.append(torch.cat([each.detach().flatten() for of in optimizer.clipped for each in of]).cpu())
    assert numbers[1] == pytest.approx(numbers[0])
    torch.testing.assert_close(weights[1], weights[0], rtol=1e-5, atol=1e-6)
