"""Score of MPPI's candidates."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.planners import ReturnToGo


def advantage(reward: torch.Tensor) -> torch.Tensor:
    """Return the advantages of rewards ``[K, H]``."""
    given = TensorDict({"next": {"reward": reward[..., None]}}, reward.shape)
    return ReturnToGo()(given)["advantage"].squeeze(-1)


def test_it_is_the_return_from_each_step_on_less_the_best_in_the_spread():
    reward = torch.tensor([[1.0, 2.0, 3.0], [4.0, 0.0, 1.0]])
    returns = torch.tensor([[6.0, 5.0, 3.0], [5.0, 1.0, 1.0]])
    spread = (returns[0] - returns[1]).abs() / 2**0.5  # of two
    torch.testing.assert_close(advantage(reward), (returns - returns.amax(0)) / spread)


def test_it_does_not_depend_on_how_large_rewards_are():
    reward = torch.randn(2, 5, 4, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(advantage(1e3 * reward - 7), advantage(reward), rtol=1e-3, atol=1e-3)


def test_candidates_that_are_alike_score_alike():
    assert (advantage(torch.ones(4, 3)) == 0).all()


def test_candidates_that_are_far_off_do_not_make_the_others_alike():
    """Up to three of four may be unstable."""
    reward = torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
    good = advantage(reward[:20])
    for lost in (1, 44):
        given = torch.cat((reward[:20], torch.full((lost, 3), -1e6)))
        found = advantage(given)
        assert (found[20:] < -1e4).all()
        torch.testing.assert_close(found[:20], good)


@pytest.mark.parametrize("bad", [-torch.inf, torch.inf, torch.nan])
@pytest.mark.parametrize("lost", [1, 12, 19])
def test_returns_that_are_not_finite_never_win(bad, lost):
    """MPPI's actions were NaN, silently, where all candidates or the best return were infinite."""
    reward = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    reward[:lost, 1] = bad  # which returns from the third step on do not see
    found = advantage(reward)
    assert (found[:lost, :2] == -torch.inf).all()
    torch.testing.assert_close(found[lost:, :2], advantage(reward[lost:])[:, :2])
    torch.testing.assert_close(found[:, 2], advantage(reward[:, 2:]).squeeze(-1))


@pytest.mark.parametrize("bad", [-torch.inf, torch.nan])
def test_where_no_return_is_finite_all_score_alike(bad):
    assert (advantage(torch.full((6, 3), bad)) == 0).all()


@pytest.mark.parametrize("size", [1e25, 1e36])
def test_squares_of_returns_may_overflow(size):
    reward = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(advantage(size * reward), advantage(reward))


def test_one_candidate_is_the_best():
    assert (advantage(torch.ones(1, 3)) == 0).all()
