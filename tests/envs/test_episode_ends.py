"""Imagined steps until the end against steps taken one by one."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import step_mdp

from torchrl_gn.envs import ModelEnv
from torchrl_gn.envs.episode_ends import alive_of
from torchrl_gn.scenes import Scene

LIMIT, HORIZON = 1.0, 6


class Slider(TensorDictModuleBase):
    """The body goes by the action along x; beyond a place no prediction is finite."""

    def __init__(self, scene: Scene, edge: float = torch.inf):
        super().__init__()
        self.in_keys, self.out_keys = ["state", "action"], [("next", "state")]
        self.scene, self.edge = scene, edge
        self.gain = nn.Parameter(torch.ones(()))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, move = tensordict["state"], self.gain * tensordict["action"].to(tensordict["state"].dtype)
        pole = torch.cat((state[..., 1, :1] + move, state[..., 1, 1:]), -1)
        pole = torch.where((pole[..., :1].abs() > self.edge), torch.nan, pole)
        return tensordict.set(("next", "state"), torch.stack((state[..., 0, :], pole), -2))


def beyond(state: Tensor) -> Tensor:
    return state[..., 1, 0].abs() > LIMIT


def cost(state: Tensor, action: Tensor, next_state: Tensor, task=None) -> Tensor:
    task = 1.0 if task is None else task
    return -task * (next_state[..., 1, :1].square() + 0.1 * action**2) - 0.3 * state[..., 1, :1].abs()


def value(state: Tensor) -> Tensor:
    return 5 + state[..., 1, :1]


value.discount = 0.9  # pyright: ignore[reportFunctionMemberAccess]
KINDS = {
    "function": lambda: beyond,
    "module": lambda: TensorDictModule(lambda state: beyond(state).unsqueeze(-1), ["state"], ["terminated"]),
    "module of reward": lambda: TensorDictModule(lambda reward: reward < -1, ["reward"], ["terminated"]),
    "module of action and task": lambda: TensorDictModule(
        lambda action, task: action.abs() > 0.45 * task, ["action", "task"], ["terminated"]
    ),
}


def start_of(env: ModelEnv, count: int) -> TensorDict:
    start = env.reset(TensorDict(batch_size=[count]))
    start["state"] = torch.zeros_like(start["state"])
    return start.set("task", torch.ones(count, 1))


def by_steps(env: ModelEnv, start: TensorDict, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Rewards ``[B, H, 1]`` until done, and where the episode goes on ``[B, H + 1, 1]``."""
    now, rewards, alive = start.clone(), [], [torch.ones(*start.shape, 1, dtype=torch.bool)]
    for action in actions.unbind(1):
        now = env.step(now.set("action", action))
        rewards.append(torch.where(alive[-1], now["next", "reward"], 0.0))
        alive.append(alive[-1] & ~now["next", "done"])
        now = step_mdp(now)
    return torch.stack(rewards, 1), torch.stack(alive, 1)


@pytest.fixture
def actions() -> Tensor:
    return torch.rand(32, HORIZON, 1, generator=torch.Generator().manual_seed(0)) - 0.4


@pytest.mark.parametrize("edge", [torch.inf, 0.6, 1.3])
@pytest.mark.parametrize("kind", KINDS)
def test_it_is_stepping_until_the_end(pendulum, actions, kind, edge):
    env = ModelEnv(Slider(pendulum, edge), cost, done=KINDS[kind](), unstable_reward=-7.0, seed=0)
    start = start_of(env, len(actions))
    found, (rewards, alive) = env.imagine_steps(start, actions), by_steps(env, start, actions)
    assert torch.equal(found.alive, alive)
    assert not alive[:, -1].all() and alive[:, 2].any()
    torch.testing.assert_close(found.rewards, rewards)
    torch.testing.assert_close(env.imagine(start, actions)[1], rewards)
    assert (found.rewards == -7).any() == (edge < torch.inf)


def test_a_learner_s_cost_of_divergence_is_that_of_stepping(pendulum, actions):
    env = ModelEnv(Slider(pendulum, 0.6), cost, seed=0)
    env.unstable_reward = None  # pyright: ignore[reportAttributeAccessIssue]
    start = start_of(env, len(actions))
    torch.testing.assert_close(env.imagine(start, actions)[1], by_steps(env, start, actions)[0])


def test_no_value_beyond_the_end(pendulum, actions):
    env = ModelEnv(Slider(pendulum), cost, done=beyond, terminal=value, seed=0)
    start = start_of(env, len(actions))
    rewards, alive = by_steps(ModelEnv(Slider(pendulum), cost, done=beyond), start, actions)
    factors = 0.9 ** torch.arange(HORIZON).view(-1, 1)
    last = start["state"][:, 1, :1] + actions.sum(1)
    expected = (factors * rewards).sum(1) + torch.where(alive[:, -1], 0.9**HORIZON * value_at(last), 0.0)
    torch.testing.assert_close(env.imagine(start, actions)[1].sum(1), expected.float(), rtol=1e-5, atol=1e-5)
    # As the steps that TorchRL's planners sum, but for the value of the start.
    torch.testing.assert_close(by_steps(env, start, actions)[0].sum(1) + 5, expected.float(), rtol=1e-5, atol=1e-5)


def value_at(place: Tensor) -> Tensor:
    return 5 + place


def test_gradients_are_those_of_stepping(pendulum, actions):
    env = ModelEnv(Slider(pendulum), cost, done=beyond, seed=0)
    start, actions = start_of(env, len(actions)), actions.requires_grad_()
    found, expected = (
        torch.autograd.grad(rewards.sum(), [actions, env.world_model.gain])
        for rewards in (env.imagine(start, actions)[1], by_steps(env, start, actions)[0])
    )
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)
    assert (found[0][:, 0] != 0).all() and (found[0][:, -1] == 0).any()


def test_what_comes_after_the_end_is_not_asked_for(pendulum, actions):
    """The root of a number that is negative after the end; its gradient, too."""

    def root(state, action, next_state, task=None):
        return (1.5 - state[..., 1, :1].abs()).sqrt()

    env = ModelEnv(Slider(pendulum), root, done=beyond, seed=0)
    actions = (0.7 * torch.ones_like(actions)).requires_grad_()
    rewards = env.imagine(start_of(env, len(actions)), actions)[1]
    (gradient,) = torch.autograd.grad(rewards.sum(), actions)
    assert rewards.isfinite().all() and gradient.isfinite().all()
    assert (rewards[:, 2:] == 0).all() and (rewards[:, :2] > 0).all()


@pytest.mark.parametrize("key", ["discount", "physics", "step_count"])
def test_what_a_done_module_cannot_read_ahead_is_named(pendulum, actions, key):
    """An entry that changes from step to step is not taken for constant."""
    ends = TensorDictModule(lambda x: x > 0, [key], ["terminated"])
    env = ModelEnv(Slider(pendulum), cost, done=ends, terminal=value, seed=0)
    start = start_of(env, len(actions)).set(key, torch.zeros(len(actions), 1))
    with pytest.raises(ValueError, match=rf"done= of ModelEnv\('pendulum'\) reads \['{key}'\]"):
        env.imagine(start, actions)


def test_alive_masks_as_torchrls_planners_do():
    """The planners of torchrl 0.14.0 counted rewards after the end."""
    masking = pytest.importorskip("torchrl.modules.planners.common")
    if not hasattr(masking, "_mask_post_done_reward"):
        pytest.skip("torchrl before its planners masked")
    generator = torch.Generator().manual_seed(0)
    done = torch.rand(20, 7, 1, generator=generator) < 0.2
    reward = torch.rand(20, 7, 1, generator=generator)
    steps = TensorDict({"next": {"reward": reward, "done": done}}, [20, 7])
    alive = alive_of(done)
    assert torch.equal(torch.where(alive[:, :-1], reward, 0.0), masking._mask_post_done_reward(steps, time_dim=1))
    assert torch.equal(alive[:, -1], ~done.any(1))
