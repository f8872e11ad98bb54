"""Guarded rollouts: detection of divergence, kept states, and saved work."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.evaluation import evaluate_errors, guarded_rollout, rollout

from .conftest import as_model, random_states

STEPS = 60
# Actions that no network stands: one overflows float64, the other's prediction is finite and absurd.
BAD_ACTIONS = {"not finite": 1e308, "out of range": 1e9}


@pytest.fixture(autouse=True)
def no_limits(swimmer, monkeypatch) -> None:
    """Pass actions on without clamping, so that rollouts can diverge."""
    for name, value in (("action_low", -math.inf), ("action_high", math.inf)):
        limits = torch.full_like(getattr(swimmer.controls, name), value)
        monkeypatch.setitem(swimmer.controls._buffers, name, limits)


@pytest.fixture
def sizes(swimmer, calls) -> list[tuple[int, int]]:
    """Batch sizes and lengths of the rollouts that the model is asked for."""
    return calls(swimmer, "rollout", lambda state, actions, *_: (len(state), actions.shape[-2]))


@pytest.mark.slow
def test_what_does_not_diverge_is_the_rollout(swimmer, simulated, sizes):
    state, actions = simulated["state"][:, 0], simulated["action"]
    expected = swimmer.rollout(state, actions)[0].detach()
    sizes.clear()
    guarded = guarded_rollout(swimmer, state, actions, every=25)
    assert sizes == [(6, 25), (6, 25), (6, 10)]
    torch.testing.assert_close(guarded.states, expected, rtol=0, atol=1e-12)
    assert guarded.good_steps.tolist() == [STEPS] * 6 and not guarded.diverged.any()
    quick = specialize(swimmer)
    torch.testing.assert_close(guarded_rollout(quick, state, actions).states, expected)


@pytest.mark.slow
@pytest.mark.parametrize("bad", BAD_ACTIONS)
def test_what_diverges_keeps_its_last_good_state_and_costs_nothing_more(swimmer, simulated, sizes, bad):
    state, actions = simulated["state"][:, 0], simulated["action"].clone()
    expected = rollout(swimmer, state, actions).detach()
    actions[1, 30] = actions[4, 49] = actions[2, 0] = BAD_ACTIONS[bad]
    sizes.clear()
    guarded = guarded_rollout(swimmer, state, actions, every=25)
    assert guarded.good_steps.tolist() == [STEPS, 30, 0, STEPS, 49, STEPS]
    assert guarded.diverged.tolist() == [False, True, True, False, True, False]
    assert sizes == [(6, 25), (5, 25), (3, 10)]
    for row, good in enumerate(guarded.good_steps.tolist()):
        torch.testing.assert_close(guarded.states[row, : good + 1], expected[row, : good + 1], rtol=0, atol=1e-12)
        assert (guarded.states[row, good:] == guarded.states[row, good]).all()


def test_nothing_is_predicted_once_all_have_diverged(swimmer, simulated, sizes):
    actions = simulated["action"].clone()
    actions[:, 3] = 1e308
    guarded = guarded_rollout(swimmer, simulated["state"][:, 0], actions, every=10)
    assert sizes == [(6, 10)]
    assert guarded.good_steps.tolist() == [3] * 6
    assert guarded.states.isfinite().all()


@pytest.mark.slow
def test_a_compiled_model_keeps_its_batch(swimmer, simulated, sizes):
    swimmer.fixed_batch = True  # every other batch size would be compiled anew
    state, actions = simulated["state"][:, 0], simulated["action"].clone()
    actions[:2, 5] = 1e308
    guarded = guarded_rollout(swimmer, state, actions, every=30)
    assert sizes == [(6, 30), (6, 30)]
    assert guarded.good_steps.tolist() == [5, 5, *[STEPS] * 4]
    actions[2:, 35] = 1e308
    sizes.clear()
    assert guarded_rollout(swimmer, state, actions, every=20).good_steps.tolist() == [5, 5, *[35] * 4]
    assert sizes == [(6, 20), (6, 20)]


@pytest.mark.slow
def test_the_range_is_that_of_the_training(swimmer, simulated):
    state, actions = simulated["state"][:, 0], simulated["action"]
    states = rollout(swimmer, state, actions).detach()
    seen = simulated["state"][:, :-1]
    middle = seen[..., 1:, :3].mean(-2, keepdim=True) * torch.tensor([1.0, 1.0, 0.0])

    def lengths(x, centre):  # of the vectors of [..., N, 13], the world at rest at 0
        moved = torch.cat((x[..., :1, :3], x[..., 1:, :3] - centre), -2)
        return torch.stack([part.norm(dim=-1) for part in (moved, x[..., 7:10], x[..., 10:])])

    usual = lengths(seen, middle).square().mean((1, 2, 3)).sqrt()
    middle = states[:, 1:, 1:, :3].mean(-2, keepdim=True) * torch.tensor([1.0, 1.0, 0.0])
    farthest = (lengths(states[:, 1:], middle).amax(-1) / usual[:, None, None]).amax(0)  # [6, T]
    most = float(farthest.max())
    for limit in (1.000001 * most, 0.999999 * most, 1.000001 * float(farthest.median())):
        expected = (farthest <= limit).long().cumprod(1).sum(1)
        assert guarded_rollout(swimmer, state, actions, limit=limit, every=7).good_steps.tolist() == expected.tolist()


def test_where_an_invariant_scene_is_does_not_matter(swimmer, simulated):
    state = simulated["state"][:, 0].clone()
    state[:, 1:, :2] += 1e9
    assert not guarded_rollout(swimmer, state, simulated["action"]).diverged.any()


def test_before_training_only_finite_numbers_are_asked_for(swimmer, simulated):
    fresh = ForwardModel.for_scene(swimmer.scene, latent=4).bind(swimmer.scene)
    state, actions = 1e30 * simulated["state"][:, 0], simulated["action"]
    assert not guarded_rollout(fresh, state, actions).diverged.any()


@pytest.mark.slow
def test_rollouts_with_parameters_of_their_own(swimmer, simulated, sizes):
    state, actions = simulated["state"][:, 0].clone(), simulated["action"].clone()
    parameters = torch.stack([swimmer.parameters_of(swimmer.scene)] * 6)
    factors = torch.linspace(0.5, 1.5, 6, dtype=torch.float64)[:, None, None]
    parameters = parameters.set("nodes", factors * parameters["nodes"]).set(
        "child_anchor", factors * parameters["child_anchor"]
    )
    expected = swimmer.rollout(state, actions, parameters)[0].detach()
    assert (expected - swimmer.rollout(state, actions)[0]).abs().max() > 1e-3
    actions[1, 30] = 1e308
    guarded = guarded_rollout(swimmer, state, actions, parameters)
    assert guarded.good_steps.tolist() == [STEPS, 30, *[STEPS] * 4]
    rest = torch.arange(6) != 1
    torch.testing.assert_close(guarded.states[rest], expected[rest])
    torch.testing.assert_close(guarded_rollout(swimmer, state, actions, parameters[0]).states[0], expected[0])
    grouped = guarded_rollout(swimmer, state.view(2, 3, 7, 13), actions.view(2, 3, STEPS, 5), parameters.view(2, 3))
    torch.testing.assert_close(grouped.states.flatten(0, 1), guarded.states, rtol=0, atol=1e-12)
    assert grouped.good_steps.tolist() == [[STEPS, 30, STEPS], [STEPS] * 3]


def test_any_module_is_looked_at_after_every_step(scenes):
    scene, calls = scenes["pendulum"], []

    def step(state, action):
        assert state.isfinite().all()
        calls.append(len(state))
        return state / (1 - action).unsqueeze(-1)

    actions = torch.zeros(3, 8, 1, dtype=torch.float64)
    actions[0, 2] = actions[2, 5] = 1
    guarded = guarded_rollout(as_model(step, scene), random_states(scene, 3), actions)
    assert guarded.good_steps.tolist() == [2, 8, 5]
    assert calls == [3, 3, 3, 2, 2, 2, 1, 1]


def test_one_rollout_and_no_steps(swimmer, simulated):
    state, actions = simulated["state"][0, 0], simulated["action"][0]
    guarded = guarded_rollout(swimmer, state, actions[:0])
    assert torch.equal(guarded.states, state[None]) and not guarded.diverged
    actions = actions.clone()
    actions[7] = 1e308
    assert guarded_rollout(swimmer, state, actions).good_steps == 7


@pytest.mark.parametrize("options", [{"limit": 0.0}, {"limit": math.nan}, {"every": 0}])
def test_bad_options_are_named(swimmer, simulated, options):
    name, value = next(iter(options.items()))
    with pytest.raises(ValueError, match=f"{name}={value}"):
        guarded_rollout(swimmer, simulated["state"][:, 0], simulated["action"], **options)


@pytest.mark.slow
def test_errors_count_what_diverged(swimmer, simulated):
    trajectories = simulated.clone()
    clean = evaluate_errors(swimmer, trajectories, horizons=(20, 60))
    assert "diverged" not in str(clean)
    trajectories["action"][2, 30] = 1e9
    table = evaluate_errors(swimmer, trajectories, horizons=(20, 60), keep=3)
    metrics = table.to_metrics()
    assert metrics["rollout_error_20"] == clean.to_metrics()["rollout_error_20"]
    assert [metrics[f"{name}/diverged"] for name in table.errors] == [0.0, 0.0, 1.0]
    assert metrics["rollout_error_60"] == math.inf
    assert "rollout_error_60: 1 of 6 sequences diverged" in str(table)
    assert table.rollouts[2, :31].isfinite().all() and table.rollouts[2, 31:].isnan().all()


def test_errors_of_samples_with_parameters_of_their_own(swimmer, simulated):
    bound = swimmer.model.bind(swimmer.scene, parameters_key="parameters")
    parameters = torch.stack([bound.parameters_of(swimmer.scene)] * 6)
    parameters["child_anchor"][3:] *= 1.5
    own = simulated.clone().set("parameters", parameters)
    table = evaluate_errors(bound, own, horizons=(5,), batch_size=4)
    halves = [evaluate_errors(bound, half, horizons=(5,)) for half in (own[:3], own[3:])]
    for name in table.errors:
        squared = [sum(half[name].squared.values()) for half in halves]
        assert sum(table[name].squared.values()) == pytest.approx(sum(squared) / 2, rel=1e-9)
        assert squared[0] != pytest.approx(squared[1], rel=1e-3)
    with pytest.raises(KeyError, match="physical parameters at 'parameters'"):
        evaluate_errors(bound, simulated, horizons=())
    with pytest.raises(ValueError, match="other parameters 'child_anchor' than scene 'swimmer6'"):
        evaluate_errors(swimmer, own, horizons=())
