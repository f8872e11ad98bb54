"""Optimiser presets, clipping, schedules, and updates that are refused whole."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from torchrl_gn.objectives import ObservationModelLoss, SVGLoss
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training.muon import Muon
from torchrl_gn.training.optimizers import ScheduledOptimizer, make_agent_optimizer, make_optimizer


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.ReLU(), nn.Linear(4, 2))


def give_gradients(module: nn.Module, size: float = 1.0) -> None:
    generator = torch.Generator().manual_seed(0)
    for parameter in module.parameters():
        parameter.grad = size * torch.randn(parameter.shape, generator=generator)


def rates(optimizer: ScheduledOptimizer) -> list[float]:
    return [group["lr"] for one in optimizer.optimizers for group in one.param_groups]


def test_the_papers_preset_is_adam_with_a_slow_decay():
    module = network()
    optimizer = make_optimizer(module, "paper")
    assert [type(one) for one in optimizer.optimizers] == [torch.optim.Adam]
    for step, factor in ((0, 1), (49_999, 1), (50_000, 0.975), (149_999, 0.975**2), (1_000_000, 0.975**20)):
        give_gradients(module)
        optimizer.step(step, 0.5)
        assert rates(optimizer) == [pytest.approx(1e-4 * factor, rel=1e-12)]


def test_the_papers_first_update_is_adams():
    """Adam's first step moves every weight by the learning rate against its gradient's sign."""
    module = network()
    before = [parameter.detach().clone() for parameter in module.parameters()]
    give_gradients(module, 1e-3)
    make_optimizer(module, "paper").step(0, 0.0)
    for old, new in zip(before, module.parameters(), strict=True):
        torch.testing.assert_close(new - old, -1e-4 * new.grad.sign(), rtol=1e-2, atol=0)


@pytest.mark.parametrize("preset", ["adam", "muon"])
def test_rates_fall_to_zero_as_a_cosine(preset):
    module = network()
    optimizer = make_optimizer(module, preset)
    highest = rates(optimizer)
    for fraction in (0.0, 0.25, 0.5, 1.0):
        give_gradients(module)
        optimizer.step(0, fraction)
        factor = 0.5 * (1 + math.cos(math.pi * fraction))
        assert rates(optimizer) == pytest.approx([rate * factor for rate in highest])
    before = [parameter.clone() for parameter in module.parameters()]
    optimizer.step(0, 1.0)
    assert all(map(torch.equal, before, module.parameters()))


def test_muon_takes_the_matrices_and_adam_the_rest():
    module = network()
    muon, adam = make_optimizer(module, "muon").optimizers
    assert isinstance(muon, Muon) and isinstance(adam, torch.optim.Adam)
    by_optimizer = [{id(p) for group in one.param_groups for p in group["params"]} for one in (muon, adam)]
    assert by_optimizer[0] == {id(p) for p in module.parameters() if p.ndim == 2}
    assert by_optimizer[1] == {id(p) for p in module.parameters() if p.ndim == 1}
    assert len(make_optimizer(nn.Linear(2, 2, bias=False), "muon").optimizers) == 1


def test_the_rate_can_be_given_and_frozen_weights_stay():
    module = network()
    module[0].requires_grad_(False)
    optimizer = make_optimizer(module, "adam", lr=0.1)
    give_gradients(module)
    before = module[0].weight.clone()
    optimizer.step(0, 0.0)
    assert rates(optimizer) == [0.1]
    assert torch.equal(module[0].weight, before)


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_gradients_are_clipped_together(size):
    module = network()
    give_gradients(module, size)
    optimizer = make_optimizer(module, "adam")
    exact = torch.cat([parameter.grad.flatten() for parameter in module.parameters()])
    norm = optimizer.step(0, 0.0)
    assert norm == pytest.approx(exact.norm().item(), rel=1e-6)
    clipped = torch.cat([parameter.grad.flatten() for parameter in module.parameters()])
    torch.testing.assert_close(clipped, exact * min(1, 1 / norm), rtol=1e-5, atol=0)


def test_a_gradient_whose_squares_overflow_is_clipped():
    module = network()
    give_gradients(module)
    direction = torch.cat([parameter.grad.flatten() for parameter in module.parameters()])
    for parameter in module.parameters():
        parameter.grad.mul_(1e25)
    norm = make_optimizer(module, "adam").step(0, 0.0)
    assert norm == pytest.approx(1e25 * direction.norm().item(), rel=1e-5)
    clipped = torch.cat([parameter.grad.flatten() for parameter in module.parameters()])
    torch.testing.assert_close(clipped, direction / direction.norm(), rtol=1e-5, atol=0)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
@pytest.mark.parametrize("preset", ["paper", "adam", "muon"])
def test_a_gradient_that_is_not_finite_changes_nothing(preset, bad):
    module = network()
    optimizer = make_optimizer(module, preset)
    give_gradients(module)
    optimizer.step(0, 0.0)
    before, state = [parameter.clone() for parameter in module.parameters()], str(optimizer.state_dict())
    give_gradients(module)
    module[2].weight.grad[1, 2] = bad
    with pytest.raises(FloatingPointError, match="not finite at step 7; lower the learning rate"):
        optimizer.step(7, 0.1)
    assert all(map(torch.equal, before, module.parameters()))
    assert str(optimizer.state_dict()) == state


def test_zero_grad_forgets():
    module = network()
    give_gradients(module)
    make_optimizer(module).zero_grad()
    assert all(parameter.grad is None for parameter in module.parameters())


def test_an_optimiser_of_torch_keeps_its_rates_and_sees_whole_gradients():
    ours, theirs = network(), network()
    wrapped, plain = (torch.optim.SGD(module.parameters(), lr=0.1) for module in (ours, theirs))
    for module in (ours, theirs):
        give_gradients(module, 1e3)
    ScheduledOptimizer.of(wrapped).step(5, 1.0)
    plain.step()
    assert all(map(torch.equal, ours.parameters(), theirs.parameters()))
    give_gradients(ours, math.inf)
    with pytest.raises(FloatingPointError, match="not finite at step 6"):
        ScheduledOptimizer.of(wrapped).step(6, 1.0)


def test_a_rate_that_is_a_tensor_is_scheduled_as_a_number_is():
    weight = nn.Parameter(torch.ones(2))
    rate = torch.tensor(0.1)
    optimizer = ScheduledOptimizer([torch.optim.SGD([weight], lr=rate)], lambda step, fraction: 1 - fraction)
    for fraction in (0.5, 0.5, 0.8):
        optimizer.set_rates(0, fraction)
        assert optimizer.optimizers[0].param_groups[0]["lr"].item() == pytest.approx(0.1 * (1 - fraction))


def test_one_of_ours_is_taken_as_it_is_and_other_things_are_refused():
    ours = make_optimizer(network())
    assert ScheduledOptimizer.of(ours) is ours
    with pytest.raises(TypeError, match=r"make_optimizer\(...\) or a torch.optim.Optimizer, not str"):
        ScheduledOptimizer.of("adam")


def test_bad_choices_are_named():
    with pytest.raises(ValueError, match=r"preset 'sgd' is not known; use one of \['muon', 'adam', 'paper'\]"):
        make_optimizer(network(), "sgd")
    for lr in (0.0, -1.0):
        with pytest.raises(ValueError, match=f"lr={lr} must be positive"):
            make_optimizer(network(), lr=lr)


def test_an_agents_networks_learn_at_rates_of_their_own():
    agent = Agent(ObservationGraph.swimmer(3), model="gn", learned_reward=True, hidden=[8])
    losses = [
        SVGLoss(agent.policy, agent.value, agent.model, agent.reward),
        ObservationModelLoss(agent.model, agent.reward),
    ]
    optimizer = make_agent_optimizer(losses, policy_lr=1e-4, value_lr=2e-4, model_lr=3e-4)
    found = {weight: group["lr"] for group in optimizer.param_groups for weight in group["params"]}
    trained = [weight for loss in losses for weight in loss.parameters()]
    assert len(found) == len(trained) == sum(len(group["params"]) for group in optimizer.param_groups)
    for part, rate in ((agent.policy, 1e-4), (agent.value, 2e-4), (agent.model, 3e-4), (agent.reward, 3e-4)):
        assert {found.get(weight) for weight in part.parameters()} == {rate}


def test_a_rate_that_is_needed_is_missed():
    agent = Agent(ObservationGraph.swimmer(3), model="gn", hidden=[8])
    losses = [SVGLoss(agent.policy, agent.value, agent.model, lambda td: td), ObservationModelLoss(agent.model)]
    with pytest.raises(ValueError, match="model_lr=None must be positive"):
        make_agent_optimizer(losses, policy_lr=1e-4, value_lr=1e-3)
    with pytest.raises(ValueError, match="value_lr=0"):
        make_agent_optimizer(losses[:1], policy_lr=1e-4, value_lr=0)
