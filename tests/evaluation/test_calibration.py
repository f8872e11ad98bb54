"""Calibration of ensembles, and how many errors are within what they state."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import BoundEnsemble, Ensemble, specialize
from torchrl_gn.evaluation import calibrate, evaluate_coverage
from torchrl_gn.training import fit_ensemble

from ..sizes import SMALL

STEPS = 4


class Drawn(BoundEnsemble):
    """Members that err at random: by a common and an own part, whose sizes are told only by what the members share."""

    def __init__(
        self, ensemble: Ensemble, scene, truth: torch.Tensor, common: float, diverges: int = 0, wild: float = 1
    ) -> None:
        super().__init__(ensemble.bind(scene).members, ensemble.calibration)
        self.truth, self.common, self.diverges, self.wild = truth, common, diverges, wild

    def rollout(self, state, actions):
        generator, count = torch.Generator().manual_seed(len(actions)), len(self.members)
        shape = (*self.truth.shape[:-1], 12)
        size = 0.02 * torch.exp(torch.randn(len(state), 1, 1, 1, generator=generator)).double()
        both = self.common * torch.randn(shape, generator=generator).double()
        own = torch.randn(count, *shape, generator=generator).double()
        moves = torch.as_tensor(self.scene.movable)
        members = self.layout.apply(self.truth.expand(count, *self.truth.shape), size * (both + own) * moves)
        members[0, : self.diverges, 2:] = torch.nan
        return members

    def step(self, state, action):
        generator, count = torch.Generator().manual_seed(len(action)), len(self.members)
        size = self.wild * 0.02 * torch.exp(torch.randn(len(state), 1, 1, generator=generator)).double()
        own = torch.randn(count, *state.shape[:-1], 12, generator=generator).double()
        return self.layout.apply(state.expand(count, *state.shape), size * own * torch.as_tensor(self.scene.movable))


@pytest.fixture
def draw(scenes, make_model):
    """An ensemble's rollouts of random errors, with the trajectories."""
    scene = scenes["cheetah"]
    made = Ensemble([make_model(scene, seed=seed) for seed in range(5)])

    def draw(count: int, common: float = 0.5, diverges: int = 0, wild: float = 1):
        truth = torch.as_tensor(scene.reference_state).expand(count, STEPS + 1, -1, -1).clone()
        action = torch.zeros(count, STEPS, scene.num_actions, dtype=torch.float64)
        return Drawn(made, scene, truth, common, diverges, wild), TensorDict(
            {"state": truth, "action": action}, [count]
        )

    return draw


@pytest.mark.parametrize("common", [0.0, 0.5, 2.0])
def test_calibrated_standard_deviations_hold_what_they_say(draw, common):
    calibrate(*draw(400, common))
    found = evaluate_coverage(*draw(300, common), horizons=(1, 4))
    # Tails of members that are few are heavy: not exactly those of a normal distribution.
    assert (found.one - 0.68).abs().max() < 0.08 and (found.two - 0.95).abs().max() < 0.05
    assert found.rank.min() > 0.7 and found.horizons == (1, 4)
    assert found.names == ("position", "orientation", "linear_velocity", "angular_velocity")
    assert ((found.sharpness > 0.4) & (found.sharpness < 2)).all()


def test_doubt_is_one_where_it_was_calibrated(draw):
    calibrate(*draw(300))
    usual, wild = (evaluate_coverage(*draw(301, wild=wild), horizons=(1,)) for wild in (1, 10))
    assert usual.doubt == pytest.approx(1, abs=0.2) and 5 < wild.doubt < 10.5  # the floor is part of it
    assert usual.doubt_rank > 0.7 and wild.doubt_rank > 0.7


def test_rollouts_that_diverge_do_not_make_all_others_uncertain(draw):
    ensemble, trajectories = draw(400)
    calibrate(ensemble, trajectories)
    factor = ensemble.calibration.factor.clone()
    ensemble, trajectories = draw(400, diverges=40)
    calibrate(ensemble, trajectories)
    torch.testing.assert_close(ensemble.calibration.factor, factor, rtol=0.1, atol=0)
    found = evaluate_coverage(ensemble, trajectories, horizons=(1, 4))
    assert (found.two[0] > 0.9).all() and (found.two[1] < 0.9).all()  # one in ten may be anywhere
    with pytest.raises(ValueError, match="All rollouts diverge by step 2"):
        calibrate(*draw(20, diverges=20))


def test_numbers_and_table(draw):
    ensemble, trajectories = draw(300)
    with pytest.raises(RuntimeError, match="not calibrated"):
        evaluate_coverage(ensemble, trajectories, horizons=(1,))
    calibrate(ensemble, trajectories)
    found = evaluate_coverage(ensemble, trajectories, horizons=(1, 4))
    metrics = found.to_metrics()
    assert metrics["one_4/orientation"] == found.one[1, 1].item() and len(metrics) == 4 * 2 * 4 + 2
    assert str(found).splitlines()[2].startswith("orientation") and "after 4" in str(found)
    for wrong in ((0, 1), (5,), ()):
        with pytest.raises(ValueError, match="horizons="):
            evaluate_coverage(ensemble, trajectories, horizons=wrong)


@pytest.mark.slow
def test_an_ensemble_is_trained_calibrated_and_specialised(scenes):
    scene = scenes["pendulum"]
    data = [collect_trajectories(scene, 60, 10, seed=seed) for seed in range(3)]
    torch.manual_seed(0)
    bound = Ensemble.for_scene(scene, count=3, **SMALL).bind(scene)
    histories = fit_ensemble(bound, data[0], steps=200, progress=False)
    assert len(histories) == 3 and all(each.losses[-1] < 0.1 * each.losses[0] for each in histories)
    assert len({each.losses[-1] for each in histories}) == 3
    quick = specialize(bound)
    calibrate(quick, data[1])
    found = evaluate_coverage(bound, data[2], horizons=(1, 10))  # which shares the calibration
    assert (found.one > 0.4).all() and (found.two > 0.6).all()
    with pytest.raises(TypeError, match="takes a bound ensemble"):
        fit_ensemble(quick, data[0], steps=1)
