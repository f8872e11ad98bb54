"""Options and models that measures refuse by name, and kinds of models that all of them take."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories, create_dataset, simulate_log, trajectory_buffer
from torchrl_gn.dynamics import AdaptedPredictor, Ensemble, ForwardModel, RobotChange
from torchrl_gn.evaluation import (
    calibrate,
    evaluate_coverage,
    evaluate_errors,
    guarded_rollout,
    half_step_errors,
    joint_errors,
    linear_probe,
    pose_errors,
    report,
)
from torchrl_gn.evaluation.rollout import rollout
from torchrl_gn.scenes import Scene
from torchrl_gn.training import fit, load_pretrained

STEPS = 6


@pytest.fixture(scope="module")
def scene(scenes) -> Scene:
    return scenes["pendulum"]


@pytest.fixture(scope="module")
def trajectories(scene) -> TensorDict:
    return collect_trajectories(scene, 4, STEPS, seed=3)


@pytest.fixture(scope="module")
def ensemble(scene) -> Ensemble:
    torch.manual_seed(0)
    return Ensemble.for_scene(scene, count=2, hidden=8, layers=1)


@pytest.mark.parametrize("horizons", [(2.9,), (True,), ("2",), "23", 2, (0, 2), (np.nan,)])
def test_horizons_are_whole_numbers_of_steps(horizons, scene, trajectories, ensemble, tmp_path):
    bound = ensemble.bind(scene)
    calibrate(bound, trajectories)
    for measure in (
        lambda: evaluate_errors(bound.members[0], trajectories, horizons=horizons),
        lambda: evaluate_coverage(bound, trajectories, horizons=horizons),
        lambda: half_step_errors(scene, trajectories, horizons=horizons),
        lambda: report(bound.members[0], trajectories, tmp_path, horizons=horizons),
    ):
        with pytest.raises(ValueError, match="horizons"):
            measure()
    assert not list(tmp_path.iterdir())


def test_horizons_may_be_of_any_order_and_of_numpys_integers(scene, trajectories, ensemble):
    model = ensemble.models[0].bind(scene)
    found = evaluate_errors(model, trajectories, horizons=np.array([4, 2, 4]))
    assert list(found.errors) == ["one_step_error", "rollout_error_2", "rollout_error_4"]


@pytest.mark.parametrize(
    "options",
    [{"burn_in": 1.5}, {"burn_in": True}, {"batch_size": 2.5}, {"batch_size": 0}, {"keep": -1}, {"keep": 0.5}],
)
def test_counts_of_an_evaluation_are_whole(options, scene, trajectories, ensemble):
    with pytest.raises(ValueError, match=f"{next(iter(options))}=.* must be a whole number"):
        evaluate_errors(ensemble.models[0].bind(scene), trajectories, horizons=(2,), **options)


def test_an_evaluation_of_nothing_is_refused(scene, trajectories, ensemble):
    with pytest.raises(ValueError, match="No error is asked for"):
        evaluate_errors(ensemble.models[0].bind(scene), trajectories, horizons=(), one_step=False)


def test_counts_of_data_and_training_are_whole(scene, trajectories, ensemble, tmp_path):
    model = ensemble.models[0].bind(scene)
    for call in (
        lambda: collect_trajectories(scene, 2, 2.5),
        lambda: collect_trajectories(scene, True, 2),
        lambda: create_dataset(tmp_path / "data", scene, 2, 2, 2, 2.5),
        lambda: trajectory_buffer(trajectories, batch_size=2.5),
        lambda: trajectory_buffer(trajectories, batch_size=2, window=1.5),
        lambda: trajectory_buffer(trajectories, batch_size=2, capacity=9.5),
        lambda: trajectory_buffer(trajectories, batch_size=2, query_windows=(1, 1.5)),
        lambda: fit(model, trajectories, steps=1.5, progress=False),
        lambda: guarded_rollout(model, trajectories["state"][:, 0], trajectories["action"], every=1.5),
        lambda: linear_probe(torch.randn(8, 2), torch.randn(8, 2), train=4.0),
        lambda: simulate_log(scene, 1.5, 9, 0),
        lambda: simulate_log(scene, 1, 1, 0),
        lambda: simulate_log(scene, 1, 9, 0, delay=-1),
    ):
        with pytest.raises(ValueError, match="must be a whole number"):
            call()
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("name", ["time_constant", "play", "quantum", "noise"])
@pytest.mark.parametrize("amount", [-0.1, np.nan, np.inf])
def test_amounts_of_a_simulated_log(name, amount, scene):
    with pytest.raises(ValueError, match=f"{name}={amount} must be 0 or more"):
        simulate_log(scene, 1, 9, 0, **{name: amount})


def test_models_without_a_scene_and_single_models(scene, trajectories, ensemble):
    for measure in (joint_errors, pose_errors, calibrate, evaluate_coverage):
        with pytest.raises(TypeError, match="Ensemble is not bound to a scene"):
            measure(ensemble, trajectories)
    for measure in (joint_errors, pose_errors):
        with pytest.raises(TypeError, match="ForwardModel is not bound to a scene"):
            measure(ForwardModel.for_scene(scene, hidden=8), trajectories)
    for measure in (calibrate, evaluate_coverage):
        with pytest.raises(TypeError, match="takes an ensemble, .* not BoundPredictor"):
            measure(ensemble.models[0].bind(scene), trajectories)


def test_joint_and_pose_errors_of_ensembles_and_adapted_models(scene, trajectories, ensemble):
    bound, truth = ensemble.bind(scene), trajectories["state"][:, 1:]
    change = RobotChange(*(torch.tensor([each]).double() for each in (0.5, 0, 0.1, 0)), *[torch.zeros(0)] * 2)
    trained = load_pretrained("pendulum").bind(scene)
    adapted = AdaptedPredictor(trained, change)
    start, action = trajectories["state"][:, 0], trajectories["action"]
    for model, predicted in ((bound, rollout(bound, start, action)), (adapted, adapted.rollout(start, action))):
        found = pose_errors(model, trajectories, node=1)
        expected = (predicted[:, 1:, 1, :3] - truth[:, :, 1, :3]).norm(dim=-1).mean(1)
        torch.testing.assert_close(found.position, expected.double())
        assert joint_errors(model, trajectories).coordinate > 0
    plain = joint_errors(trained, trajectories)
    assert joint_errors(adapted, trajectories).mean_square != plain.mean_square
    assert joint_errors(AdaptedPredictor(trained), trajectories).mean_square == pytest.approx(plain.mean_square)


@pytest.mark.parametrize("node", [0, -1, 9, 1.0])
def test_pose_errors_are_of_a_body_that_moves(node, scene, trajectories, ensemble):
    with pytest.raises(ValueError, match="must be a node whose body moves"):
        pose_errors(ensemble.models[0].bind(scene), trajectories, node=node)


def test_probes_of_constant_and_unknown_numbers():
    features, targets = torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), torch.ones(20, 2)
    targets[:, 1] = features[:, 0]
    found = linear_probe(features, targets, train=12)
    assert found[0].isnan() and found[1] > 0.9
    features[3, 1] = torch.nan
    with pytest.raises(ValueError, match="features has nan at index"):
        linear_probe(features, targets, train=12)
