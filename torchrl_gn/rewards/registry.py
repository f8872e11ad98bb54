"""The paper's tasks by name."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

from torchrl_gn.rewards.balance import Balance
from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene


def _pendulum_balance(scene: Scene) -> Reward:
    return Balance(scene, ["pole"])


# (system, task) -> how to build the reward; one line a row of the paper's table.
_REWARDS: MappingProxyType[tuple[str, str], Callable[[Scene], Reward]] = MappingProxyType(
    {
        ("pendulum", "balance"): _pendulum_balance,
    }
)


def available_rewards() -> tuple[tuple[str, str], ...]:
    """Every ``(system, task)`` that :func:`make_reward` knows."""
    return tuple(_REWARDS)


def make_reward(task: str, scene: Scene) -> Reward:
    """Reward of a task of the paper, bound to a scene (paper, SM "Planning configuration").

    Args:
        task: the task's name, for example ``"balance"``.
        scene: a scene of one of the paper's systems. For a scene of your own build the
            reward itself: ``Balance(scene, ["my_pole"])``.

    Returns:
        The reward, bound to the scene's bodies.

    Raises:
        ValueError: no such task for this system (the message lists those there are), or
            the scene lacks a body that the task needs.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> make_reward("balance", load_scene("pendulum"))
        Balance(scene='pendulum', bodies=('pole',))
    """
    builder = _REWARDS.get((scene.origin.get("system", scene.name), task))
    if builder is None:
        known = ", ".join(f"{name} ({system})" for system, name in available_rewards())
        raise ValueError(f"no reward {task!r} for scene {scene.name!r}; there are: {known}")
    return builder(scene)
