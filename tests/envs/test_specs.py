"""Valid results of a user's functions."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import EnvBase

from torchrl_gn.envs import ModelEnv, SceneEnv


def reward_float(state, action, next_state, task=None):
    return 1.0


def reward_numpy(state, action, next_state, task=None):
    return next_state.detach().numpy()[..., 1, 11:12]


def reward_flat(state, action, next_state, task=None):
    return next_state[..., 1, 11]


def reward_bool(state, action, next_state, task=None):
    return next_state[..., 1, 11:12] > 0


def both(pendulum, model_env, **options) -> list[EnvBase]:
    return [SceneEnv(pendulum, seed=0, **options), ModelEnv(model_env.world_model, seed=0, **options)]


@pytest.mark.parametrize("reward", ["balance", [{"type": "Effort"}]])
def test_a_reward_by_name_or_options_is_refused(pendulum, reward):
    with pytest.raises(TypeError, match=r"must be a function of .*; use make_reward\(.*(balance|Effort).*, scene\)"):
        SceneEnv(pendulum, reward)


@pytest.mark.parametrize(
    ("reward", "error", "text"),
    [
        (reward_float, TypeError, r"the reward must be a tensor \[1\], reward_float returned 1.0"),
        (reward_numpy, TypeError, r"the reward must be a tensor \[1\], reward_numpy returned ndarray"),
        (reward_flat, ValueError, r"the reward must be \[1\], reward_flat returned \[\]"),
    ],
)
def test_rewards_that_are_no_column_are_named(pendulum, model_env, reward, error, text):
    for env in both(pendulum, model_env, reward=reward):
        with pytest.raises(error, match=text):
            env.rollout(2)


def test_a_bool_is_a_reward(pendulum, model_env):
    for env in both(pendulum, model_env, reward=reward_bool):
        played = env.rollout(3)["next"]
        assert torch.equal(played["reward"], (played["state"][..., 1, 11:12] > 0).float())


@pytest.mark.parametrize("result", [True, 1.0, torch.ones(3, dtype=torch.bool), torch.ones(1), None])
def test_ends_that_are_no_column_of_bool_are_named(pendulum, model_env, result):
    for env in both(pendulum, model_env, done=lambda state: result):
        with pytest.raises(ValueError, match=r"done= must give 'terminated', bool \[\] or \[1\], got"):
            env.rollout(2)


def test_a_terminal_value_that_is_no_tensor_is_named(pendulum, model_env):
    for env in both(pendulum, model_env, terminal=lambda state: 1.0):
        with pytest.raises(TypeError, match=r"the terminal value must be a tensor \[1\], .*lambda.* returned 1.0"):
            env.rollout(2)
