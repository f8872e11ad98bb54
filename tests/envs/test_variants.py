"""An environment of several variants of a scene: every sample is simulated as its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import CEMPlanner

from torchrl_gn.envs import SceneEnv, batched
from torchrl_gn.planners import ILQGPlanner
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene
from torchrl_gn.scenes.variants import make_variants

LENGTHS = (0.3, 0.6, 1.0)


@pytest.fixture(scope="module")
def scenes():
    standard = load_scene("pendulum")
    return make_variants("pendulum", np.array([[length, 1.0] for length in LENGTHS]), timestep=standard.timestep)


@pytest.fixture
def env(scenes):
    return SceneEnv(scenes, make_reward("balance", scenes[0]), seed=0)


def test_specs_hold(env):
    check_env_specs(env, tensordict=env.reset(TensorDict(batch_size=[4])))


def test_a_batch_takes_them_in_turn_or_as_it_is_told(env):
    assert env.reset(TensorDict(batch_size=[2, 2]))["variant"].flatten().tolist() == [0, 1, 2, 0]
    told = TensorDict({"variant": torch.tensor([[2], [2]])}, batch_size=[2])
    assert env.reset(told, set_state=True)["variant"].flatten().tolist() == [2, 2]


def test_every_sample_moves_as_its_own_variant_does(env, scenes):
    start = env.reset(TensorDict(batch_size=[3]))
    start["physics"] = start["physics"][:1].expand(3, -1).clone()  # all from one state
    start = env.reset(start, set_state=True)
    actions = torch.zeros(3, 5, 1)
    actions[..., 0] = torch.linspace(-1, 1, 5)
    now, moved = start, []
    for t in range(5):
        stepped = env.step(now.set("action", actions[:, t]))["next"]
        moved.append(stepped["state"])
        now = stepped.select("state", "physics", "variant")
    for row, scene in enumerate(scenes):
        alone = SceneEnv(scene).simulator.rollout(start["physics"][row], actions[row])["state"]
        assert torch.equal(torch.stack(moved, 1)[row], alone[1:])
    assert not torch.equal(moved[-1][0], moved[-1][1])


def test_episodes_that_begin_anew_keep_their_variant(env):
    executed = batched(env, 3).append_transform(StepCounter(2)).rollout(5, break_when_any_done=False)
    assert (executed["variant"].squeeze(-1) == torch.arange(3)[:, None]).all()


def test_single_episodes_are_of_all_variants(scenes):
    """Collectors and workers of one episode each played the first variant alone."""
    env = SceneEnv(scenes, seed=0)
    one = [int(env.reset()["variant"]) for _ in range(30)]
    assert set(one) == {0, 1, 2}
    env.set_seed(0)
    again = SceneEnv(scenes, seed=0)
    assert [int(env.reset()["variant"]) for _ in range(30)] == [int(again.reset()["variant"]) for _ in range(30)] == one
    two = [tuple(env.reset(TensorDict(batch_size=[2]))["variant"].flatten().tolist()) for _ in range(30)]
    assert all(first != second for first, second in two) and len(set(two)) == 6
    limited = TransformedEnv(SceneEnv(scenes, seed=0), StepCounter(3))
    workers = SerialEnv(
        2, [lambda seed=seed: TransformedEnv(SceneEnv(scenes, seed=seed), StepCounter(3)) for seed in (0, 1)]
    )
    for played in (limited.rollout(60, break_when_any_done=False), workers.rollout(60, break_when_any_done=False)):
        variant = played["variant"].reshape(-1, 20, 3)
        assert (variant == variant[..., :1]).all()  # constant in an episode
        assert all(set(row.flatten().tolist()) == {0, 1, 2} for row in variant)
        simulated = env.simulator.rollout(
            played["physics"].reshape(-1, env.scene.physics_size),
            played["action"].reshape(-1, 1, 1).double(),
            played["variant"].reshape(-1),
        )
        assert torch.equal(simulated["state"][:, 1], played["next", "state"].flatten(0, -3))


def test_planners_plan_with_the_variant_of_every_sample(env, scenes):
    start = env.reset(TensorDict(batch_size=[3]))
    together = ILQGPlanner(env, 4, 1, warm_up=2, seed=0)
    plan = together.plan(start.clone())
    for row, scene in enumerate(scenes):
        own = SceneEnv(scene, env.reward)
        planner = ILQGPlanner(own, 4, 1, warm_up=2, seed=0)
        resumed = start[row : row + 1].exclude("variant")
        resumed["plan"] = TensorDict({"actions": plan[row : row + 1], "planned": torch.ones(1, 1).bool()}, [1])
        again = start[row : row + 1].clone().set("plan", resumed["plan"])
        assert torch.equal(planner.plan(resumed), together.plan(again))
    executed = env.rollout(2, CEMPlanner(env, 3, 1, 4, 2), tensordict=start, auto_reset=False)
    assert executed["action"].shape == (3, 2, 1)


def test_bad_variants_are_named(env):
    start = env.reset(TensorDict(batch_size=[2])).set("action", torch.zeros(2, 1))
    with pytest.raises(ValueError, match=r"'variant' must be int64 in \[0, 3\)"):
        env.step(start.clone().set("variant", torch.tensor([[0], [3]])))
    with pytest.raises(KeyError, match="'variant'"):
        env.step(start.exclude("variant"))
    with pytest.raises(ValueError, match="at least one scene"):
        SceneEnv([])
    with pytest.raises(ValueError, match="equal topology"):
        _ = SceneEnv([load_scene("pendulum"), load_scene("cartpole")]).simulator
