"""Weighted sums of rewards, and rewards from options."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from torchrl_gn.rewards.reward import Reward
from torchrl_gn.scenes.scene import Scene


class WeightedSum(Reward):
    """Weighted sum of rewards, the type of ``forward + 0.1 * upright``.

    At most one of them may need a target; ValueError otherwise.
    """

    def __init__(self, terms: Sequence[tuple[float, Reward]]):
        super().__init__()
        flat = [(weight * inner, one) for weight, term in terms for inner, one in terms_of(term)]
        needing = [one for _, one in flat if one.target_shape is not None]
        if not flat or len(needing) > 1:
            raise ValueError(f"A sum takes rewards of which one at most needs a target, got {needing or 'none'}.")
        self.weights = tuple(float(weight) for weight, _ in flat)
        self.rewards = nn.ModuleList(one for _, one in flat)
        self.target_shape = needing[0].target_shape if needing else None

    @property
    def terms(self) -> list[tuple[float, Reward]]:
        return list(zip(self.weights, self.rewards, strict=True))  # pyright: ignore[reportReturnType]

    def task_of(self, state: Tensor, target: Tensor) -> Tensor:
        for _, reward in self.terms:
            if reward.target_shape is not None:
                return reward.task_of(state, target)
        return super().task_of(state, target)

    def forward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Tensor | None = None) -> Tensor:
        parts = (
            weight * reward(state, action, next_state, None if reward.target_shape is None else task)
            for weight, reward in self.terms
        )
        total = next(parts)
        for part in parts:
            total = total + part
        return total

    def extra_repr(self) -> str:
        return " + ".join(f"{weight:g} * {reward!r}" for weight, reward in self.terms)


def terms_of(reward: Reward) -> list[tuple[float, Reward]]:
    """Return a reward as weighted terms."""
    return reward.terms if isinstance(reward, WeightedSum) else [(1.0, reward)]


def rewards_from_options(options: Sequence[Mapping[str, Any]], scene: Scene, kinds: Mapping[str, type]) -> Reward:
    """Build a weighted sum from ``[{type: Velocity, weight: 1, body: torso, axis: x}, ...]``.

    Args:
        options: for each term, its ``type``, its ``weight`` (default 1) and the arguments of its class.
        kinds: classes by type.

    Raises:
        ValueError: for an unknown type, or arguments that its class does not take; the message names both.
    """
    terms = []
    for option in options:
        arguments = dict(option)
        name, weight = arguments.pop("type", None), arguments.pop("weight", 1.0)
        if name not in kinds:
            raise ValueError(f"Reward type {name!r} is not known; use one of {sorted(kinds)}.")
        known = list(inspect.signature(kinds[name]).parameters)[1:]  # without the scene
        if unknown := [key for key in arguments if key not in known]:
            raise ValueError(f"{name} takes no {unknown}; it takes {known}.")
        try:
            terms.append((float(weight), kinds[name](scene, **arguments)))
        except TypeError as error:
            raise ValueError(f"{name} of scene {scene.name!r}: {error}") from error
    return WeightedSum(terms)
