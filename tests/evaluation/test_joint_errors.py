"""Errors of joint coordinates and rates in metres and radians."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.dynamics import Ensemble, ForwardModel, specialize
from torchrl_gn.evaluation import calibrate, joint_errors, pose_errors
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes import load_scene, sample_variants
from torchrl_gn.training import load_pretrained

FREE = """<mujoco><worldbody><body name="box" pos="0 0 1"><freejoint name="root"/><geom type="box" size=".1 .2 .3"/>
  <body name="arm" pos="0 0 .3"><joint name="ball" type="ball"/><geom type="capsule" size=".05 .1"/></body>
</body></worldbody></mujoco>"""


class Shifted(torch.nn.Module):
    """Predictor that returns the states it was made with."""

    def __init__(self, scene, states):
        super().__init__()
        self.scene = scene
        self.register_buffer("states", states)

    def parameters_in(self, trajectories):
        return None

    def rollout(self, state, actions, parameters):
        return self.states, None


def observed(scene, physics) -> torch.Tensor:
    return Simulator(scene).observe(physics)


def test_each_degree_of_freedom_errs_by_what_its_coordinate_is_off():
    scene = load_scene("cheetah")
    rng, size = np.random.default_rng(0), scene.physics_size
    truth = 0.3 * rng.normal(size=(2, 5, size))
    truth[..., 0] = 0
    away = np.zeros((2, 5, size))
    away[:, 1:, 1:] = rng.normal(size=(2, 4, size - 1)) * 0.1
    state, predicted = observed(scene, truth), observed(scene, truth + away)
    data = TensorDict({"state": state, "action": torch.zeros(2, 4, scene.num_actions)}, [2])
    errors = joint_errors(Shifted(scene, predicted), data)
    nv = scene.model.nv
    expected = torch.from_numpy(away[:, 1:, 1:]).square().mean((0, 1))
    torch.testing.assert_close(errors.coordinate, expected[:nv], rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(errors.rate, expected[nv:], rtol=1e-6, atol=1e-12)
    assert errors.names == scene.joint_names and errors.units[:3] == ("m", "m", "rad")
    assert errors.mean_square == pytest.approx(expected.mean().item())
    metrics = errors.to_metrics()
    assert metrics["joint_error/bfoot"] == pytest.approx(math.sqrt(expected[5].item()))
    assert f"{metrics['joint_rate_error/rootx']:.3g} m/s" in str(errors)


def test_a_whole_turn_is_no_error(scenes):
    scene = scenes["pendulum"]
    truth = np.zeros((1, 2, scene.physics_size))
    truth[..., 1] = math.pi - 0.01
    turned = truth.copy()
    turned[:, 1, 1] = -math.pi + 0.02  # 0.03 further
    data = TensorDict({"state": observed(scene, truth), "action": torch.zeros(1, 1, 1)}, [1])
    errors = joint_errors(Shifted(scene, observed(scene, turned)), data)
    assert errors.coordinate.sqrt().tolist() == pytest.approx([0.03])


def test_free_joints_and_balls_err_by_rotation_vectors():
    scene = load_scene(FREE)
    truth = np.zeros((1, 2, scene.physics_size))
    truth[..., 1:4], truth[..., 4], truth[..., 8] = (0.1, 0.2, 1.0), 1, 1
    other = truth.copy()
    other[:, 1, 1] += 0.5
    other[:, 1, 4:8] = -math.cos(0.1), 0, 0, -math.sin(0.1)  # 0.2 rad about z, with the other sign
    other[:, 1, 8:12] = math.cos(0.15), math.sin(0.15), 0, 0
    other[:, 1, 12 + 4] = 0.7  # angular velocity of the box
    data = TensorDict({"state": observed(scene, truth), "action": torch.zeros(1, 1, 0)}, [1])
    errors = joint_errors(Shifted(scene, observed(scene, other)), data)
    assert errors.names == (*(f"root[{index}]" for index in range(6)), *(f"ball[{index}]" for index in range(3)))
    assert errors.coordinate.sqrt().tolist() == pytest.approx([0.5, 0, 0, 0, 0, 0.2, 0.3, 0, 0], abs=1e-7)
    assert errors.rate.sqrt().tolist()[4] == pytest.approx(0.7)


def test_what_diverges_errs_infinitely_and_models_are_measured(make_model, random_states):
    scene = load_scene("acrobot")
    model: ForwardModel = make_model(scene)
    state = random_states(scene, 3, 1).expand(3, 5, -1, -1).clone()
    data = TensorDict({"state": state, "action": torch.zeros(3, 4, 1, dtype=torch.float64)}, [3])
    assert 0 < joint_errors(model.bind(scene), data).mean_square < math.inf
    bad = state.clone()
    bad[1, 3] = math.nan
    assert joint_errors(Shifted(scene, bad), data).coordinate.tolist() == [math.inf] * 2


def test_variants_are_predicted_with_their_own_parameters(scenes, make_model):
    """Joints' and poses' errors; models that read no parameters refuse variants."""
    scene, variants = scenes["pendulum"], sample_variants("pendulum", 3, rng=0)
    data = collect_trajectories(variants, 3, steps=5)
    model = make_model(scene)
    bound = model.bind(scene, parameters_key="parameters")
    predicted = bound.rollout(data["state"][:, 0], data["action"], data["parameters"])[0]
    found, expected = joint_errors(bound, data), joint_errors(Shifted(scene, predicted), data)
    torch.testing.assert_close(found[2:], expected[2:])
    turned = quaternion.angle(predicted[:, 1:, 1, 3:7], data["state"][:, 1:, 1, 3:7]).mean(1)
    for predictor in (bound, specialize(bound)):
        torch.testing.assert_close(pose_errors(predictor, data).rotation, turned, rtol=1e-4, atol=0)
    for measure in (joint_errors, pose_errors):
        with pytest.raises(ValueError, match="other parameters"):
            measure(model.bind(scene), data)
        with pytest.raises(KeyError, match="physical parameters"):
            measure(bound, data.exclude("parameters"))


def test_models_in_training_mode_are_measured_without_dropout():
    scene = load_scene("pendulum")
    model = load_pretrained("pendulum").model
    for mlp in (model.core.first.edge_mlp, model.core.second.node_mlp):
        mlp[1] = torch.nn.Sequential(mlp[1], torch.nn.Dropout(0.5))
    ensemble, data = Ensemble([model, load_pretrained("pendulum").model]), collect_trajectories(scene, 4, 6, seed=0)
    measured = []
    for training in (True, False):
        bound, members = model.train(training).bind(scene), ensemble.train(training).bind(scene)
        calibrate(members, data)
        found = joint_errors(bound, data).mean_square, pose_errors(bound, data).rotation.mean().item()
        measured.append((*found, members.calibration.factor.sum().item()))
        assert all(each.training == training for each in (*bound.model.modules(), *ensemble.modules()))
    assert measured[0] == measured[1]
