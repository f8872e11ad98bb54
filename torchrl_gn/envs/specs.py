"""Specs and rewards shared by the two environments of a scene."""

from __future__ import annotations

import copy
import inspect
import itertools
import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_gn.finite import is_traced
from torchrl_gn.rewards.bodies import Bodies
from torchrl_gn.rewards.reward import Reward, terms_of
from torchrl_gn.scenes.articulation import Articulation, require_bodies

RewardFunction = Callable[..., Tensor]
DoneFunction = Callable[..., Any]
_UNSTABLE = -1e6  # below all others, so that no planner takes an unstable step
DIVERGED = 1e10  # a state with larger numbers has diverged
_STAYING = 100  # an unstable step costs a learner as much as this many steps in the last good state


def set_specs(env: Any, scene: Articulation, *, physics: bool, variants: int = 1) -> None:
    """Set an environment's specs for a scene: float64 observations, float32 actions and rewards."""
    device = env.device

    def unbounded(*shape: int) -> Unbounded:
        return Unbounded(shape=torch.Size(shape), dtype=torch.float64, device=device)

    observation: dict[str, Unbounded | Bounded] = {"state": unbounded(scene.num_nodes, scene.state_size)}
    if physics:
        observation["physics"] = unbounded(require_bodies(scene, "A simulator").physics_size)
    if variants > 1:
        observation["variant"] = Bounded(0, variants - 1, shape=torch.Size((1,)), dtype=torch.int64, device=device)
    if env.terminal is not None:
        observation["discount"] = Unbounded(shape=torch.Size((1,)), dtype=torch.float32, device=device)
    env.observation_spec = Composite(observation, device=device)
    inputs = {
        "physics" if physics else "state",
        "variant",
        "discount",
    } & observation.keys()  # read by a step besides the action
    env.state_spec = Composite({key: observation[key].clone() for key in inputs}, device=device)
    actions: dict[str, Any] = {"shape": torch.Size((scene.num_actions,)), "dtype": torch.float32, "device": device}
    low, high = (torch.as_tensor(bound, dtype=torch.float32) for bound in (scene.action_low, scene.action_high))
    # The bounds of a robot known by its logs may be unknown.
    bounded = bool(low.isfinite().all() & high.isfinite().all())
    env.action_spec = Bounded(low=low, high=high, **actions) if bounded else Unbounded(**actions)
    env.reward_spec = Unbounded(shape=torch.Size((1,)), dtype=torch.float32, device=device)


def spec_of(entries: TensorDictBase, device: torch.device | None) -> Composite:
    """Return an unbounded spec with the shapes and dtypes of ``entries``."""
    specs = {str(key): Unbounded(shape=e.shape, dtype=e.dtype, device=device) for key, e in entries.items()}
    return Composite(specs, device=device)


def read(tensordict: TensorDictBase, key: str, shape: tuple[int, ...], env: EnvBase) -> Tensor:
    """Return an entry ``[*B, *shape]`` of an input ``[*B]``; KeyError if missing, ValueError for another shape."""
    if (value := tensordict.get(key, None)) is None:
        raise KeyError(f"{env} needs an entry {key!r} in its input; reset() writes the state, a policy the action")
    if value.shape != (expected := (*tensordict.shape, *shape)):
        raise ValueError(f"{env}: {key!r} must be {list(expected)}, got {list(value.shape)}")
    return value


def require_reward(reward: RewardFunction | None) -> None:
    """Raise TypeError unless a reward is None, or a function of state, action, next state and task."""
    if reward is None:
        return
    try:
        inspect.signature(getattr(reward, "forward", reward)).bind(None, None, None, None)
    except TypeError:
        named = isinstance(reward, (str, list))
        name = repr(reward) if named else getattr(reward, "__qualname__", type(reward).__name__)
        remedy = f"; use make_reward({name}, scene)" if named else ""
        raise TypeError(
            f"reward= must be a function of (state, action, next_state, task), {name} is not{remedy}"
        ) from None
    except ValueError:  # a built-in function without a signature
        pass


def reward_of(reward: RewardFunction | None, env: EnvBase, scene: Articulation) -> RewardFunction | None:
    """Return the reward on the environment's device, as a copy if it must move.

    TypeError of :func:`require_reward`; ValueError if the reward belongs to another scene.
    """
    require_reward(reward)
    return on_device(reward, env, scene)


def on_device(reward: RewardFunction | None, env: EnvBase, scene: Articulation) -> RewardFunction | None:
    """Return a reward or value on the environment's device, maybe a copy; ValueError if its scene is another one."""
    if not isinstance(reward, nn.Module):
        return reward
    for each in reward.modules():
        if isinstance(each, Bodies):
            each.require_same(scene)
    if all(tensor.device == env.device for tensor in itertools.chain(reward.parameters(), reward.buffers())):
        return reward
    return copy.deepcopy(reward).to(env.device)


def finite_reward(value: float | None) -> float:
    """Return the reward of an unstable step, by default that for planners; ValueError if it is not finite."""
    if value is None:
        return _UNSTABLE
    if not math.isfinite(value):
        raise ValueError(f"unstable_reward must be finite, got {value}; give a large negative number")
    return float(value)


def step_reward(
    reward: RewardFunction | None, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None
) -> Tensor:
    """Compute a step's reward ``[*B, 1]`` in float32, zero without a function.

    ValueError for another shape, or NaN; TypeError if it is not a tensor.
    """
    if reward is None:
        return next_state.new_zeros(*next_state.shape[:-2], 1, dtype=torch.float32)
    return _checked_reward(reward(state, action, next_state, task), reward, state, action, next_state, task)


def path_reward(reward: RewardFunction | None, states: Tensor, actions: Tensor, task: Tensor | None) -> Tensor:
    """Compute the rewards ``[*B, H, 1]`` along states ``[*B, H + 1, N, C]``, checked as by :func:`step_reward`."""
    steps = states[..., :-1, :, :], actions, states[..., 1:, :, :]
    if not isinstance(reward, Reward):
        return step_reward(reward, *steps, task)
    return _checked_reward(reward.along(states, actions, task), reward, *steps, task)


def _checked_reward(
    value: Any, reward: RewardFunction, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None
) -> Tensor:
    """Return the value of a reward in float32; ValueError for another shape or NaN; TypeError unless it is a tensor."""
    value = require_shape(value, (*next_state.shape[:-2], 1), "the reward", reward)
    # Checking on a GPU would force a synchronisation.
    if value.device.type == "cpu" and not is_traced() and bool(value.isnan().any()):
        _refuse_nan(reward, value, state, action, next_state, task)
    return value.to(torch.float32)


def require_shape(value: Any, shape: tuple[int, ...], what: str, source: Any) -> Tensor:
    """Return the value of a user's function ``source``; TypeError unless it is a tensor, ValueError of its shape."""
    source = source if isinstance(source, nn.Module) else getattr(source, "__qualname__", repr(source))
    if not isinstance(value, Tensor):
        received = f"{value!r:.40}" if isinstance(value, (bool, int, float)) else type(value).__name__
        raise TypeError(f"{what} must be a tensor {list(shape)}, {source} returned {received}")
    if value.shape != shape:
        raise ValueError(f"{what} must be {list(shape)}, {source} returned {list(value.shape)}")
    return value


def _refuse_nan(reward: Any, value: Tensor, state: Tensor, action: Tensor, next_state: Tensor, task: Any) -> None:
    """Raise ValueError if the reward is NaN at states that have not diverged; name the term at fault."""
    bounded = [(each.abs() < DIVERGED).flatten(-2).all(-1) for each in (state, next_state, action.unsqueeze(-1))]
    if not bool((value.squeeze(-1).isnan() & torch.stack(bounded).all(0)).any()):
        return
    terms = [term for _, term in terms_of(reward)] if isinstance(reward, Reward) else [reward]
    guilty = next((term for term in terms if bool(term(state, action, next_state, task).isnan().any())), reward)
    name = repr(guilty) if isinstance(guilty, nn.Module) else getattr(guilty, "__qualname__", repr(guilty))
    raise ValueError(f"the reward {name} returned NaN for a finite state and action")


def unstable_reward(env: Any, staying: Tensor) -> Tensor | float:
    """Return the reward of an unstable step: the environment's, else 100 times the reward ``staying``, at most 0."""
    return (_STAYING * staying).clamp(max=0) if env.unstable_reward is None else env.unstable_reward


def outcome(
    env: Any,
    tensordict: TensorDictBase,
    state: Tensor,
    action: Tensor,
    next_state: Tensor,
    stable: Tensor,
    **more: Any,
) -> dict[str, Any]:
    """Return a step's entries; unstable steps (``stable`` ``[*B, 1]``) keep the state and get the unstable reward.

    ``more`` are further entries after the step, which a ``done`` module may read, too.
    """
    next_state = torch.where(stable.unsqueeze(-1), next_state, state)
    reward = step_reward(env.reward, state, action, next_state, tensordict.get("task", None))
    entries = {"state": next_state, "reward": torch.where(stable, reward, unstable_reward(env, reward)), **more}
    terminated = ~stable
    if env.ends is not None:
        reads = isinstance(env.ends, TensorDictModuleBase)
        terminated = terminated | ended_by(
            env, next_state, tensordict.exclude("next", "physics").update(entries) if reads else None
        )
    return {**entries, "done": terminated, "terminated": terminated.clone()}


def ended_by(env: Any, next_state: Tensor, entries: TensorDictBase | None = None) -> Tensor:
    """Return bool ``[*B, 1]``, True where ``done`` ends the episode after a step; ValueError for another result.

    A ``done`` module reads ``entries`` ``[*B]``: the step's input, updated by its output.
    """
    if isinstance(env.ends, TensorDictModuleBase):
        assert entries is not None
        ended = env.ends(entries).get("terminated", None)
    else:
        ended = env.ends(next_state)
    return checked_end(ended, next_state.shape[:-2])


def checked_end(ended: Any, batch: tuple[int, ...]) -> Tensor:
    """Return a ``done`` result as bool ``[*B, 1]``; ValueError unless it is bool ``[*B]`` or ``[*B, 1]``."""
    shape = (*batch, 1)
    if not isinstance(ended, Tensor) or ended.dtype != torch.bool or ended.shape not in (shape, tuple(batch)):
        received = f"{ended.dtype} {list(ended.shape)}" if isinstance(ended, Tensor) else repr(ended)
        raise ValueError(f"done= must give 'terminated', bool {list(batch)} or {list(shape)}, got {received}")
    return ended.reshape(shape)
