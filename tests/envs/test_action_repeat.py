"""Environments whose step is several steps of the model."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.envs import ModelEnv
from torchrl_gn.planners import GradientPlanner, ILQGPlanner
from torchrl_gn.policies import StateValue
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene

from ..planners.test_gradient_planner import check_that_it_imagines_what_stepping_gives, trained
from ..sizes import SMALL


@pytest.fixture(scope="module")
def scene():
    return load_scene("pendulum")


@pytest.fixture(scope="module")
def model(scene):
    return trained(scene, **SMALL)


def starts(count: int) -> TensorDict:
    state = torch.zeros(count, 2, 13, dtype=torch.float64)
    state[..., 3] = 1.0
    state[:, 1, 11] = torch.linspace(-3, 3, count)
    return TensorDict({"state": state}, [count])


def by_hand(env: ModelEnv, start: TensorDict, actions: torch.Tensor, repeat: int):
    """States ``[B, H + 1, N, 13]`` and summed rewards ``[B, H, 1]`` of single model steps."""
    now, states, rewards = start, [start["state"]], []
    for action in actions.unbind(1):
        total = 0.0
        for _ in range(repeat):
            now = env.step(now.copy().set("action", action))["next"]
            total = total + now["reward"]
            now = now.select("state")
        states.append(now["state"])
        rewards.append(total)
    return torch.stack(states, 1), torch.stack(rewards, 1)


@pytest.mark.parametrize("specialized", [False, True])
def test_a_step_is_several_of_the_model(scene, model, specialized):
    model = specialize(model) if specialized else model
    reward, start, actions = make_reward("balance", scene), starts(4), torch.rand(4, 3, 1)
    env = ModelEnv(model, reward, action_repeat=3)
    assert env.scene.timestep == pytest.approx(3 * scene.timestep)
    check_env_specs(env)
    found = env.imagine(start, actions)
    for one, other in zip(found, by_hand(ModelEnv(model, reward), start, actions, 3), strict=True):
        torch.testing.assert_close(one, other)
    check_that_it_imagines_what_stepping_gives(env, start, actions)


def test_an_episode_ends_at_a_step_of_the_model(scene, model):
    reward, start, actions = make_reward("balance", scene), starts(5), torch.rand(5, 4, 1)

    def done(state):
        return (state[..., 1, 11:12].abs() > 2).float()

    ended = ModelEnv(model, reward, done=lambda state: done(state) > 0, action_repeat=2)
    single = ModelEnv(model, reward, done=lambda state: done(state) > 0)
    now, total, over = start, 0.0, torch.zeros(5, 1, dtype=torch.bool)
    for _ in range(2):
        now = single.step(now.copy().set("action", actions[:, 0]))["next"]
        total, over = total + torch.where(over, 0.0, now["reward"]), over | now["terminated"]
        now = now.select("state")
    after = ended.step(start.copy().set("action", actions[:, 0]))["next"]
    torch.testing.assert_close(after["reward"], total)
    assert over.any() and not over.all() and torch.equal(after["terminated"], over)
    rewards = ended.imagine(start, actions)[1]
    torch.testing.assert_close(rewards[:, 0], after["reward"])
    assert (rewards[over.squeeze(-1), 1:] == 0).all()


def test_a_value_counts_once_a_control_step(scene, model):
    reward, coarse = make_reward("balance", scene), load_scene("pendulum", timestep=2 * scene.timestep)
    value = StateValue(coarse, discount=0.9, hidden=(8,))
    value.features.fit(starts(20)["state"])
    value.normalizer.update(-torch.rand(100, 1))
    env, start, actions = ModelEnv(model, reward, terminal=value, action_repeat=2), starts(3), torch.rand(3, 3, 1)
    plain, paid = ModelEnv(model, reward, action_repeat=2).imagine(start, actions)
    with torch.no_grad():
        wanted = sum(0.9**k * paid[:, k] for k in range(3)) + 0.9**3 * value(plain[:, -1])
    torch.testing.assert_close(env.imagine(start, actions)[1].sum(1), wanted.to(paid.dtype))
    now, total = env.reset(start, set_state=True), 0.0
    for action in actions.unbind(1):
        now = env.step(now.set("action", action))["next"]
        total, now = total + now["reward"], now.exclude("reward", "done", "terminated")
    torch.testing.assert_close(total + value(start["state"]).to(paid.dtype), wanted.to(paid.dtype))


def test_recurrent_models_carry_their_hidden_state(scene):
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, core="recurrent", hidden_state=[4, 4, 4], **SMALL).bind(scene)
    env, single = ModelEnv(model, action_repeat=2), ModelEnv(model)
    start = single.reset(starts(3), set_state=True)
    action, now = torch.rand(3, 1), start
    for _ in range(2):
        now = single.step(now.copy().set("action", action))["next"].exclude("reward", "done", "terminated")
    after = env.step(env.reset(starts(3), set_state=True).set("action", action))["next"]
    torch.testing.assert_close(after["state"], now["state"])
    for name, value in now["hidden_state"].items(True, True):
        torch.testing.assert_close(after["hidden_state"][name], value)


def test_planners_on_it(scene, model):
    env = ModelEnv(specialize(model), make_reward("balance", scene), action_repeat=2)
    planner = GradientPlanner(env, 3, iterations=1, seed=0)
    assert planner(starts(2))["action"].shape == (2, 1)
    with pytest.raises(ValueError, match="ILQGPlanner plans single steps of a model, this environment repeats actions"):
        ILQGPlanner(env, 3)
    for wrong in (0, 1.5):
        with pytest.raises(ValueError, match=f"action_repeat={wrong} must be a whole number"):
            ModelEnv(model, action_repeat=wrong)
