"""Options of a tiny actor-critic, which trains in a second."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from torchrl_gn.actor_critic import ActorCriticOptions, EvaluationEpisodes, FirstTrajectories

SMALL: dict[str, Any] = {
    "first": FirstTrajectories(trajectories=4, length=50, steps=2),
    "evaluate": EvaluationEpisodes(episodes=2, steps=5),
    "model": {"hidden": 8, "latent": 8},
    **{"horizon": 3, "hidden": [8], "updates": 2, "batch_size": 8, "episodes": 2, "steps": 50, "model_steps": 1},
    **{"reward_steps": 2, "action_repeat": 1},
}


@pytest.fixture(scope="session")
def small() -> Callable[..., ActorCriticOptions]:
    """Function that makes tiny options, some of them replaced."""
    return lambda **others: ActorCriticOptions(**(SMALL | others))
