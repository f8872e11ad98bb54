"""``torch.set_default_device`` moves new networks and models, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import torchrl_gn as gn
from torchrl_gn.data import create_dataset
from torchrl_gn.evaluation import evaluate_errors, half_step_errors, joint_errors, pose_errors
from torchrl_gn.planners import GradientPlanner, ILQGPlanner, PlanAhead, SamplingPlanner
from torchrl_gn.policies import StatePolicy, StateReward, StateValue
from torchrl_gn.training import fit_policy, fit_reward, fit_value, identify_parameters


@pytest.fixture(scope="module")
def scene():
    return gn.load_scene("pendulum")


@pytest.fixture
def default_device(gpu) -> Iterator[torch.device]:
    torch.set_default_device(gpu)
    yield gpu
    torch.set_default_device("cpu")


@pytest.fixture(scope="module")
def trajectories(scene) -> TensorDict:
    return gn.collect_trajectories(scene, 6, steps=25, seed=0)


def test_data_are_the_same_on_the_cpu(default_device, scene, trajectories, tmp_path):
    collected = gn.collect_trajectories(scene, 6, steps=25, seed=0)
    assert all(torch.equal(collected[key], trajectories[key]) for key in ("state", "action", "physics"))
    followed = gn.collect_trajectories([scene, scene], 3, 5, policy=StatePolicy(scene, hidden=[8]))
    assert {each.device.type for each in followed.values(True, True)} == {"cpu"}
    split = create_dataset(tmp_path / "data", scene, 4, 3, 3, steps=5, variants=2).train
    assert {each.device.type for each in split.values(True, True)} == {"cpu"}


def test_models_train_there_and_are_measured(default_device, gpu, scene, trajectories):
    model = gn.ForwardModel.for_scene(scene, hidden=8, layers=1).bind(scene)
    gn.fit(model, trajectories, steps=3, progress=False)
    assert {each.device for each in model.parameters()} == {gpu}
    trained = gn.load_pretrained("pendulum").bind(scene)
    assert evaluate_errors(trained, trajectories, horizons=(20,)).errors["rollout_error_20"].total < 1e-6
    assert joint_errors(trained, trajectories).mean_square < 1e-6
    assert pose_errors(trained, trajectories).rotation.max() < 1e-2
    assert half_step_errors(scene, trajectories, horizons=(20,)).errors["one_step_error"].total < 1e-2
    assert abs(identify_parameters(scene, trajectories, {"dof_damping": None}, window=10).factor[0] - 1) < 1e-2


def test_networks_learn_from_episodes(default_device, gpu, scene, trajectories):
    state, action = trajectories["state"], trajectories["action"]
    reward = -action.square()
    episodes = TensorDict(
        {"state": state[:, :-1], "action": action, "next": {"state": state[:, 1:], "reward": reward}}, action.shape[:2]
    )
    networks = StateValue(scene, hidden=[8]), StatePolicy(scene, hidden=[8]), StateReward(scene, hidden=[8])
    fit_value(networks[0], episodes, iterations=1, steps=2)
    fit_policy(networks[1], episodes, steps=2)
    fit_reward(networks[2], TensorDict({"state": state, "action": action, "reward": reward}, [6]), steps=2)
    assert {each.device for network in networks for each in network.parameters()} == {gpu}


@pytest.mark.parametrize("kind", ["gradient", "sampling", "ilqg", "true physics", "ahead"])
def test_planners_act(gpu, scene, kind):
    """The actions are those without a default device."""
    reward, actions = gn.make_reward("balance", scene), []
    for device in ("cpu", gpu):
        torch.set_default_device(device)
        try:
            model = gn.specialize(gn.load_pretrained("pendulum").bind(scene), executor="eager")
            env = gn.SceneEnv(scene, reward, seed=0)
            imagined = env if kind == "true physics" else gn.ModelEnv(model, reward)
            if kind == "gradient":
                planner = GradientPlanner(imagined, 3, 1, warm_up=2, samples=4, seed=0)
            elif kind in ("sampling", "ahead"):
                planner = SamplingPlanner(imagined, 3, 1, samples=8, elites=4, seed=0)
                planner = PlanAhead(planner) if kind == "ahead" else planner
            else:
                planner = ILQGPlanner(imagined, 3, 1, warm_up=2, seed=0)
            actions.append(env.rollout(3, planner)["action"])
        finally:
            torch.set_default_device("cpu")
    assert actions[1].device.type == "cpu" and np.allclose(*actions, rtol=1e-4, atol=1e-4)


def test_models_are_measured_on_trajectories_elsewhere(gpu, scene, trajectories):
    here = gn.load_pretrained("pendulum").bind(scene)
    there = gn.load_pretrained("pendulum").model.to(gpu).bind(scene)
    for measure in (joint_errors, pose_errors):
        found, wanted = (measure(model, trajectories).to_metrics() for model in (there, here))
        assert found == pytest.approx(wanted, rel=1e-2, abs=1e-9)
