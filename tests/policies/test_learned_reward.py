"""A learned reward over observations: gradients, and the fit of a known reward."""

from __future__ import annotations

import torch

from torchrl_gn.policies import LearnedReward


def test_a_learned_reward_is_differentiable_in_all_that_it_reads():
    torch.manual_seed(0)
    reward = LearnedReward(3, 2, hidden=(8,)).double()
    inputs = [torch.randn(2, 4, size, dtype=torch.float64, requires_grad=True) for size in (3, 2, 3)]
    assert reward(*inputs).shape == (2, 4, 1)
    assert torch.autograd.gradcheck(reward, inputs)
    assert all((part.abs() > 0).all() for part in torch.autograd.grad(reward(*inputs).sum(), inputs))


def test_it_learns_a_reward_of_step_and_effort():
    torch.manual_seed(0)
    reward = LearnedReward(1, 1, hidden=(32,))
    before, action, after = torch.rand(3, 500, 1)
    truth = after - before - action.square()
    optimizer = torch.optim.Adam(reward.parameters(), lr=1e-2)
    for _ in range(200):
        error = (reward(before, action, after) - truth).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    assert error < 0.01 * truth.var()
