"""Truth and prediction, step by step: MuJoCo's rollouts, and the library's own."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator
from torchrl_gn.dynamics import Ensemble
from torchrl_gn.maths import quaternion
from torchrl_gn.viewer.world import LiveWorld, Playback, pose_error, trajectory_of

STEPS = 7


@pytest.fixture(scope="module")
def scene(scenes):
    return scenes["swimmer6"]


@pytest.fixture
def model(scene, make_model):
    return make_model(scene).bind(scene)


def run(world, every: int = 0) -> tuple[list, torch.Tensor]:
    """Moments of some steps under random controls, and these controls ``[T, A]``."""
    moments, actions = [world.moment], []
    for _ in range(STEPS):
        actions.append(world.random_action())
        assert world.step(actions[-1], every)
        moments.append(world.moment)
    return moments, torch.from_numpy(np.array(actions))


def test_truth_is_mujocos_bit_for_bit(scene):
    world = LiveWorld(scene, seed=3)
    start = world.moment.physics.copy()
    moments, actions = run(world)
    expected = Simulator(scene).rollout(start, actions)
    assert torch.equal(torch.stack([moment.state for moment in moments]), expected["state"])
    assert np.array_equal([moment.physics for moment in moments], expected["physics"])
    assert [moment.time for moment in moments] == pytest.approx([0.02 * step for step in range(STEPS + 1)])
    assert all(moment.prediction is None for moment in moments)


def test_prediction_is_the_models_own_rollout(scene, model):
    moments, actions = run(LiveWorld(scene, model, seed=3))
    with torch.no_grad():
        expected = model.rollout(moments[0].state, actions)[0]
    torch.testing.assert_close(torch.stack([moment.prediction for moment in moments]), expected)
    assert [moment.ahead for moment in moments] == list(range(STEPS + 1))
    assert not torch.allclose(moments[-1].prediction, moments[-1].state)


def test_a_recurrent_model_keeps_its_memory(scene, make_model):
    model = make_model(scene, core="recurrent", hidden_state=(3, 4, 5)).bind(scene)
    moments, actions = run(LiveWorld(scene, model, seed=3))
    with torch.no_grad():
        expected = model.rollout(moments[0].state, actions)[0]
    torch.testing.assert_close(torch.stack([moment.prediction for moment in moments]), expected)


@pytest.mark.parametrize("every", [1, 3])
def test_resynchronised_predictions_start_from_the_truth(scene, model, every):
    moments, actions = run(LiveWorld(scene, model, seed=3), every)
    assert [moment.ahead for moment in moments] == [0] + [step % every + 1 for step in range(STEPS)]
    for step in range(0, STEPS, every):
        with torch.no_grad():
            expected = model.step(moments[step].state, actions[step])[0]
        torch.testing.assert_close(moments[step + 1].prediction, expected)


@pytest.mark.parametrize("every", [0, 3])
@pytest.mark.parametrize("kind", ["model", "ensemble"])
def test_playback_shows_what_the_live_world_did(scene, make_model, kind, every):
    one = make_model(scene)
    model = (one if kind == "model" else Ensemble([one, make_model(scene, seed=1)])).bind(scene)
    moments, actions = run(LiveWorld(scene, model, seed=3), every)
    played = Playback(scene, trajectory_of(torch.stack([each.state for each in moments]), actions), model)
    for moment in moments[1:]:
        assert played.step(every=every)
        assert torch.equal(played.moment.state, moment.state) and np.array_equal(played.moment.action, moment.action)
        assert (played.moment.time, played.moment.ahead) == (pytest.approx(moment.time), moment.ahead)
        torch.testing.assert_close(played.moment.prediction, moment.prediction)
        torch.testing.assert_close(played.moment.std, moment.std)
    assert not played.step(every=every), "a recording ends"
    played.reset()
    assert torch.equal(played.moment.state, moments[0].state)


@pytest.mark.parametrize("fitted", [False, True])
def test_an_ensembles_band_is_its_own(scene, make_model, fitted):
    ensemble = Ensemble([make_model(scene, seed=seed) for seed in range(3)])
    if fitted:
        count = len(scene.layout.names)
        factor = torch.arange(2.0, 5.0).unsqueeze(-1).expand(-1, count)
        ensemble.calibration.set(factor, torch.full((3, count), 0.01), torch.ones(count))
    bound = ensemble.bind(scene)
    moments, actions = run(LiveWorld(scene, bound, seed=3))
    with torch.no_grad():
        members = bound.rollout(moments[0].state, actions)
        spread = members[..., :3].std(0).norm(dim=-1)
        std = bound.predict(moments[0].state, actions).std[..., :3].norm(dim=-1) if fitted else spread
    torch.testing.assert_close(torch.stack([moment.std for moment in moments]), std)
    assert moments[0].std.eq(0).all() and moments[-1].std[1:].gt(0).all()


def test_an_unstable_simulation_keeps_the_last_moment(scene):
    world = LiveWorld(scene)
    wild = world.moment.physics.copy()
    wild[1 + scene.model.nq :] = 1e12
    world.start(wild)
    before = world.moment
    assert not world.step(scene.rest_action) and world.moment is before
    world.reset()
    assert world.step(scene.rest_action)


def test_a_diverged_prediction_is_not_shown_until_it_is_set_to_the_truth(scene, model):
    world = LiveWorld(scene, model)
    far = world.moment.state.clone()
    far[1:, 7:] = 1e9
    world.forecast.restart(far)
    world.step(world.random_action(), 2)
    assert world.moment.prediction is None and world.moment.ahead == 1
    world.step(world.random_action(), 2)
    world.step(world.random_action(), 2)
    assert world.moment.prediction is not None and world.moment.ahead == 1


def test_reset_and_random_controls_follow_the_seed(scene):
    one, same, other = (LiveWorld(scene, seed=seed) for seed in (0, 0, 1))
    assert np.array_equal(one.moment.physics, same.moment.physics)
    assert np.array_equal(one.random_action(), same.random_action())
    assert not np.array_equal(one.moment.physics, other.moment.physics)
    before = one.moment.physics
    one.reset()
    same.reset()
    assert not np.array_equal(one.moment.physics, before)
    assert np.array_equal(one.moment.physics, same.moment.physics)


def test_errors_are_metres_and_radians_of_the_moving_bodies(scene):
    truth = LiveWorld(scene).moment.state
    moved = truth.clone()
    moved[1:, 0] += 0.3
    moved[1:, 1] += 0.4
    turn = torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64)
    moved[1:, 3:7] = quaternion.product(quaternion.exp(turn), truth[1:, 3:7])
    assert pose_error(scene, truth, moved) == pytest.approx((0.5, 0.2))
    moved[:, 3:7] *= -1  # the same rotation
    assert pose_error(scene, truth, moved) == pytest.approx((0.5, 0.2))
    assert not math.isnan(pose_error(scene, truth, truth)[1])
