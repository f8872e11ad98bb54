"""Progress towards a target, in simulations that get there and in geometry."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential

from torchrl_gn.envs import SceneEnv
from torchrl_gn.rewards import FreezeGoal, Reach, make_reward


@pytest.fixture(scope="module")
def swimming(steps):
    return steps("swimmer6")


@pytest.fixture
def reward(swimming):
    return make_reward("reach", swimming.scene)


def at(scene, x: float, y: float, dtype=torch.float64) -> torch.Tensor:
    """State ``[N, 13]`` with the head somewhere."""
    state = torch.zeros(scene.num_nodes, 13, dtype=dtype)
    state[:, 3] = 1
    state[1, :2] = torch.tensor([x, y], dtype=dtype)
    return state


def test_swimming_to_the_target_pays_and_away_costs(swimming, reward):
    """The rewards of a path add up to the way made, less the shaping."""
    head = swimming.path[..., 1, :3]
    way = head[:, -1] - head[:, 0]
    distance = way[:, :2].norm(dim=-1)
    assert (distance > 1e-3).all()
    for sign in (1, -1):
        target = head[:, 0] + sign * 7 * way
        task = reward.task_of(swimming.path[:, 0], target).unsqueeze(1)
        got = reward(swimming.path[:, :-1], swimming.actions, swimming.path[:, 1:], task).sum((1, 2))
        torch.testing.assert_close(got, sign * distance, rtol=1e-2, atol=0)
        assert (got * sign > 0).all()


def test_shaping_takes_the_square_of_going_sideways(swimming):
    scene = swimming.scene
    start, goal = at(scene, 1, 1), torch.tensor([1.0, 6.0, 3.0], dtype=torch.float64)
    for shaping in (0.0, 0.01, 2.0):
        reward = Reach(scene, "head", shaping=shaping)
        task = reward.task_of(start, goal)
        for dx, dy in ((0.3, 0.0), (-0.3, 0.0), (0.2, 0.5), (0.0, -0.5)):
            got = reward(start, None, at(scene, 1 + dx, 1 + dy), task)
            assert got.item() == pytest.approx(dy - shaping * dx**2, abs=1e-15)


def test_direction_is_horizontal_and_of_unit_length(swimming, reward):
    state = swimming.state
    for scale in (1e-6, 1.0, 1e8, 1e200):
        target = state[:, 1, :3] + scale * torch.tensor([3.0, -4.0, 12.0], dtype=torch.float64)
        wanted = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64).expand(4, 3)
        torch.testing.assert_close(reward.task_of(state, target), wanted, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_the_target_there_is_no_direction_and_no_nan(swimming, reward, dtype):
    scene = swimming.scene
    start = at(scene, 0.5, -2, dtype).requires_grad_()
    target = torch.tensor([0.5, -2.0, 9.0], dtype=dtype, requires_grad=True)
    task = reward.task_of(start, target)
    assert torch.equal(task, torch.zeros(3, dtype=dtype))
    value = reward(start, None, at(scene, 1, 1, dtype), task)
    assert value.item() == 0
    value.sum().backward()
    assert start.grad.isfinite().all() and target.grad.isfinite().all()


def test_task_is_in_the_dtype_of_the_state(swimming, reward):
    assert reward.task_of(swimming.state, torch.ones(4, 3)).dtype == torch.float64
    assert reward.task_of(swimming.state.float(), torch.ones(4, 3, dtype=torch.float64)).dtype == torch.float32


def test_missing_or_misshapen_tasks_are_named(swimming, reward):
    state = swimming.state
    with pytest.raises(ValueError, match=r"Reach needs a task: .*'target' \[3\].*FreezeGoal"):
        reward(state, None, state)
    for bad in (torch.ones(4, 2), torch.ones(()), torch.ones(2, 3), torch.ones(2, 4, 3)):
        with pytest.raises(ValueError, match=r"task of Reach must be \[4, 3\]"):
            reward(state, None, state, bad)
    for bad in (torch.ones(4, 2), torch.ones(3), torch.ones(2, 4, 3)):
        with pytest.raises(ValueError, match=r"target of Reach must be \[4, 3\] for states"):
            reward.task_of(state, bad)
    for bad in (math.nan, math.inf):
        target = torch.ones(4, 3)
        target[2, 1] = bad
        with pytest.raises(ValueError, match=rf"target of Reach has {bad} at index \(2, 1\)"):
            reward.task_of(state, target)
    for bad in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="shaping must be a finite number from 0"):
            Reach(swimming.scene, "head", shaping=bad)


def test_one_task_serves_a_whole_batch(swimming, reward):
    task = reward.task_of(swimming.state[0], torch.ones(3))
    one = reward(swimming.path[:, :-1], None, swimming.path[:, 1:], task)
    many = reward(swimming.path[:, :-1], None, swimming.path[:, 1:], task.expand(4, 30, 3))
    assert torch.equal(one, many) and one.shape == (4, 30, 1)


def test_freeze_goal_writes_the_task_of_every_step(swimming, reward):
    """The module runs before a policy in the true environment; an episode's steps share its target."""
    env = SceneEnv(swimming.scene, reward, num_threads=1, seed=0)
    actions = iter(swimming.actions[0].float())
    policy = TensorDictModule(lambda state: next(actions), in_keys=["state"], out_keys=["action"])
    start = env.reset()
    start["target"] = torch.tensor([3.0, 4.0, 0.0], dtype=torch.float64)
    executed = env.rollout(10, TensorDictSequential(FreezeGoal(reward), policy), tensordict=start, auto_reset=False)
    assert torch.equal(executed["target"], start["target"].expand(10, 3))
    head, after = executed["state"][:, 1, :2], executed["next", "state"][:, 1, :2]
    way = start["target"][:2] - head
    direction = way / way.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(executed["task"][:, :2], direction)
    moved = after - head
    across = moved[:, 1] * direction[:, 0] - moved[:, 0] * direction[:, 1]
    wanted = (moved * direction).sum(-1) - 0.01 * across**2
    torch.testing.assert_close(executed["next", "reward"].squeeze(-1), wanted.float(), rtol=1e-5, atol=1e-9)
    assert wanted.abs().max() > 1e-5
    assert (executed["task"][0] != executed["task"][-1]).any()  # fixed anew with every plan


def test_without_a_task_the_environment_says_what_is_missing(swimming, reward):
    with pytest.raises(ValueError, match="Reach needs a task"):
        SceneEnv(swimming.scene, reward, num_threads=1, seed=0).rollout(2)


def test_freeze_goal_needs_a_reward_with_target_and_its_entries(swimming, steps, reward):
    with pytest.raises(TypeError, match="takes a Reward, .* got function"):
        FreezeGoal(lambda *args: None)
    with pytest.raises(ValueError, match=r"Balance\(.*\) needs no target: leave FreezeGoal out"):
        FreezeGoal(make_reward("balance", steps("pendulum").scene))
    freeze = FreezeGoal(reward)
    assert (freeze.in_keys, freeze.out_keys) == (["state", "target"], ["task"])
    with pytest.raises(KeyError, match=r"needs an entry 'target' \[4, 3\]"):
        freeze(TensorDict({"state": swimming.state}, batch_size=[4]))
    with pytest.raises(KeyError, match="needs an entry 'state'"):
        freeze(TensorDict({"target": torch.ones(4, 3)}, batch_size=[4]))
    with pytest.raises(ValueError, match="target of Reach"):
        freeze(TensorDict({"state": swimming.state, "target": torch.ones(4, 2)}, batch_size=[4]))
    torch.testing.assert_close(
        freeze(state=swimming.state, target=torch.ones(4, 3)), reward.task_of(swimming.state, torch.ones(4, 3))
    )
