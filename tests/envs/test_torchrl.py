"""TorchRL's requirements on environments, for both environments."""

from __future__ import annotations

import pickle
import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import CEMPlanner, MPPIPlanner, WorldModel
from torchrl.objectives.value import TDLambdaEstimator

from torchrl_gn.envs import ModelEnv, SceneEnv, batched, world_model_env
from torchrl_gn.rewards import make_reward

from .. import zoo


@pytest.fixture(autouse=True)
def no_warnings():
    """Turn every warning into an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def linear(width: int) -> nn.Module:
    """Float32 network on float64 states ``[*B, N, 13]``."""

    class Head(nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = nn.Linear(26, width)

        def forward(self, state: torch.Tensor) -> torch.Tensor:
            return self.layer(state.flatten(-2).float()).tanh()

    return Head()


def cem(env: SceneEnv | ModelEnv, horizon: int = 5) -> CEMPlanner:
    return CEMPlanner(env, planning_horizon=horizon, optim_steps=2, num_candidates=8, top_k=3)


def mppi(env: SceneEnv | ModelEnv) -> MPPIPlanner:
    value = TensorDictModule(linear(1), in_keys=["state"], out_keys=["state_value"])
    advantage = TDLambdaEstimator(gamma=0.99, lmbda=0.95, value_network=value)
    return MPPIPlanner(env, advantage, temperature=1.0, planning_horizon=5, optim_steps=2, num_candidates=8, top_k=3)


def test_specs_hold(env):
    check_env_specs(env)
    for size in ([4], [2, 3]):
        check_env_specs(env, tensordict=env.reset(TensorDict(batch_size=size)))


def test_specs_hold_for_a_swimmer(swimmer):
    check_env_specs(SceneEnv(swimmer))


def test_rollout_of_a_batch(env):
    executed = env.rollout(6, tensordict=TensorDict(batch_size=[4]))
    assert executed.shape == (4, 6)
    assert executed["next", "reward"].shape == (4, 6, 1)
    assert executed["action"].dtype == executed["next", "reward"].dtype == torch.float32
    assert executed["state"].dtype == torch.float64
    assert not executed["next", "done"].any()


def test_time_limits_by_step_counter(env):
    limited = TransformedEnv(env, StepCounter(max_steps=4))
    assert limited.rollout(10).shape == (4,)
    executed = limited.rollout(10, break_when_any_done=False)
    assert executed["next", "truncated"].flatten().tolist() == [False, False, False, True] * 2 + [False, False]
    assert not executed["next", "terminated"].any()
    again = executed["state"][4]  # a fresh start, and the state before it is kept under "next"
    assert not torch.equal(again, executed["next", "state"][3])


@pytest.mark.parametrize("size", [None, 4])
def test_collector_and_replay_buffer(env, size):
    limit = StepCounter(max_steps=5)
    env = TransformedEnv(env, limit) if size is None else batched(env, size).append_transform(limit)
    check_env_specs(env)
    policy = TensorDictModule(linear(1), in_keys=["state"], out_keys=["action"])
    collector = Collector(env, policy, frames_per_batch=40, total_frames=80, auto_register_policy_transforms=False)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=16)
    for data in collector:
        assert data.numel() == 40
        assert data["next", "truncated"].sum() == 8
        buffer.extend(data.reshape(-1))
    collector.shutdown()
    sample = buffer.sample()
    assert sample["next", "state"].shape == (16, 2, 13)
    with torch.no_grad():
        torch.testing.assert_close(policy(sample.clone())["action"], sample["action"])


def test_a_batch_has_starts_of_its_own(env):
    many = batched(env, 2, 3)
    for _ in range(2):
        start = many.reset()
        assert start.shape == (2, 3)
        assert len({tuple(row) for row in start["state"].flatten(2).flatten(0, 1).tolist()}) == 6
    copied = pickle.loads(pickle.dumps(many))
    assert copied.rollout(3).shape == (2, 3, 3)
    for wrong in ((), (0,)):
        with pytest.raises(ValueError, match="at least 1|1 or more"):
            batched(env, *wrong)


def test_dreams_have_the_specs_of_the_scene(env, model_env):
    model = model_env.world_model
    step = ["state", "action", ("next", "state")]
    world = WorldModel(
        encoder=TensorDictModule(torch.nn.Identity(), in_keys=["state"], out_keys=["state"]),
        dynamics=model,
        reward_head=TensorDictModule(model_env.reward, in_keys=step, out_keys=[("next", "reward")]),
    )
    dreams, many = world_model_env(world, env, 2, 3), batched(env, 2, 3)
    assert dreams.action_spec == many.action_spec and dreams.reward_spec == many.reward_spec
    starts = many.reset().select("state")
    dreamt = dreams.rollout(4, tensordict=starts.clone(), auto_reset=False)
    assert dreamt["next", "reward"].shape == (2, 3, 4, 1) and dreamt["action"].shape == (2, 3, 4, 1)
    torch.testing.assert_close(dreamt["state"][:, :, 0], starts["state"])


def test_serial_env(pendulum):
    env = SerialEnv(3, lambda: SceneEnv(pendulum, make_reward("balance", pendulum)))
    env.set_seed(0)
    check_env_specs(env)
    executed = env.rollout(3)
    assert executed.shape == (3, 3)
    assert len(set(executed["physics"][:, 0, 1].tolist())) == 3
    env.close()


@pytest.mark.parametrize("planner", [cem, mppi])
def test_planners_run(env, planner):
    torch.manual_seed(0)
    act = planner(env)
    for size in ([], [2]):
        start = env.reset(TensorDict(batch_size=size))
        executed = env.rollout(3, act, tensordict=start, auto_reset=False)
        assert executed["action"].shape == (*size, 3, 1)
        assert executed["action"].abs().max() <= 1
        assert executed["next", "reward"].isfinite().all()


def test_planner_on_the_model_acts_in_the_true_environment(scene_env, model_env):
    act = cem(model_env)
    executed = scene_env.rollout(3, act, tensordict=scene_env.reset(TensorDict(batch_size=[2])), auto_reset=False)
    replayed = scene_env.step(executed.exclude("next"))["next"]
    assert torch.equal(replayed["physics"], executed["next", "physics"])


def test_planner_as_collector_policy(env):
    collector = Collector(env, cem(env), frames_per_batch=5, total_frames=10, auto_register_policy_transforms=False)
    assert [data.numel() for data in collector] == [5, 5]
    collector.shutdown()


def test_same_seed_same_run(env):
    def run() -> TensorDict:
        torch.manual_seed(0)
        env.set_seed(0)
        return env.rollout(5, cem(env))

    assert (run() == run()).all()


@pytest.mark.slow
def test_cem_on_the_true_physics_keeps_the_pendulum_balanced(pendulum):
    # From up to 6 degrees: beyond about 11 the motor cannot hold the pole against gravity.
    def starts(n, rng):
        physics = torch.zeros(n, pendulum.physics_size, dtype=torch.float64).numpy()
        physics[:, 1] = rng.uniform(-0.1, 0.1, n)
        return physics

    torch.manual_seed(0)
    env = SceneEnv(pendulum, make_reward("balance", pendulum), start_states=starts, seed=0)
    start = env.reset(TensorDict(batch_size=[3]))
    act = CEMPlanner(env, planning_horizon=10, optim_steps=2, num_candidates=48, top_k=6)
    planned = env.rollout(50, act, tensordict=start.clone(), auto_reset=False)["next", "reward"]
    random = env.rollout(50, tensordict=start.clone(), auto_reset=False)["next", "reward"]
    assert (planned[:, -10:] > -0.05).all()
    assert random.sum(1).mean() < planned.sum(1).mean() - 5


def test_an_unstable_candidate_neither_ends_nor_wins_a_search():
    # Every step costs 1, so that ending an episode would pay if blowing up cost nothing.
    # MuJoCo gives up beyond 1e10 m/s^2, that is |action| > 0.5 here.
    torch.manual_seed(0)
    scene = zoo.load("cart", ('gear="1"', 'gear="2e10"'))
    env = SceneEnv(scene, lambda state, action, next_state, task: -torch.ones_like(action), seed=0)
    act = CEMPlanner(env, planning_horizon=2, optim_steps=2, num_candidates=128, top_k=5)
    executed = env.rollout(2, act)
    assert executed["action"].abs().max() < 0.5
    assert not executed["next", "terminated"].any()
