"""Specs and rewards shared by the two environments of a scene."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.scenes.scene import Scene

RewardFunction = Callable[..., Tensor]


def set_specs(env: EnvBase, scene: Scene, *, physics: bool, variants: int = 1) -> None:
    """Set an environment's specs for a scene.

    Observations are float64, as simulated. Actions and rewards are float32, the dtype of TorchRL's policies, value
    networks and planners; environments also accept float64 actions.

    Args:
        env: environment to set up; its device is set already.
        scene: the scene.
        physics: whether the full MuJoCo state is an entry.
        variants: number of variants of the scene; if several, ``variant`` is an entry.
    """
    device = env.device

    def unbounded(*shape: int) -> Unbounded:
        return Unbounded(shape=torch.Size(shape), dtype=torch.float64, device=device)

    observation: dict[str, Unbounded | Bounded] = {"state": unbounded(scene.num_nodes, scene.state_size)}
    if physics:
        observation["physics"] = unbounded(scene.physics_size)
    if variants > 1:
        observation["variant"] = Bounded(0, variants - 1, shape=torch.Size((1,)), dtype=torch.int64, device=device)
    env.observation_spec = Composite(observation, device=device)
    # A step reads these besides the action.
    carried = {"physics" if physics else "state", "variant"} & observation.keys()
    env.state_spec = Composite({key: observation[key].clone() for key in carried}, device=device)
    actions: dict[str, Any] = {"shape": torch.Size((scene.num_actions,)), "dtype": torch.float32, "device": device}
    low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (scene.action_low, scene.action_high))
    # The bounds of a robot known by its logs may be unknown.
    bounded = bool(low.isfinite().all() & high.isfinite().all())
    env.action_spec = Bounded(low=low, high=high, **actions) if bounded else Unbounded(**actions)
    env.reward_spec = Unbounded(shape=torch.Size((1,)), dtype=torch.float32, device=device)


def read(tensordict: TensorDictBase, key: str, shape: tuple[int, ...], env: EnvBase) -> Tensor:
    """Read and check an entry of a step's input.

    Args:
        tensordict: the step's input, batch ``[*B]``.
        key: name of the entry.
        shape: its shape without the batch.
        env: the environment, named in errors.

    Returns:
        ``[*B, *shape]``.

    Raises:
        KeyError: the entry is missing.
        ValueError: the entry has another shape.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(f"{env} needs an entry {key!r} in its input; reset() writes the state, a policy the action")
    if value.shape != (*tensordict.shape, *shape):
        expected = [*tensordict.shape, *shape]
        raise ValueError(f"{env}: {key!r} must be {expected}, got {list(value.shape)}")
    return value


def reward_of(reward: RewardFunction | None, env: EnvBase, scene: Scene) -> RewardFunction | None:
    """Reward function on the environment's device; a copy if it is on another device.

    Raises:
        ValueError: the reward reads the bodies of another scene.
    """
    if not isinstance(reward, nn.Module):
        return reward
    for each in reward.modules():
        if isinstance(each, Bodies):
            each.require_same(scene)
    if all(tensor.device == env.device for tensor in itertools.chain(reward.parameters(), reward.buffers())):
        return reward
    return copy.deepcopy(reward).to(env.device)


def finite_reward(value: float) -> float:
    """Check the reward of an unstable step.

    Raises:
        ValueError: ``value`` is not finite, which would spoil returns and averages.
    """
    if not math.isfinite(value):
        raise ValueError(f"unstable_reward must be finite, got {value}; give a large negative number")
    return float(value)


def step_reward(
    reward: RewardFunction | None, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None
) -> Tensor:
    """Reward ``[*B, 1]`` of a step in float32, zero without a reward function.

    Raises:
        ValueError: the reward function returned another shape.
    """
    shape = (*next_state.shape[:-2], 1)
    if reward is None:
        return next_state.new_zeros(shape, dtype=torch.float32)
    value = reward(state, action, next_state, task)
    if value.shape != shape:
        raise ValueError(f"the reward must be {list(shape)}, {reward} returned {list(value.shape)}")
    return value.to(torch.float32)
