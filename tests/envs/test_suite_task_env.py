"""Episodes of the suite by states: dm_control's steps and rewards."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_gn.data import Simulator
from torchrl_gn.envs import SuiteTaskEnv
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene, load_suite_task
from torchrl_gn.scenes.suite_tasks import full_physics

pytest.importorskip("dm_control.suite")


def test_specs() -> None:
    check_env_specs(SuiteTaskEnv(load_scene("suite:cartpole/swingup"), num_envs=2))


def test_without_a_seed_environments_have_their_own_episodes() -> None:
    scene = load_scene("suite:cartpole/swingup")
    torch.manual_seed(0)
    firsts = [SuiteTaskEnv(scene).reset()["state"] for _ in range(2)]
    torch.manual_seed(0)
    assert not torch.equal(*firsts) and torch.equal(firsts[0], SuiteTaskEnv(scene).reset()["state"])


def test_plays_and_pays_as_dm_control() -> None:
    scene = load_scene("suite:hopper/hop", timestep=0.06)
    env, theirs = SuiteTaskEnv(scene, num_envs=2, seed=4), load_suite_task("hopper", "hop", 0)
    assert env.action_repeat == 3
    theirs.task.random.seed(int(np.random.SeedSequence(4).generate_state(2)[1]))
    theirs.reset()
    now = env.reset()
    actions = torch.rand(2, 10, scene.num_actions) * 2 - 1
    for step in range(10):
        torch.testing.assert_close(
            now["state"][1], Simulator(scene).observe(torch.from_numpy(full_physics(theirs))), rtol=0, atol=1e-12
        )
        now = env.step(now.set("action", actions[:, step]))["next"]
        paid = sum(theirs.step(actions[1, step].double().numpy()).reward for _ in range(3))
        assert now["reward"][1].item() == pytest.approx(paid, abs=1e-6)
        assert not now["done"].any()


def test_shows_the_frames_of_a_step() -> None:
    coarse, fine = (load_scene("suite:walker/run", timestep=step) for step in (0.05, 0.025))
    env, each = SuiteTaskEnv(coarse, num_envs=2, frames=True, seed=3), SuiteTaskEnv(fine, num_envs=2, seed=3)
    check_env_specs(env)
    for of in (env, each):
        of.set_seed(3)
    now, other = env.reset(), each.reset()
    assert (
        torch.equal(now["frames"], now["state"].unsqueeze(1).expand(-1, 2, -1, -1)) and not now["frame_rewards"].any()
    )
    for _ in range(3):
        action = torch.rand(2, 6) * 2 - 1
        now = env.step(now.set("action", action))["next"]
        for frame in range(2):
            other = each.step(other.set("action", action))["next"]
            assert torch.equal(now["frames"][:, frame], other["state"])
            assert torch.equal(now["frame_rewards"][:, frame], other["reward"])
        assert torch.equal(now["state"], other["state"])
        torch.testing.assert_close(now["reward"], now["frame_rewards"].sum(1))


def test_episodes_end_at_the_time_limit_and_begin_anew() -> None:
    env = SuiteTaskEnv(load_scene("suite:pendulum/swingup", timestep=5.0), num_envs=2)
    assert env.steps == 4  # an episode takes 20 s
    played = env.rollout(6, break_when_any_done=False)
    assert played["next", "truncated"].squeeze(-1)[0].tolist() == [False, False, False, True, False, False]
    assert torch.equal(played["next", "truncated"], played["next", "done"]) and not played["next", "terminated"].any()
    assert not torch.equal(played["state"][:, 0], played["state"][:, 4])
    env.rollout(4)
    with pytest.raises(RuntimeError, match="episode 0 has ended; reset it"):
        env.step(env.fake_tensordict().set("action", torch.zeros(2, 1)))


def test_some_episodes_begin_anew_and_others_stay() -> None:
    env = SuiteTaskEnv(load_scene("suite:cartpole/swingup"), num_envs=3, seed=0)
    now = env.rollout(5)[:, -1]["next"]
    again = env.reset(now.select("state").set("_reset", torch.tensor([[False], [True], [False]])))
    changed = (again["state"] != now["state"]).flatten(1).any(1)
    assert changed.tolist() == [False, True, False]


@pytest.mark.parametrize("task", ["reacher/easy", "finger/turn_hard", "fish/swim", "swimmer/swimmer6"])
def test_shows_the_target_of_each_episode(task: str) -> None:
    env = SuiteTaskEnv(scene := load_scene(f"suite:{task}"), num_envs=2, seed=0)
    check_env_specs(env)
    played = env.rollout(5)
    target = played["target"]
    assert target.shape == (2, 5, 3) and not torch.equal(target[0, 0], target[1, 0])
    assert torch.equal(target, target[:, :1].expand_as(target)) and torch.equal(played["next", "target"], target)
    known = make_reward(None, scene)(played["state"], played["action"], played["next", "state"], target)
    torch.testing.assert_close(known.float(), played["next", "reward"])
    assert not torch.equal(env.reset()["target"], target[:, 0])


def test_seeds() -> None:
    env = SuiteTaskEnv(load_scene("suite:cheetah/run"), num_envs=2, seed=1)
    first = env.reset()["state"]
    assert not torch.equal(first[0], first[1])
    env.set_seed(1)
    assert torch.equal(env.reset()["state"], first)


def test_an_unstable_episode_is_terminated() -> None:
    env = SuiteTaskEnv(load_scene("suite:pendulum/swingup"), num_envs=2)
    now = env.reset()
    env.episodes[0].physics.data.qvel[:] = 1e300
    after = env.step(now.set("action", torch.zeros(2, 1)))["next"]
    assert after["terminated"].flatten().tolist() == [True, False] and not after["truncated"].any()
    assert torch.equal(after["state"][0], now["state"][0]) and after["reward"][0] == 0


def test_torchrl_stops_each_episode_at_its_end() -> None:
    env = SuiteTaskEnv(load_scene("suite:cartpole/swingup"), num_envs=2, seed=3)
    for steps, episode in zip((3, 5), env.episodes, strict=True):
        episode._step_limit = steps
    played = env.rollout(9, break_when_any_done=False, break_when_all_done=True)
    done = played["next", "done"].squeeze(-1)
    assert done.tolist() == [[False, False, True, True, True], [False] * 4 + [True]]
    assert torch.equal(done, played["next", "truncated"].squeeze(-1))
    for key in ("state", "reward"):  # TorchRL repeats the last step of an episode that is over
        assert torch.equal(played["next", key][0, 4], played["next", key][0, 2])
    assert not env.reset()["done"].any()


def test_copies_go_on_by_themselves() -> None:
    env = SuiteTaskEnv(load_scene("suite:reacher/easy"), num_envs=2, seed=3)
    now = env.step(env.reset().set("action", torch.rand(2, 2)))["next"]
    copied, action = copy.deepcopy(env), torch.rand(2, 2)
    first, second = (each.step(now.clone().set("action", action))["next"] for each in (env, copied))
    assert torch.equal(first["state"], second["state"]) and torch.equal(first["reward"], second["reward"])
    assert torch.equal(env.reset()["target"], copied.reset()["target"])


def test_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="'pendulum' is not a task of the suite"):
        SuiteTaskEnv(load_scene("pendulum"))
    with pytest.raises(ValueError, match="no multiple of the suite's, 0.02 s"):
        SuiteTaskEnv(load_scene("suite:finger/spin", timestep=0.03))
    with pytest.raises(ValueError, match="num_envs=0"):
        SuiteTaskEnv(load_scene("suite:pendulum/swingup"), num_envs=0)
    env = SuiteTaskEnv(load_scene("suite:pendulum/swingup"))
    with pytest.raises(ValueError, match="'action' has nan"):
        env.step(env.reset().set("action", torch.full((1, 1), torch.nan)))
    assert isinstance(env.reset(), TensorDict) and "pendulum" in repr(env)
    env = SuiteTaskEnv(load_scene("suite:cheetah/run"), num_envs=2)
    with pytest.raises(ValueError, match=r"'action' must be \[2, 6\], got \[2, 1\]"):  # dm_control would broadcast it
        env.step(env.reset().set("action", torch.zeros(2, 1)))
    with pytest.raises(KeyError, match="needs an entry 'action'"):
        env.step(env.reset())
