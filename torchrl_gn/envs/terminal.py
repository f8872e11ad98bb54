"""The value of a plan's last state, as reward of its last step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.envs.specs import DIVERGED, on_device, require_shape
from torchrl_gn.finite import is_traced
from torchrl_gn.scenes.articulation import Articulation, require_same_nodes, require_timestep

TerminalValue = Callable[..., Tensor]  # of states, and of the task if its attribute ``reads_task`` is True


def terminal_of(terminal: TerminalValue | None, env: Any, scene: Articulation) -> TerminalValue | None:
    """Return the value on the environment's device, maybe a copy; ValueError unless it fits scene and reward."""
    if terminal is None:
        return None
    if not callable(terminal):
        raise TypeError(f"terminal= must be a function of states, got {type(terminal).__name__}")
    name = type(terminal).__name__
    if not 0 < (discount := discount_of(terminal)) <= 1:
        raise ValueError(f"the discount of terminal= must be above 0 and at most 1, got {discount} of {name}")
    if getattr(env.reward, "target_shape", None) is not None and not _reads_task(terminal):
        raise ValueError(f"a value of states does not read the target of {env.reward}: leave terminal= out")
    if not getattr(terminal, "fitted", True):
        raise ValueError(f"{name} has learned no value yet: call fit_value on it, or load one")
    terminal_scene = getattr(terminal, "scene", scene)
    require_same_nodes(scene, terminal_scene, name)
    require_timestep(scene, terminal_scene.timestep, name)
    return on_device(terminal, env, scene)


def discount_of(terminal: TerminalValue | None) -> float:
    """Return the discount per step that a value was learned with: its attribute ``discount``, or 1."""
    return float(getattr(terminal, "discount", 1.0))


def _reads_task(terminal: TerminalValue) -> bool:
    return getattr(terminal, "reads_task", False)


def terminal_value(terminal: TerminalValue, state: Tensor, task: Any) -> Tensor:
    """Return values ``[*B, 1]`` of states ``[*B, N, 13]``; ValueError for another shape, or NaN of a finite state."""
    value = terminal(state, task) if _reads_task(terminal) else terminal(state)
    value = require_shape(value, (*state.shape[:-2], 1), "the terminal value", terminal)
    # Checking on a GPU would force a synchronisation.
    if value.device.type == "cpu" and not is_traced() and bool((nan := value.isnan().squeeze(-1)).any()):
        if bool((nan & (state.abs() < DIVERGED).flatten(-2).all(-1)).any()):
            raise ValueError(f"the terminal value {terminal} returned NaN for a finite state")
    return value


def plan_rewards(
    terminal: TerminalValue | None, rewards: Tensor, last_state: Tensor, task: Any, alive: Tensor
) -> Tensor:
    r"""Discount a plan's rewards ``[*B, H, 1]`` and add the value of its last state ``[*B, N, 13]`` to the last reward.

    Their sum is :math:`\sum_{t<H} \gamma^t r_t + \gamma^H V(s_H)`. The value counts where the episode is ``alive``
    ``[*B, 1]`` after the last step. Without a terminal value, the rewards stay as they are.
    """
    if terminal is None:
        return rewards
    steps, discount = rewards.shape[-2], discount_of(terminal)
    value = discount**steps * terminal_value(terminal, last_state, task).to(rewards.dtype)
    value = torch.where(alive, value, 0.0)
    factors = discount ** torch.arange(steps, dtype=rewards.dtype, device=rewards.device)
    return rewards * factors.unsqueeze(-1) + pad(value.unsqueeze(-2), (0, 0, steps - 1, 0))


def step_entries(env: Any, tensordict: TensorDictBase, state: Tensor, entries: dict[str, Tensor]) -> dict[str, Tensor]:
    r"""Return a step's shaped ``reward`` and next ``discount``; no entries without a terminal value.

    The shaped reward is :math:`w_t r_t + w_{t+1} V(s_{t+1}) - w_t V(s_t)`, where :math:`w_t = \gamma^t` is the entry
    ``discount`` (1 if missing). In the sum over a plan all values cancel, except the values of the last and the first
    state (potential-based shaping, Ng et al. 1999); no action changes the first value. So planners that step without
    knowing the horizon maximise the sum of :func:`plan_rewards`. The next value is 0 where the episode has
    ``terminated``. ``state`` is the state before the step; ``entries`` are its outcome.
    """
    terminal, reward = env.terminal, entries["reward"]
    if terminal is None:
        return {}
    weight, task = tensordict.get("discount", None), tensordict.get("task", None)
    weight = torch.ones_like(reward) if weight is None else weight
    after = discount_of(terminal) * weight
    value, next_value = (terminal_value(terminal, s, task).to(reward.dtype) for s in (state, entries["state"]))
    next_value = torch.where(entries["terminated"], 0.0, next_value)
    return {"reward": weight * reward + (after * next_value - weight * value), "discount": after}
