"""Policies that are bounded before they are squashed, and first layers that are normalised."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.modules import Agent, LayerNormMLP, OutputNormalization
from torchrl_gn.scenes import ObservationGraph


def test_only_what_is_large_on_average_is_divided():
    location = torch.tensor([[0.2, -0.4], [3.0, -0.5], [8.0, 8.0]])
    expected = torch.tensor([[0.2, -0.4], [12 / 7, -2 / 7], [1.0, 1.0]])
    torch.testing.assert_close(OutputNormalization()(location), expected)


@pytest.mark.parametrize("options", [{}, {"policy": "graph"}, {"stochastic": False}])
def test_no_weights_drive_a_policy_to_where_nothing_varies(options):
    """However large the last layer grows, actions stay where the tanh has a slope."""
    torch.manual_seed(0)
    agent = Agent(ObservationGraph.swimmer(6), hidden=(8,), policy_options={"latent": 4, "hidden": [8]}, **options)
    with torch.no_grad():
        for weight in agent.policy.parameters():
            weight *= 30
    observation = torch.randn(50, 25)
    out = agent.policy(TensorDict({"observation": observation}, [50]))
    location = out["loc"] if "loc" in out else torch.atanh(out["action"])
    torch.testing.assert_close(location.abs().mean(-1), torch.ones(50), rtol=1e-3, atol=1e-3)


def test_scales_of_observations_hardly_matter():
    torch.manual_seed(0)
    mlp = LayerNormMLP(5, 2, (64, 8))
    observation, action = torch.randn(20, 3), torch.randn(20, 2)
    assert mlp(observation, action).shape == (20, 2)
    once, tenfold = (mlp(scale * observation, scale * action) for scale in (30.0, 300.0))
    torch.testing.assert_close(once, tenfold, rtol=0.05, atol=0.02)


def test_a_network_without_hidden_layers_is_refused():
    with pytest.raises(ValueError, match="at least one hidden size"):
        LayerNormMLP(3, 1, ())
