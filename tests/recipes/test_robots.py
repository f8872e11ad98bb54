"""The robots of recipes/config/robot: their models load and their tasks can be planned for."""

from __future__ import annotations

import importlib.util
import json
import shutil

import pytest
import torch

from _common.options import scene_options
from _common.planning_task import reward_of
from _common.sweeps import override
from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.scenes import load_scene

from ..faults.server import serving
from .conftest import ROOT

ROBOTS = sorted(path.stem for path in (ROOT / "recipes/config/robot").glob("*.yaml"))
PENDULUM = ROOT / "tests/zoo/pole.xml"


@pytest.mark.filterwarnings("ignore::torchrl_gn.scenes.MissingMeshWarning", "ignore::torchrl_gn.data.StartPoseWarning")
@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_loads_and_has_a_task(compose, monkeypatch, name):
    monkeypatch.chdir(ROOT)
    config = compose("plan_and_learn", f"+robot={name}")
    if config.system.startswith("package://"):
        package = config.system.removeprefix("package://").split("/")[0]
        if importlib.util.find_spec(package) is None:  # importing it would need what its robots don't
            pytest.skip(f"{package} is not installed")
    scene = load_scene(config.system, **scene_options(config))
    reward = reward_of(config, scene)
    state = Simulator(scene).observe(sample_start_states(scene, 3, 0))
    action = torch.zeros(3, scene.num_actions, dtype=torch.float64)
    found = reward(state, action, state)
    assert found.shape == (3, 1) and found.isfinite().all()
    assert config.steps >= 100  # the length of training's trajectories


def test_values_come_back_as_hydra_reads_them(compose):
    reward = [
        {"type": "Distance", "body": "robot0:it's", "target": [0.5, -1.0, 2.0]},
        {"type": "Effort", "weight": 0.1},
    ]
    config = compose(
        "mpc", f"reward={override(reward)}", f"system={override('a/b c.xml')}", f"timestep={override(None)}"
    )
    assert [dict(term) for term in config.reward] == reward
    assert config.system == "a/b c.xml" and config.timestep is None


@pytest.mark.slow
def test_a_robot_of_ones_own_learns_from_the_first_model_on(tmp_path):
    shutil.copy(PENDULUM, tmp_path / "my pole.xml")
    options = (
        f"system={override(str(tmp_path / 'my pole.xml'))}",
        "timestep=0.01",
        "reward=[{type:Balance,bodies:[rod]}]",
        "horizon=3",
        "steps=100",
        "episodes=2",
        "rounds=1",
        "first_minutes=0.02",
        "minutes=0.02",
        "baselines=[nothing]",
        "planning=['gn.iterations=1','gn.warm_up=1','gn.samples=2']",
        "training=['data.train=20','data.validation=5','data.test=5','model.hidden=8']",
    )
    with serving() as server:  # a round starts several recipes, which are copies
        first = server.run("plan_and_learn", options, tmp_path)
        assert first.code == 0, first.said
        before = (tmp_path / "run/executed1/gn.safetensors").read_bytes()
        second = server.run("plan_and_learn", (*options, "rounds=2"), tmp_path)
        assert second.code == 0, second.said
    metrics = json.loads((tmp_path / "run/metrics.json").read_text())
    assert {f"{of}/mean_reward" for of in ("round 0", "round 1", "round 2", "nothing")} <= set(metrics)
    assert "| nothing |" in first.said and (tmp_path / "run/executed1/gn.gif").exists()
    assert (tmp_path / "run/executed1/gn.safetensors").read_bytes() == before  # a finished round is kept
    assert "| round 2 |" in second.said and "| nothing |" in second.said
