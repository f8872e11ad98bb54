"""The swimmer that swims on purpose, for data unlike random control's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from torchrl_gn.data import UnstableSimulationError
from torchrl_gn.envs import SceneEnv
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph, load_scene
from torchrl_gn.training import RunFolder


@pytest.mark.slow
def test_the_gait_that_is_found_carries_the_swimmer(load):
    recipe, scene, rng = load("data_shift"), load_scene("swimmer6"), np.random.default_rng(0)
    cfg = OmegaConf.create({"search": {"generations": 3, "population": 16, "starts": 1, "steps": 200}})
    gait, _ = recipe.find_gait(scene, cfg, rng)
    assert (gait >= recipe.LOW).all() and (gait <= recipe.HIGH).all()
    swum = recipe.swim(scene, gait, 6, 200, rng)
    assert swum["state"].shape == (6, 201, scene.num_nodes, 13) and swum["action"].shape == (6, 200, 5)
    assert (np.abs(swum["action"].numpy()) <= scene.action_high).all()
    # Joints that move all at once carry it nowhere.
    still = recipe.swim(scene, np.array([gait[0], gait[1], 0.0]), 6, 200, np.random.default_rng(1))
    assert recipe.distance(swum["state"]).mean() > 5 * recipe.distance(still["state"]).mean()


def test_a_policys_actions_are_held_and_unstable_swims_are_no_data(load, monkeypatch):
    recipe, scene = load("data_shift"), load_scene("swimmer3")
    agent = Agent(ObservationGraph.swimmer(3), model=None)
    swum = recipe.swim_by_policy(scene, agent, 5, 2, 10, 0)
    assert swum["state"].shape == (2, 11, scene.num_nodes, 13) and swum["action"].shape == (2, 10, 2)
    held = swum["action"].unflatten(1, (2, 5))
    assert torch.equal(held, held[:, :, :1].expand_as(held)) and not torch.equal(held[:, 0], held[:, 1])
    step = SceneEnv._step
    ended = torch.ones(2, 1, dtype=torch.bool)
    monkeypatch.setattr(SceneEnv, "_step", lambda env, now: step(env, now).set("terminated", ended))
    with pytest.raises(UnstableSimulationError, match="2 of 2 swimmers became unstable"):
        recipe.swim_by_policy(scene, agent, 5, 2, 10, 0)


def test_other_data_are_no_continuation(call, compose, tmp_path):
    config = OmegaConf.to_yaml(compose("data_shift", "system=swimmer4"))
    RunFolder(tmp_path, "data_shift").write_config(config)
    code, _, errors = call("search.generations=9", "seed=7", "minutes=9", f"run_dir={tmp_path}", recipe="data_shift")
    assert code == 1 and "search.generations=9 (was " in errors and "seed=7 (was 0), system=swimmer6 (was" in errors
    assert (tmp_path / "config.yaml").read_text().endswith(config) and "minutes" not in errors
