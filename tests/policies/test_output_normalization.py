"""Policies that are bounded before they are squashed, and first layers that are normalised."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.networks import LayerNormMLP
from torchrl_gn.policies import Agent, OutputNormalization
from torchrl_gn.scenes import ObservationGraph


def test_small_locations_stay_and_large_ones_keep_their_direction_and_gradient():
    small, large = torch.tensor([[0.02, -0.04]]), torch.tensor([[30.0, -5.0], [800.0, 800.0]], requires_grad=True)
    torch.testing.assert_close(OutputNormalization()(small), small, rtol=1e-3, atol=0)
    bounded = OutputNormalization()(large)
    torch.testing.assert_close(bounded.square().mean(-1), torch.ones(2), rtol=1e-2, atol=0)
    torch.testing.assert_close(bounded[0, 0] / bounded[0, 1], torch.tensor(-6.0))
    alone = torch.tensor([[30.0]], requires_grad=True)  # a single action can still be turned back
    (slope,) = torch.autograd.grad(OutputNormalization()(alone).sum(), alone)
    torch.testing.assert_close(slope, torch.tensor([[901.0**-1.5]]))


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
    torch.testing.assert_close(location.square().mean(-1), torch.ones(50), rtol=0.05, atol=0)


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
