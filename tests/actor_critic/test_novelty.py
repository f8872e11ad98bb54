"""Exploration by novelty: how far imagined states are from known ones, and who follows the chosen controls."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from torchrl_gn.actor_critic.novelty import following, novelty


class Adding:
    """A model whose position moves by the action; a NaN action diverges."""

    def step(self, state, action):
        return state + action.unsqueeze(-1), None


def test_novelty_is_the_mean_distance_to_the_nearest_known_state():
    state = torch.zeros(1, 1, 1, dtype=torch.float64)
    known = torch.tensor([[0.0], [1.0]])
    controls = torch.tensor([[0.0, 0.0], [0.5, 0.25], [1.0, 1.0], [-1.0, -1.0], [float("nan"), 1.0]]).unsqueeze(-1)
    found = novelty(Adding(), lambda states: states.flatten(-2).float(), state, controls, known, repeat=1)
    assert found.tolist() == [0.0, (0.5 + 0.25) / 2, (0.0 + 1.0) / 2, (1.0 + 2.0) / 2, 0.0]
    twice = novelty(Adding(), lambda states: states.flatten(-2).float(), state, controls[3:4], known, repeat=2)
    assert twice.tolist() == [(2.0 + 4.0) / 2]


def test_controls_are_chosen_anew_when_they_end():
    asked = []

    def choose(state):
        asked.append(float(state[0, 0, 0]))
        return torch.full((2, 1), 10.0 * len(asked))

    act, actions = following(choose), []
    for step in range(5):
        state = torch.full((1, 1, 1), float(step))
        actions.append(float(act(TensorDict({"state": state}, [1]))["action"]))
    assert actions == [10, 10, 20, 20, 30] and asked == [0, 2, 4]
