"""Steps of some of a batch's episodes, as TorchRL asks for them by its entry ``_step``."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import ActionDiscretizer, EnvBase, MultiAction, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_gn.dynamics import specialize
from torchrl_gn.envs import ModelEnv, SceneEnv, SuiteTaskEnv, batched
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained

CHUNK = 30


def fast(state: Tensor) -> Tensor:
    return state[..., 1, 11].abs() > 3


def make(kind: str) -> SceneEnv | ModelEnv:
    scene = load_scene("pendulum")
    reward = make_reward("balance", scene)
    if kind == "scene":
        return SceneEnv(scene, reward, done=fast, seed=0)
    return ModelEnv(specialize(load_pretrained("pendulum").bind(scene)), reward, done=fast, seed=0)


def one_by_one(env: EnvBase, start: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
    """Rewards ``[B, CHUNK, 1]`` until the end, the state there, and a mask of ended samples."""
    now, rewards, last = start, [], start["state"].clone()
    ended = torch.zeros(len(start), 1, dtype=torch.bool)
    for _ in range(CHUNK):
        after = env.step(now.clone().set("action", torch.ones(len(start), 1)))["next"]
        rewards.append(torch.where(ended, 0.0, after["reward"]))
        last = torch.where(ended.unsqueeze(-1), last, after["state"])
        ended = ended | after["done"]
        now = after.exclude("reward", "done", "terminated")
    return torch.stack(rewards, 1), last, ended


@pytest.mark.parametrize("counted", [False, True])
@pytest.mark.parametrize("kind", ["scene", "model"])
def test_a_chunk_of_actions_ends_with_the_episode(kind, counted):
    env = make(kind)
    start = env.reset(TensorDict(batch_size=[6]))
    rewards, last, ended = one_by_one(env, start.exclude("done", "terminated"))
    assert 0 < ended.sum() < 6
    pool = batched(make(kind), 6)
    pool = pool.append_transform(StepCounter()) if counted else pool
    given = TransformedEnv(pool, MultiAction(stack_rewards=True)).reset().update(start)
    after = TransformedEnv(pool, MultiAction(stack_rewards=True)).step(given.set("action", torch.ones(6, CHUNK, 1)))
    assert torch.equal(after["next", "done"], ended)
    assert torch.equal(after["next", "terminated"], ended)
    torch.testing.assert_close(after["next", "state"], last, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(after["next", "reward"].reshape(rewards.shape), rewards, rtol=1e-5, atol=1e-6)


def test_samples_that_are_not_to_be_stepped_stay_as_they_are():
    env = make("model")
    start = env.reset(TensorDict(batch_size=[2, 2]))
    start["action"] = torch.ones(2, 2, 1)
    whole, mask = env.step(start.clone())["next"], torch.tensor([[True, False], [False, True]])
    for shape in ([2, 2], [2, 2, 1]):
        some = env._step(start.clone().set("_step", mask.reshape(shape)))
        assert some["done"].dtype == torch.bool and set(some.keys()) == set(whole.keys())
        torch.testing.assert_close(some["state"][mask], whole["state"][mask], rtol=1e-6, atol=1e-9)
        assert torch.equal(some["state"][~mask], start["state"][~mask]) and not some["reward"][~mask].any()
    over = env._step(start.exclude("done", "terminated").set("_step", mask))
    assert torch.equal(over["terminated"].squeeze(-1), ~mask) and torch.equal(over["done"], over["terminated"])


def test_chunks_in_the_suite_end_with_each_episode():
    pytest.importorskip("dm_control.suite")
    env = SuiteTaskEnv(load_scene("suite:cartpole/swingup"), num_envs=2, seed=3)
    for steps, episode in zip((3, 5), env.episodes, strict=True):
        episode._step_limit = steps
    chunks = TransformedEnv(env, MultiAction(stack_rewards=False))
    after = chunks.step(chunks.reset().set("action", torch.ones(2, 4, 1)))["next"]
    assert after["truncated"].flatten().tolist() == [True, False]


def chunks(kind: str) -> TransformedEnv:
    return TransformedEnv(batched(make(kind), 3), MultiAction(stack_rewards=False))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scene", "model"])
def test_chunks_end_with_the_episode_in_workers_too(kind):
    """Whose checks compare what a step reads with what the steps before it wrote."""
    policy = TensorDictModule(lambda state: torch.ones(*state.shape[:-2], CHUNK, 1), ["state"], ["action"])
    played = []
    for container in (SerialEnv, ParallelEnv):
        env = container(2, partial(chunks, kind))
        env.set_seed(3)
        played.append(env.rollout(4, policy, break_when_any_done=False))
        env.close()
    assert played[0]["next", "done"].any() and not played[0]["next", "done"].all()
    for key in ("state", "done", "reward"):
        torch.testing.assert_close(played[0]["next", key], played[1]["next", key])


@pytest.mark.parametrize("transform", [lambda: MultiAction(), lambda: ActionDiscretizer(5)], ids=["chunks", "discrete"])
@pytest.mark.parametrize("kind", ["scene", "model"])
def test_a_batch_draws_actions_of_transforms_around_it(kind, transform):
    env = TransformedEnv(batched(make(kind), 3), transform())
    check_env_specs(env)
    drawn = env.rand_action(TensorDict(batch_size=[3]))["action"]
    assert drawn.shape[0] == 3 and drawn.shape[-1] == env.action_spec.shape[-1]
    assert env.rollout(2).shape == (3, 2)
