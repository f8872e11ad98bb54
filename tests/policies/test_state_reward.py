"""A learned reward: inputs, fits and descriptions."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.dynamics import Canonicalizer, specialize
from torchrl_gn.envs import ModelEnv
from torchrl_gn.policies import StateReward, task_invariances
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import fit_reward, load_pretrained, save_checkpoint

from ..planners.test_gradient_planner import trained
from ..sizes import SMALL


def rewarded_data(name: str, task, count: int = 12, scale: float = 1.0) -> tuple:
    scene = load_scene(name)
    found = collect_trajectories(scene, count, steps=50, seed=0)
    state, action = found["state"], found["action"].float()
    reward = scale * make_reward(task, scene)(state[:, :-1], action, state[:, 1:]).float()
    return scene, TensorDict({"state": state, "action": action, "reward": reward}, [count])


def error_of(reward: StateReward, data: TensorDict) -> float:
    """Mean squared error in variances."""
    with torch.no_grad():
        found = reward(data["state"][:, :-1], data["action"], data["state"][:, 1:])
    return float((found - data["reward"]).square().mean() / data["reward"].var())


def test_learns_rewards() -> None:
    scene, data = rewarded_data("cartpole", "balance")
    torch.manual_seed(0)
    reward = StateReward(scene, hidden=[64, 64])
    assert error_of(reward, data) > 0.5
    last = fit_reward(reward, data, steps=600)
    assert error_of(reward, data) < 0.02 and last < 0.02
    state = data["state"][:, 1:].clone().requires_grad_()
    reward(data["state"][:, :-1], data["action"], state).sum().backward()
    assert state.grad is not None and bool((state.grad != 0).any()) and bool(state.grad.isfinite().all())


def test_reads_the_state_before_and_the_action() -> None:
    scene, data = rewarded_data("cartpole", "balance")
    drawn = torch.Generator().manual_seed(1)
    before = data["state"][:, :-1, 1, 7:8]  # the cart's velocity
    data["reward"] = before + 0.5 * data["action"] + 0 * torch.rand(before.shape, generator=drawn)
    torch.manual_seed(0)
    reward = StateReward(scene, hidden=[64, 64])
    fit_reward(reward, data, steps=600)
    assert error_of(reward, data) < 0.02


@pytest.mark.parametrize("target", [False, True])
def test_rewards_along_a_path_are_those_of_its_steps(target, calls) -> None:
    scene, data = rewarded_data("cartpole", "balance", count=4)
    torch.manual_seed(0)
    reward = StateReward(scene, hidden=[8], target=target)
    state, action = data["state"], data["action"]
    goal = torch.randn(4, 1, 3).double() if target else None
    reward.features.fit(state, None if goal is None else goal.expand(4, 51, 3))
    reward.normalizer.update(data["reward"].flatten(0, 1))
    found = reward.along(state, action, goal)
    torch.testing.assert_close(found, reward(state[:, :-1], action, state[:, 1:], goal))
    if target:
        elsewhere = reward.along(state, action, goal.flip(0))
        assert (elsewhere != found).any()
        return
    counts = calls(reward.features, "forward", lambda states, *_, **__: states.shape[1])
    env = ModelEnv(specialize(trained(scene, **SMALL)), reward)
    starts = TensorDict({"state": state[:, 0]}, [4])
    paid = env.imagine(starts, action[:, :5])[1]
    assert counts == [6]  # each state once
    now = starts
    for step in range(5):
        after = env.step(now.copy().set("action", action[:, step]))["next"]
        torch.testing.assert_close(paid[:, step], after["reward"], rtol=1e-4, atol=1e-5)
        now = after.select("state")


def test_resumes_where_rewards_have_grown() -> None:
    """A new scale changes the normaliser, not the network's predictions."""
    scene, data = rewarded_data("cartpole", "balance")
    torch.manual_seed(0)
    reward = StateReward(scene, hidden=[64, 64])
    fit_reward(reward, data, steps=600)
    with torch.no_grad():
        before = reward(data["state"][:, :-1], data["action"], data["state"][:, 1:])
    more = data.clone()
    more["reward"] = 5 * more["reward"] - 2
    fit_reward(reward, more, steps=1, lr=1e-12)
    with torch.no_grad():
        after = reward(data["state"][:, :-1], data["action"], data["state"][:, 1:])
    assert reward.normalizer.std.item() == pytest.approx(float(more["reward"].double().std(correction=0)))
    torch.testing.assert_close(after, before, rtol=1e-3, atol=1e-3)
    fit_reward(reward, more, steps=600)
    assert error_of(reward, more) < 0.02


def test_grows_beyond_the_data_as_rewards_do() -> None:
    """Its inputs are normalised by the last data, and a linear part does not saturate."""
    scene, data = rewarded_data("cartpole", "balance")
    torch.manual_seed(0)
    reward = StateReward(scene, hidden=[64, 64])
    slow, fast = data.clone(), data.clone()
    for each, factor in ((slow, 0.4), (fast, 1.0)):
        each["state"][..., 7:] *= factor
        each["reward"] = each["state"][:, 1:, 1, 7:8].clone()  # the cart's velocity
    fit_reward(reward, slow, steps=600)
    assert error_of(reward, fast) < 0.3
    fit_reward(reward, fast, steps=600)
    assert error_of(reward, fast) < 0.01 and error_of(reward, slow) < 0.3


def test_a_constant_reward_is_that_constant() -> None:
    scene, data = rewarded_data("cartpole", "balance")
    data["reward"] = torch.full_like(data["reward"], 0.25)
    reward = StateReward(scene, hidden=[8])
    fit_reward(reward, data, steps=5)
    found = reward(data["state"][:, :-1], data["action"], data["state"][:, 1:])
    torch.testing.assert_close(found, torch.full_like(found, 0.25))
    data["reward"][0] = 1.0  # the first time that something else is paid
    fit_reward(reward, data, steps=500)
    assert error_of(reward, data) < 0.5


def test_invariances_and_files(tmp_path) -> None:
    scene = load_scene("cheetah")
    torch.manual_seed(0)
    reward = StateReward(scene, hidden=[8], canonicalizer=Canonicalizer(recenter=True, yaw=False))
    data = collect_trajectories(scene, 2, steps=5, seed=0)
    paid = torch.arange(10.0).reshape(2, 5, 1)
    fit_reward(reward, TensorDict({"state": data["state"], "action": data["action"], "reward": paid}, [2]), steps=2)
    assert task_invariances(scene, reward) == Canonicalizer(recenter=True, yaw=False)
    save_checkpoint(tmp_path / "reward.safetensors", reward, scene=scene)
    again = load_pretrained(tmp_path / "reward.safetensors").reward
    state = Simulator(scene).observe(torch.as_tensor(scene.rest_physics).unsqueeze(0))
    action = torch.rand(1, scene.num_actions)
    assert torch.equal(again(state, action, state), reward(state, action, state)) and repr(again) == repr(reward)


def test_refuses_what_does_not_fit() -> None:
    scene, data = rewarded_data("cartpole", "balance", 2)
    reward = StateReward(scene, hidden=[8])
    with pytest.raises(ValueError, match="do not fit"):
        fit_reward(reward, TensorDict({**dict(data.items()), "reward": data["reward"][:, :-1]}, [2]))
    data["reward"][1, 3] = torch.nan
    with pytest.raises(ValueError, match="'reward' of the data has nan at index"):
        fit_reward(reward, data)
    _, data = rewarded_data("cartpole", "balance", 2)
    for key, index, value, message in (
        ("state", (1, 3, 1, 0), torch.nan, "Trajectory 1 contains states that are not finite"),
        ("state", (1, 3), 0.0, "Trajectory 1 contains states with a zero quaternion"),  # padding
        ("action", (0, 2), torch.inf, "Trajectory 0 contains actions that are not finite"),
    ):
        broken = data.clone()
        broken[key][index] = value
        with pytest.raises(ValueError, match=message):
            fit_reward(reward, broken)
    reaching = StateReward(scene, hidden=[8], target=True)
    for target, message in (
        (torch.zeros(2, 50, 3), r"target must be \[K, 3\], one of each row, got \[2, 50, 3\]"),
        (torch.full((2, 3), torch.nan), "'target' of the data has nan"),
    ):
        with pytest.raises(ValueError, match=message):
            fit_reward(reaching, data.clone().set("target", target))
    with pytest.raises(ValueError, match="hidden"):
        StateReward(scene, hidden=[])


def test_refuses_rows_in_which_an_episode_ends() -> None:
    scene, data = rewarded_data("cartpole", "balance", 2)
    reward = StateReward(scene, hidden=[8])
    done = torch.zeros(*data["reward"].shape, dtype=torch.bool)
    done[:, -1] = True
    fit_reward(reward, data.clone().set(("next", "done"), done.clone()), steps=1)
    done[0, 2] = True
    with pytest.raises(ValueError, match="ends .* inside the trajectories"):
        fit_reward(reward, data.clone().set(("next", "done"), done))
