"""Rounds of recipes/shac.py with networks on the device, and MuJoCo beside it."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

import torchrl_gn as gn

from .device import NAME, without_waits

RECIPES = Path(__file__).parents[2] / "recipes"
sys.path.append(str(RECIPES))  # as Python does for a script there

from _common.actor_critic_rounds import ActorCritic, Round, Task  # noqa: E402
from _common.suite_rounds import suite_task  # noqa: E402

SMALL = {
    **{"system": "cheetah", "timestep": 0.02, "reward": "forward", "reward_steps": 3},
    "first": {"trajectories": 4, "length": 50, "steps": 2},
    "model": {"hidden": 8, "latent": 8},
    "graph": {"hidden": [8], "latent": 8},
    "evaluate": {"episodes": 2, "steps": 5},
    **{"updates": 3, "batch_size": 8, "horizon": 3, "hidden": [8], "episodes": 2, "steps": 50, "model_steps": 2},
}


def learner(device: str, begun: Round | None = None, **options) -> ActorCritic:
    cfg = OmegaConf.merge(OmegaConf.load(RECIPES / "config/shac.yaml"), SMALL, {"device": device, **options})
    assert isinstance(cfg, DictConfig)
    torch.manual_seed(0)
    if cfg.system.startswith("suite:"):
        task = suite_task(cfg, cfg.system)
    else:
        scene = gn.load_scene(cfg.system, timestep=cfg.timestep)
        reward = gn.make_reward(cfg.reward, scene)
        task = Task(cfg, scene, reward, reward, "")
    made = ActorCritic(cfg, [task], begun)
    made.tasks[0].collect([] if begun is None else [begun])
    return made


SWIMMER = {"system": "swimmer3", "reward": "near", "timestep": 0.1, "target_squares": [0.3, 2]}
REACHER = {"system": "suite:reacher/easy", "reward": "learned", "timestep": None, "per_frame": True, "outlier": 2.0}
TASKS = [{"reward": "run"}, {"policy": "graph"}, SWIMMER, REACHER]
NAMES = ["run", "graph", "near", "learned"]


@pytest.mark.parametrize("options", TASKS, ids=NAMES)
def test_rounds_are_those_of_the_cpu(gpu, tmp_path, options):
    found = []
    for device in ("cpu", NAME):
        made, kept, losses = learner(device, **options), Round(tmp_path / device, 0), []
        (task,) = made.tasks
        for index in range(2):
            torch.manual_seed(index)
            losses.append(made.learn(index))
            played = task.play(made.playing().for_scene(task.scene), seed=index)
            assert played["state"].is_cpu and len(played)
            if index == 0:
                made.save(kept)
                task.add(played, kept)
                kept.numbers.write_text("{}")
                made = learner(device, kept, **options)  # goes on from files
                (task,) = made.tasks
        assert {each.device.type for each in [*made.policy.parameters(), task.loss.log_alpha]} == {device}
        judged = task.judged(made.averaged(tmp_path / device, 1))
        numbers = {f"{name} {index}": of[name] for index, of in enumerate(losses) for name in of}
        found.append((numbers, judged["next", "reward"]))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-2, abs=1e-3)
    torch.testing.assert_close(found[1][1], found[0][1], rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("options", TASKS, ids=NAMES)
def test_what_is_recorded_never_waits(gpu, monkeypatch, options):
    weights, numbers = [], []
    for recorded in (False, True):
        made = learner(NAME, **options)
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
            numbers.append(found[len(optimizer.clipped) :].tolist())
        else:
            numbers.append(
                [float(each) for each in optimizer._update([partial(torch.clone, states)], "now")[0].values()]
            )
        weights.append(torch.cat([each.detach().flatten() for of in optimizer.clipped for each in of]).cpu())
    assert numbers[1] == pytest.approx(numbers[0])
    torch.testing.assert_close(weights[1], weights[0], rtol=1e-5, atol=1e-6)
