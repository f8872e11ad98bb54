"""The suite's reward of reaching a target, on observations."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_gn.envs import observation_env
from torchrl_gn.rewards import TargetDistance
from torchrl_gn.scenes import ObservationGraph


@pytest.mark.parametrize("links", [3, 6])
def test_it_is_the_suites_reward_of_the_next_observation(links):
    graph = ObservationGraph.swimmer(links)
    reward = TargetDistance(graph)
    torch.manual_seed(0)
    steps = observation_env(graph, "swimmer", f"swimmer{links}", num_envs=2, timestep=0.02, steps=10).rollout(10)
    found = reward(steps["observation"], steps["action"], steps["next", "observation"])
    torch.testing.assert_close(found, steps["next", "reward"].float(), rtol=1e-5, atol=1e-6)
    assert found.unique().numel() > 10


def at(graph: ObservationGraph, *distances: float) -> torch.Tensor:
    """Observations ``[D, O]`` of a target so far away, in some direction."""
    observation = torch.randn(len(distances), graph.num_observations, dtype=torch.float64)
    length = torch.tensor(distances, dtype=torch.float64)
    observation[:, 2], observation[:, 3] = 0.6 * length, -0.8 * length
    return observation


def test_it_is_one_within_the_target_and_a_tenth_at_the_margin():
    graph = ObservationGraph.swimmer(3)
    reward = TargetDistance(graph, radius=0.3, margin=2.0)
    seen = at(graph, 0, 0.1, 0.3, 2.3, 4.3)
    expected = torch.tensor([1, 1, 1, 0.1, 1 / (1 + 36)], dtype=torch.float64)
    torch.testing.assert_close(reward(seen, seen, seen).squeeze(-1), expected, rtol=1e-12, atol=0)
    assert reward(seen.flip(0), seen[:, :2], seen.view(5, 1, -1)).shape == (5, 1, 1)


def test_its_gradient_is_finite_everywhere_and_right_beyond_the_target():
    graph = ObservationGraph.swimmer(3)
    reward = TargetDistance(graph)
    inside = at(graph, 0, 1e-9, 0.05, 0.1).requires_grad_()
    (slope,) = torch.autograd.grad(reward(inside, inside, inside).sum(), inside)
    assert (slope == 0).all()
    beyond = at(graph, 0.11, 0.5, 3).requires_grad_()
    assert torch.autograd.gradcheck(lambda seen: reward(seen, seen, seen), beyond)
    (slope,) = torch.autograd.grad(reward(beyond, beyond, beyond).sum(), beyond)
    assert ((slope[:, 2:4] * beyond[:, 2:4]).sum(-1) < 0).all()


def test_bad_arguments_are_named():
    graph = ObservationGraph.swimmer(3)
    with pytest.raises(ValueError, match=r"'swimmer3' have no 'goal'; there are \['joints', 'to_target', 'body_vel"):
        TargetDistance(graph, "goal")
    for options in ({"radius": 0.0}, {"margin": -1.0}, {"radius": math.inf}, {"margin": math.nan}):
        with pytest.raises(ValueError, match="must be positive and finite"):
            TargetDistance(graph, **options)
