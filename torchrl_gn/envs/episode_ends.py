"""Ends of episodes within imagined or simulated plans, and the steps that count."""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.envs.specs import ended_by, path_reward, step_reward, unstable_reward
from torchrl_gn.envs.terminal import plan_rewards
from torchrl_gn.finite import is_traced

_OF_STEPS = ("next", "discount", "physics", "step_count")  # entries that change from step to step


class Imagined(NamedTuple):
    """Steps predicted by a model; differentiable except for ``alive``."""

    states: Tensor  # [*B, H + 1, N, C], as predicted, also after the end
    rewards: Tensor  # [*B, H, 1], 0 after the end
    alive: Tensor  # [*B, H + 1, 1] bool: True if the episode goes on before each step, and after the last

    @property
    def diverged(self) -> Tensor:
        """Mask ``[*B]``: True if a prediction before the end is not finite."""
        wrong = ~self.states.detach().isfinite().flatten(-2).all(-1)
        return wrong[..., 0] | (wrong[..., 1:] & self.alive[..., :-1, 0]).any(-1)


def alive_of(ended: Tensor) -> Tensor:
    """Return bool ``[*B, H + 1, 1]``, True while the episode goes on: before each of ``H`` steps, and after the last.

    ``ended`` ``[*B, H, 1]`` marks the steps that end the episode. The first of them counts and later steps do not, as
    in TorchRL's planners.
    """
    before = torch.cat((torch.zeros_like(ended[..., :1, :]), ended), dim=-2)
    return before.long().cumsum(-2) == 0


class CountedSteps(NamedTuple):
    """Steps of trajectories; the last real step replaces all steps after the end."""

    before: Tensor  # [*B, H, N, C]
    action: Tensor  # [*B, H, A]
    after: Tensor  # [*B, H, N, C]; the last good state where a step is not stable
    stable: Tensor  # [*B, H, 1] bool
    alive: Tensor  # [*B, H + 1, 1] bool


def counted_steps(
    env: Any, tensordict: TensorDictBase, states: Tensor, actions: Tensor, stable: Tensor
) -> CountedSteps:
    """Return the steps until the environment's ``done``, or until one is not ``stable`` ``[*B, H]``.

    ``states`` are ``[*B, H + 1, N, C]``, ``actions`` ``[*B, H, A]``; ``tensordict`` ``[*B]`` has the other entries that
    ``done`` reads.
    """
    before, after = states[..., :-1, :, :], states[..., 1:, :, :]
    untroubled = not is_traced() and states.device.type == "cpu" and bool(stable.all())
    if env.ends is None and untroubled:
        alive = stable.new_ones(*actions.shape[:-2], actions.shape[-2] + 1, 1)
        return CountedSteps(before, actions, after, stable.unsqueeze(-1), alive)
    step = torch.arange(actions.shape[-2], device=states.device).expand(stable.shape)
    good = stable.long().cumprod(-1).sum(-1, keepdim=True)  # steps before the first that is not stable
    ended = (step >= good).unsqueeze(-1)
    if env.ends is not None:
        held = after if untroubled else _pick(states, (step + 1).minimum(good))
        ended = ended | ended_steps(env, tensordict, before, actions, held)
    alive = alive_of(ended)
    if untroubled and not bool(ended[..., :-1, :].any()):
        return CountedSteps(before, actions, after, stable.unsqueeze(-1), alive)
    last = alive.squeeze(-1)[..., :-1].sum(-1, keepdim=True) - 1
    counted = step.minimum(last)
    return CountedSteps(
        _pick(states, counted),
        _pick(actions, counted),
        _pick(states, (counted + 1).minimum(good)),
        (counted < good).unsqueeze(-1),
        alive,
    )


def imagined_steps(
    env: Any, tensordict: TensorDictBase, states: Tensor, actions: Tensor, trusted: Tensor | None = None
) -> Imagined:
    """Compute rewards of predicted ``states`` ``[*B, H + 1, N, C]`` under ``actions``, as stepping ``env`` does.

    A step that is not ``trusted`` ``[*B, H]`` ends an episode, like one that is not finite.
    """
    stable = states[..., 1:, :, :].isfinite().flatten(-2).all(-1)
    stable = stable if trusted is None else stable & trusted
    steps = counted_steps(env, tensordict, states, actions, stable)
    task = cast(Any, tensordict.get("task", None))
    if steps.action is actions:  # no episode ends
        rewards = path_reward(env.reward, states, actions, _along_steps(task, tensordict.ndim, 1))
    else:
        tasks = _along_steps(task, tensordict.ndim, actions.shape[-2])
        rewards = step_reward(env.reward, steps.before, steps.action, steps.after, tasks)
    rewards = torch.where(steps.stable, rewards, unstable_reward(env, rewards))
    rewards = torch.where(steps.alive[..., :-1, :], rewards, 0.0)
    repeat, alive = env.action_repeat, steps.alive
    if repeat > 1:
        rewards = rewards.unflatten(-2, (-1, repeat)).sum(-2)
        states, alive = states[..., ::repeat, :, :], alive[..., ::repeat, :]
    rewards = plan_rewards(env.terminal, rewards, steps.after[..., -1, :, :], task, alive[..., -1, :])
    return Imagined(states, rewards, alive)


def _along_steps(value: Any, batch: int, steps: int) -> Any:
    """Repeat a value ``[*B, ...]``, constant in an episode, for each of ``steps``: ``[*B, H, ...]``."""
    if value is None:
        return None
    return value.unsqueeze(batch).expand(*value.shape[:batch], steps, *value.shape[batch:])


def ended_steps(env: Any, tensordict: TensorDictBase, before: Tensor, actions: Tensor, after: Tensor) -> Tensor:
    """Return a mask ``[*B, H, 1]`` of all steps where ``done`` holds, not only the first; see :func:`counted_steps`."""
    if env.ends is None:
        return torch.zeros(*actions.shape[:-1], 1, dtype=torch.bool, device=actions.device)
    if not isinstance(env.ends, TensorDictModuleBase):
        return ended_by(env, after)
    reads, batch, steps = env.ends.in_keys, tensordict.ndim, actions.shape[-2]
    changing = (*_OF_STEPS, *getattr(env, "carried_keys", ()))
    constant = tensordict.select(*reads, strict=False).exclude(*changing)
    entries = cast(TensorDictBase, _along_steps(constant, batch, steps)).copy()
    entries.update({"state": after, "action": actions})
    if "reward" in reads:
        tasks = _along_steps(tensordict.get("task", None), batch, steps)
        entries.set("reward", step_reward(env.reward, before, actions, after, tasks))
    if missing := [key for key in reads if entries.get(key, None) is None]:
        raise ValueError(
            f"done= of {env} reads {missing}, which a plan does not have for each step: let it read the state"
        )
    return ended_by(env, after, entries)


def _pick(values: Tensor, at: Tensor) -> Tensor:
    """Select rows ``at`` ``[*B, H]`` of ``values`` ``[*B, T, ...]``."""
    dim = at.ndim - 1
    index = at.reshape(*at.shape, *[1] * (values.ndim - at.ndim))
    return values.gather(dim, index.expand(*at.shape, *values.shape[at.ndim :]))
