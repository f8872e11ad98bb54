"""Calibration of ensembles, and coverage of errors by the stated standard deviations."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import spearmanr
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import BoundEnsemble, BoundPredictor, Ensemble, specialize
from torchrl_gn.dynamics.ensemble import mean_and_spread
from torchrl_gn.evaluation import (
    calibrate,
    calibration,
    evaluate_coverage,
    evaluate_errors,
    guarded_rollout,
    joint_errors,
    report,
    rollout,
)
from torchrl_gn.scenes import sample_variants
from torchrl_gn.training import fit_ensemble

from ..sizes import SMALL

STEPS = 4


class Drawn(BoundEnsemble):
    """Members with random errors: a common part and an individual part, of one random size per sample."""

    def __init__(
        self, ensemble: Ensemble, scene, truth: torch.Tensor, common: float, diverges: float = 0, wild: float = 1
    ) -> None:
        super().__init__(ensemble.bind(scene).members, ensemble.calibration)
        self.truth, self.common, self.diverges, self.wild = truth, common, diverges, wild
        self.generator = torch.Generator().manual_seed(len(truth))

    def rollout(self, state, actions):
        generator, count = self.generator, len(self.members)
        truth = self.truth[: len(state), : actions.shape[1] + 1]
        shape = (*truth.shape[:-1], 12)
        size = 0.02 * torch.exp(torch.randn(len(state), 1, 1, 1, generator=generator)).double()
        both = self.common * torch.randn(shape, generator=generator).double()
        own = torch.randn(count, *shape, generator=generator).double()
        moves = torch.as_tensor(self.scene.movable)
        members = self.layout.apply(truth.expand(count, *truth.shape), size * (both + own) * moves)
        members[0, : round(self.diverges * len(state)), 2:] = torch.nan
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

    def draw(count: int, common: float = 0.5, diverges: float = 0, wild: float = 1):
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


def test_noise_of_the_data_is_in_the_floor(draw):
    """The standard deviation is the noise if all members agree but the data are noisy."""
    factors = []
    for noise in (0.0, 1.0):
        ensemble, trajectories = draw(400)
        moves = torch.as_tensor(ensemble.scene.movable)
        off = noise * torch.randn(*trajectories["state"].shape[:-1], 12, generator=ensemble.generator).double() * moves
        trajectories["state"] = ensemble.layout.apply(trajectories["state"], off)
        calibrate(ensemble, trajectories)
        calm = torch.zeros(1, STEPS, *moves.shape, dtype=torch.float64)
        factors.append(ensemble.calibration(calm, ensemble.layout)[..., moves].median())
        found = evaluate_coverage(ensemble, trajectories, horizons=(1, 4))
        assert (found.one - 0.68).abs().max() < 0.08 and (found.two - 0.95).abs().max() < 0.05
    assert factors[0] < 0.05 and factors[1] == pytest.approx(1, rel=0.2)


def test_doubt_is_one_where_it_was_calibrated(draw):
    calibrate(*draw(300))
    usual, wild = (evaluate_coverage(*draw(301, wild=wild), horizons=(1,)) for wild in (1, 10))
    assert usual.doubt == pytest.approx(1, abs=0.2) and 8 < wild.doubt < 12
    assert usual.doubt_rank > 0.7 and wild.doubt_rank > 0.7


def test_rollouts_that_diverge_do_not_make_all_others_uncertain(draw):
    ensemble, trajectories = draw(400)
    calibrate(ensemble, trajectories)
    factor = ensemble.calibration.factor.clone()
    ensemble, trajectories = draw(400, diverges=0.1)
    calibrate(ensemble, trajectories)
    torch.testing.assert_close(ensemble.calibration.factor, factor, rtol=0.1, atol=0)
    found = evaluate_coverage(ensemble, trajectories, horizons=(1, 4))
    assert (found.two[0] > 0.9).all() and (found.two[1] < 0.9).all()  # one in ten may be anywhere
    with pytest.raises(ValueError, match="All rollouts diverge by step 2"):
        calibrate(*draw(20, diverges=1))


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


def test_further_training_drops_the_calibration(scenes):
    data = [collect_trajectories(scenes["pendulum"], 10, 5, seed=seed) for seed in range(2)]
    bound = Ensemble.for_scene(scenes["pendulum"], count=2, hidden=8, layers=1).bind(scenes["pendulum"])
    options = {"steps": 1, "batch_size": 4, "progress": False}
    fit_ensemble(bound, data[0], **options)
    calibrate(bound, data[1])
    first = bound.calibration.factor.clone()
    fit_ensemble(bound, data[0], **options)
    assert not bound.calibration.fitted
    with pytest.raises(RuntimeError, match="not calibrated"):
        bound.doubt(data[1]["state"][:, 0], data[1]["action"][:, 0])
    calibrate(bound, data[1])
    assert bound.calibration.factor.shape == first.shape and not torch.equal(bound.calibration.factor, first)


def test_tables_and_reports_of_an_ensemble(scenes, make_model, tmp_path, calls):
    scene = scenes["pendulum"]
    data = collect_trajectories(scene, 12, 6, seed=0)
    bound = Ensemble([make_model(scene, seed=seed).double() for seed in range(3)]).bind(scene)
    options = {"horizons": (2, 6)}
    table = evaluate_errors(bound, data, **options)
    assert table.coverage is None and "within 1 / 2 std" not in str(table)
    members = torch.stack([member.rollout(data["state"][:, 0], data["action"])[0] for member in bound.members])
    mean, _ = mean_and_spread(members, bound.layout)
    torch.testing.assert_close(rollout(bound, data["state"][:, 0], data["action"]), mean)
    kept = evaluate_errors(bound, data, **options, keep=2).rollouts
    torch.testing.assert_close(kept, mean[:2])
    assert not torch.equal(kept, members[0, :2])
    fitted = joint_errors(bound, data)
    assert fitted.mean_square != joint_errors(bound.members[0], data).mean_square
    calibrate(bound, data)
    rolled = calls(BoundPredictor, "rollout")
    again = evaluate_errors(bound, data, **options)
    assert len(rolled) == 3  # once for each member
    expected = evaluate_coverage(bound, data, horizons=(1, 2, 6))
    for name in ("one", "two", "sharpness", "rank", "doubt", "doubt_rank"):
        torch.testing.assert_close(getattr(again.coverage, name), getattr(expected, name))
    table, files = report(bound, data, tmp_path, horizons=(2, 6))
    assert table.coverage is not None and table.coverage.horizons == (1, 2, 6)
    assert "within 1 / 2 std" in str(table) and "coverage/one_6/orientation" in table.to_metrics()
    assert "coverage/sharpness_2/angular_velocity" in table.to_metrics() and files[0].is_file()


def test_an_ensemble_diverges_where_a_member_does(scenes, make_model, monkeypatch):
    scene = scenes["pendulum"]
    data = collect_trajectories(scene, 3, 6, seed=0)
    bound = Ensemble([make_model(scene, seed=seed).double() for seed in range(2)]).bind(scene)
    for name, value in (("action_low", -torch.inf), ("action_high", torch.inf)):
        controls = bound.members[1].controls
        monkeypatch.setitem(controls._buffers, name, torch.full_like(getattr(controls, name), value))
    actions = data["action"].clone()
    actions[1, 3] = 1e308  # which the first member clips
    found, expected = (guarded_rollout(bound, data["state"][:, 0], each) for each in (actions, data["action"]))
    assert found.good_steps.tolist() == [6, 3, 6] and not expected.diverged.any()
    torch.testing.assert_close(found.states[::2], expected.states[::2])
    torch.testing.assert_close(found.states[1, :4], expected.states[1, :4])
    assert (found.states[1, 3:] == found.states[1, 3]).all()


def test_variants_are_refused(scenes, make_model):
    scene = scenes["pendulum"]
    bound = Ensemble([make_model(scene, seed=seed) for seed in range(2)]).bind(scene)
    data = collect_trajectories(sample_variants("pendulum", 2, rng=0), 4, 3)
    with pytest.raises(ValueError, match="other parameters"):
        calibrate(bound, data)
    calibrate(bound, collect_trajectories(scene, 4, 3))
    with pytest.raises(ValueError, match="other parameters"):
        evaluate_coverage(bound, data, horizons=(1,))


def test_ranks_are_spearmans(draw):
    """Of rollouts that diverged, all are infinite; their rank is the mean of theirs."""
    calibrate(*draw(60))
    ensemble, trajectories = draw(100, diverges=0.3)
    found = evaluate_coverage(ensemble, trajectories, horizons=(1, 4)).rank
    ensemble, trajectories = draw(100, diverges=0.3)  # which draws the same errors
    horizons = [1, 4]
    members = ensemble.rollout(trajectories["state"][:, 0], trajectories["action"])[..., horizons, :, :]
    mean, spread = mean_and_spread(members, ensemble.layout)
    stated = ensemble.calibration(spread, ensemble.layout, (1, 4))
    wrong = ensemble.layout.delta(mean, trajectories["state"][:, horizons])
    for row in range(2):
        for column, where in enumerate(ensemble.layout.delta_slices.values()):
            moves = torch.as_tensor(ensemble.scene.movable)[:, where]
            sizes = [each[:, row, :, where][..., moves].square().mean(-1) for each in (stated, wrong)]
            assert found[row, column].item() == pytest.approx(spearmanr(*sizes).statistic, abs=1e-12)


def test_equal_standard_deviations_have_no_rank(draw):
    calibrate(*draw(60))
    ensemble, trajectories = draw(100)
    agreed, moves = trajectories["state"].expand(5, -1, -1, -1, -1), torch.as_tensor(ensemble.scene.movable)
    ensemble.rollout = lambda state, actions: agreed
    change = 0.1 * torch.rand(100, STEPS + 1, *moves.shape, generator=ensemble.generator).double() * moves
    trajectories["state"] = ensemble.layout.apply(trajectories["state"], change)
    assert not evaluate_coverage(ensemble, trajectories, horizons=(4,)).rank.any()


def test_one_step_errors_are_of_all_times(draw, calls, monkeypatch):
    """The number of skipped states may be a multiple of a trajectory's steps."""
    monkeypatch.setattr(calibration, "_STATES", 100)
    ensemble, trajectories = draw(100)
    seen = calls(ensemble, "step", lambda state, action: action[:, 0])
    trajectories["action"][:] = torch.arange(STEPS)[:, None]  # the step's number
    calibrate(ensemble, trajectories)
    (found,) = seen
    assert 50 <= len(found) <= 100 and found.unique(return_counts=True)[1].tolist() == [20] * STEPS
