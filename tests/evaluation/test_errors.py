"""Errors against hand-written loops and exact values."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.evaluation import evaluate_errors, fresh_errors, squared_errors
from torchrl_gn.maths import joint_layout

from .conftest import as_model, random_states, random_trajectories

COMPONENTS = ["position", "orientation", "linear_velocity", "angular_velocity"]


def replay(trajectories, scene):
    """The perfect model: looks the state up in the trajectories."""
    states = trajectories["state"]

    def step(state, action):
        distance = (states[:, :-1].unsqueeze(0) - state[:, None, None]).abs().amax((-1, -2))
        index = distance.flatten(1).argmin(1)
        return states[:, 1:].flatten(0, 1)[index]

    return as_model(step, scene)


def hand_squared(p, q):
    """[N, 13] against [N, 13] -> [N, 4], with the rotation angle from the trace of the matrix."""
    w = (
        np.abs((p[:, 3:7] * q[:, 3:7]).sum(-1))
        / np.linalg.norm(p[:, 3:7], axis=-1)
        / np.linalg.norm(q[:, 3:7], axis=-1)
    )
    angle = 2 * np.arccos(np.clip(w, 0, 1))
    parts = [((p - q)[:, c] ** 2).sum(-1) for c in (slice(0, 3), slice(7, 10), slice(10, 13))]
    return np.stack((parts[0], angle**2, parts[1], parts[2]), axis=-1)


def test_errors_of_angles_are_the_shorter_way_round():
    angles = torch.tensor([[0.1, 3.0, -2.0], [0.4, -3.0, 2.5]], dtype=torch.float64)
    first, second = torch.stack((3 * angles.cos(), 3 * angles.sin(), angles), -1)  # of any length
    turned = torch.tensor([0.3, 2 * math.pi - 6, 2 * math.pi - 4.5], dtype=torch.float64)
    expected = torch.stack((turned, angles[1] - angles[0]), -1).square()
    torch.testing.assert_close(squared_errors(first, second, joint_layout()), expected)


def test_errors_equal_a_plain_loop(scenes):
    scene = scenes["swimmer6"]
    trajectories = random_trajectories(scene, 5, 6)

    def step(state, action):
        drift = torch.roll(state, 1, dims=-2) * 0.3 + 0.7 * state  # also leaves quaternions unnormalised
        return drift + 0.01 * action.sum(-1)[:, None, None]

    table = evaluate_errors(as_model(step, scene), trajectories, horizons=(3, 6), batch_size=7)

    states, actions = trajectories["state"].numpy(), trajectories["action"]
    moving = scene.predicted

    def next_state(state, action):
        return step(torch.as_tensor(state)[None], action[None])[0].numpy()

    model, constant = [], []
    for m in range(5):
        for t in range(6):
            prediction = next_state(states[m, t], actions[m, t])
            model.append(hand_squared(prediction[moving], states[m, t + 1][moving]))
            constant.append(hand_squared(states[m, t][moving], states[m, t + 1][moving]))
    expected = np.mean(model, axis=(0, 1)) / np.mean(constant, axis=(0, 1))
    for index, name in enumerate(COMPONENTS):
        assert table["one_step_error"].components[name] == pytest.approx(expected[index], rel=1e-9)
    assert table["one_step_error"].total == pytest.approx(expected.mean(), rel=1e-9)

    for horizon in (3, 6):
        model, constant = [], []
        for m in range(5):
            current = states[m, 0]
            for t in range(horizon):
                current = next_state(current, actions[m, t])
                model.append(hand_squared(current[moving], states[m, t + 1][moving]))
                constant.append(hand_squared(states[m, 0][moving], states[m, t + 1][moving]))
        error = table[f"rollout_error_{horizon}"]
        expected = np.mean(model, axis=(0, 1)) / np.mean(constant, axis=(0, 1))
        assert [error.components[name] for name in COMPONENTS] == pytest.approx(list(expected), rel=1e-9)
        assert list(error.baselines.values()) == pytest.approx(list(np.mean(constant, axis=(0, 1))), rel=1e-9)
        assert list(error.squared.values()) == pytest.approx(list(np.mean(model, axis=(0, 1))), rel=1e-9)


@pytest.mark.parametrize("name", ["swimmer6", "cheetah"])
def test_the_persistence_baseline_is_exactly_one(scenes, name):
    model = as_model(lambda state, action: state.clone(), scenes[name])
    table = evaluate_errors(model, random_trajectories(scenes[name], 7, 9), horizons=(4, 9), batch_size=5)
    for error in table.errors.values():
        assert error.components == dict.fromkeys(COMPONENTS, 1.0)
        assert error.total == 1.0
        assert error.diverged == 0


def test_perfect_prediction_is_exactly_zero_also_with_flipped_quaternions(scenes):
    scene = scenes["cheetah"]
    trajectories = random_trajectories(scene, 4, 5)
    perfect = replay(trajectories, scene)
    flipped = trajectories.clone()
    flipped["state"][:, 2::2, :, 3:7] *= -1  # the same rotations
    for data in (trajectories, flipped):
        table = evaluate_errors(perfect, data, horizons=(5,))
        if data is trajectories:
            assert all(error.total == 0.0 for error in table.errors.values())
        else:
            # One-step inputs with flipped signs are not looked up; rollouts start at state 0.
            assert table["rollout_error_5"].total == 0.0


def test_quaternion_sign_and_norm_do_not_matter(scenes):
    state = random_states(scenes["cheetah"], 50)
    other = state.clone()
    other[..., 3:7] *= -1
    assert squared_errors(other, state).abs().max() == 0
    other[..., 3:7] *= 3
    assert squared_errors(other, state)[..., 1].max() < 1e-30


def test_orientation_error_keeps_its_digits_for_tiny_and_large_angles():
    for angle in (1e-9, 1e-4, 1.0, math.pi - 1e-6, math.pi):
        a, b = torch.zeros(2, 13, dtype=torch.float64)
        a[3] = 1
        b[3], b[5] = math.cos(angle / 2), math.sin(angle / 2)
        assert squared_errors(b, a)[1].item() == pytest.approx(angle**2, rel=1e-8)


def test_components_that_never_move_are_left_out_and_named(scenes):
    scene = scenes["pendulum"]
    trajectories = random_trajectories(scene, 6, 4)
    # Left out because the joint cannot move it, even if the simulator's rounding does.
    trajectories["state"][..., 7:10] = 1e-9 * torch.randn(6, 5, scene.num_nodes, 3)
    model = as_model(lambda state, action: state + 0.0, scene)
    table = evaluate_errors(model, trajectories, horizons=(4,))
    error = table["rollout_error_4"]
    assert error.left_out == ("position", "linear_velocity")
    assert set(error.components) == {"orientation", "angular_velocity"}
    assert error.total == 1.0
    metrics = table.to_metrics()
    assert metrics["rollout_error_4/left_out/position"] == 1.0
    assert "rollout_error_4/position" not in metrics
    assert "left out" in table.to_table()


def test_rounding_noise_is_not_motion(scenes):
    scene = scenes["cheetah"]
    trajectories = random_trajectories(scene, 3, 4)
    trajectories["state"][..., :3] = 1 + 1e-15 * torch.rand(3, 5, scene.num_nodes, 3)
    table = evaluate_errors(as_model(lambda s, a: s * 1, scene), trajectories, horizons=())
    assert table["one_step_error"].left_out == ("position",)


@pytest.mark.parametrize("bad", ["nan", "inf", "huge", "zero quaternion"])
def test_divergence_is_counted_and_infinite_only_from_where_it_happens(scenes, bad):
    scene = scenes["swimmer6"]
    trajectories = random_trajectories(scene, 6, 8)
    trajectories["action"][:] = 0
    trajectories["action"][[1, 4], 5] = 1  # these two diverge in step 6
    calls = []

    def step(state, action):
        calls.append(len(state))
        assert state.isfinite().all()  # bad states are not fed back
        broken = state.clone()
        if bad == "zero quaternion":
            broken[..., 3:7] = 0
        else:
            broken[:, 2, 8] = {"nan": math.nan, "inf": math.inf, "huge": 1e200}[bad]
        return torch.where(action.any(-1)[:, None, None], broken, state)

    table = evaluate_errors(as_model(step, scene), trajectories, horizons=(5, 8), keep=3)
    assert table["one_step_error"].diverged == 2
    assert table["rollout_error_5"].total == 1.0
    assert table["rollout_error_5"].diverged == 0
    error = table["rollout_error_8"]
    assert error.diverged == 2 and error.total == math.inf
    assert not any(math.isnan(value) for value in table.to_metrics().values())
    assert "rollout_error_8: 2 of 6 sequences diverged" in str(table)
    assert table.rollouts[0].isfinite().all() and table.rollouts[1, :6].isfinite().all()
    assert table.rollouts[1, 6:].isnan().all()


def test_no_time_is_spent_once_all_have_diverged(scenes):
    scene = scenes["swimmer6"]
    calls = []

    def step(state, action):
        calls.append(1)
        return state * math.nan

    table = evaluate_errors(as_model(step, scene), random_trajectories(scene, 3, 50), horizons=(50,))
    assert table["rollout_error_50"].diverged == 3
    assert len(calls) == 2  # one for one-step errors, one step of the rollout


def test_result_does_not_depend_on_batches_and_models_stay_as_they_were(scenes):
    scene = scenes["cheetah"]
    trajectories = random_trajectories(scene, 11, 4)
    model = as_model(torch.nn.Bilinear(1, 1, 1), scene)
    model.module = torch.nn.Module()
    model.module.forward = lambda state, action: 0.9 * state
    model.train()
    tables = [evaluate_errors(model, trajectories, horizons=(4,), batch_size=size, keep=6) for size in (1, 3, 1000)]
    assert model.training and model.module.training
    for table in tables[1:]:
        for name, value in tables[0].to_metrics().items():
            assert table.to_metrics()[name] == pytest.approx(value, rel=1e-12)
        torch.testing.assert_close(table.rollouts, tables[0].rollouts)
    assert tables[0].rollouts.shape == (6, 5, scene.num_nodes, 13)
    assert not tables[0].rollouts.requires_grad


def test_metrics_are_plain_numbers_and_memory_mapped_data_works(scenes, tmp_path):
    scene = scenes["cheetah"]
    trajectories = random_trajectories(scene, 3, 4)
    trajectories = trajectories.memmap(tmp_path / "data")
    table = evaluate_errors(as_model(lambda s, a: s * 1, scene), trajectories, horizons=(2,))
    metrics = json.loads(json.dumps(table.to_metrics()))
    assert metrics["one_step_error"] == metrics["rollout_error_2/orientation"] == 1.0
    assert all(type(value) is float for value in metrics.values())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: TensorDict({"state": d["state"]}, [3]), "action"),
        (lambda d: TensorDict({"state": d["state"][..., :12], "action": d["action"]}, [3]), "must be"),
        (lambda d: TensorDict({"state": d["state"], "action": d["action"][:, 1:]}, [3]), "Actions must be"),
        (lambda d: TensorDict({"state": d["state"], "action": d["action"][..., :1]}, [3]), "Actions must be"),
        (
            lambda d: TensorDict({"state": d["state"][:, :4], "action": d["action"][:, :3]}, [3]),
            "5 steps needs",
        ),
        (lambda d: d[:0], "at least one sequence"),
        (lambda d: d.apply(lambda x: x * math.nan), "Trajectory 0"),
        (lambda d: TensorDict({"state": d["state"] * 0, "action": d["action"]}, [3]), "zero quaternion"),
        (lambda d: d.apply(lambda x: x[:, :1].expand_as(x)), "Nothing moves"),
    ],
)
def test_bad_trajectories_are_refused(scenes, change, message):
    scene = scenes["cheetah"]
    with pytest.raises(ValueError, match=message):
        evaluate_errors(as_model(lambda s, a: s * 1, scene), change(random_trajectories(scene, 3, 5)), horizons=(5,))


def test_fresh_trajectories_too_short_are_refused_before_they_are_made(swimmer):
    with pytest.raises(ValueError, match="length=99 is too short: errors are measured over rollouts of 100 steps"):
        fresh_errors(swimmer.model, swimmer.scene, sequences=1, length=99, seed=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_model_on_a_gpu_is_measured_there(swimmer, simulated):
    here = evaluate_errors(swimmer, simulated, horizons=(5,))
    there = evaluate_errors(swimmer.cuda(), simulated, horizons=(5,), keep=1)
    assert there["rollout_error_5"].total == pytest.approx(here["rollout_error_5"].total, rel=1e-6)
    assert there.rollouts.device == simulated["state"].device


def test_only_what_is_asked_for_is_predicted(scenes):
    scene = scenes["pendulum"]
    trajectories = random_trajectories(scene, 3, 6)
    states: list[int] = []
    model = as_model(lambda s, a: (states.append(s[..., 0, 0].numel()), s * 1)[1], scene)
    table = evaluate_errors(model, trajectories, horizons=(4,), one_step=False)
    assert list(table.to_metrics())[0].startswith("rollout_error_4") and sum(states) == 3 * 4
    both = evaluate_errors(model, trajectories, horizons=(4,))
    assert both["rollout_error_4"].total == table["rollout_error_4"].total
