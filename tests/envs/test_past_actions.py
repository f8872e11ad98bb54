"""Models that read past commands: environments and planners pass them on, and choose only present commands."""

from __future__ import annotations

from typing import Any, cast

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from torchrl_gn.data import log_trajectories, log_tree, simulate_log, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.envs import ModelEnv
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.scenes import load_scene

HISTORY, ACTIONS = 3, 1


@pytest.fixture(scope="module", params=["gn", "recurrent"])
def model(request) -> tuple[Predictor, torch.Tensor, torch.Tensor]:
    """A model of a double pendulum with one motor, and logged states and actions."""
    log = simulate_log(load_scene("acrobot"), 3, 60, 0)
    tree = cast(Any, log_tree(log, "double", commands=[[0], []], history=HISTORY))
    data, _ = log_trajectories(log, 20, history=HISTORY)
    torch.manual_seed(0)
    core = {"core": "recurrent", "hidden_state": [4, 4, 4]} if request.param == "recurrent" else {}
    network = ForwardModel.for_scene(tree, hidden=[8], **core).double()
    ForwardModelLoss(network.bind(tree)).fit_normalizers(trajectory_buffer(data, batch_size=50, seed=0).sample())
    return network.bind(tree), data["state"], data["action"]


def make_env(model, **options) -> ModelEnv:
    def swung(state, action, next_state, task):
        assert action.shape[-1] == ACTIONS
        return next_state[..., 1, :1]

    return ModelEnv(model[0], swung, start_states=model[1].flatten(0, 1), seed=0, **options)


def start(model) -> tuple:
    """A TensorDict of logged states with their past actions, and the actions that follow."""
    bound, state, action = model
    env = make_env(model)
    first = env.reset().expand(len(state)).clone()
    first["state"], first["past_actions"] = state[:, 0], action[:, 0, ACTIONS:, None].float()
    return env, first, action[..., :ACTIONS]


def test_specs(model):
    env = make_env(model)
    check_env_specs(env)
    assert env.action_spec.shape == (ACTIONS,) and env.reset()["past_actions"].shape == (HISTORY, ACTIONS)


def test_a_done_module_reads_the_commands_after_the_step(model):
    sent = TensorDictModule(lambda past: past[..., 0, :1] > 0.5, ["past_actions"], ["terminated"])
    env = make_env(model, done=sent)
    now = env.reset().set("action", torch.ones(ACTIONS))
    assert bool(env.step(now)["next", "terminated"]) and not bool(now["past_actions"].any())


def test_steps_and_sequences_see_the_logged_commands(model):
    bound, state, action = model
    env, td, present = start(model)
    expected = bound.rollout(state[:, 0], action)[0]
    states, _ = env.imagine(td, present)
    torch.testing.assert_close(states, expected, rtol=1e-6, atol=1e-6)
    for step in range(present.shape[1]):
        td = env.step(td.set("action", present[:, step].float()))["next"].exclude("reward")
        torch.testing.assert_close(td["state"], expected[:, step + 1], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(td["past_actions"][..., 0], present[..., 0].flip(1)[:, :HISTORY].float())


def test_an_action_has_the_gradient_of_all_later_steps(model):
    env, td, present = start(model)
    present = present[:, :HISTORY].clone().requires_grad_()
    states, _ = env.imagine(td, present)
    (gradient,) = torch.autograd.grad(states[:, -1].sum(), present)
    moved, by = present.detach().clone(), 1e-5
    moved[:, 0] += by
    change = env.imagine(td, moved)[0][:, -1].sum() - states[:, -1].sum()
    assert change.item() == pytest.approx(gradient[:, 0].sum().item() * by, rel=1e-2, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("specialized", [False, True])
def test_a_planner_hands_past_actions_on(model, specialized):
    network = specialize(model[0]) if specialized else model[0]
    env = ModelEnv(network, make_env(model).reward, start_states=model[1].flatten(0, 1), seed=0)
    planner = GradientPlanner(env, horizon=4, iterations=2, samples=4, seed=0)
    executed = env.rollout(6, planner)
    past = executed["past_actions"][..., 0]
    assert (past[0] == 0).all()
    for step in range(1, 6):
        assert torch.equal(past[step, : min(step, HISTORY)], executed["action"][:step, 0].flip(0)[:HISTORY])
    primer = planner.make_tensordict_primer()
    assert primer.primers is not None and "past_actions" in primer.primers.keys()
