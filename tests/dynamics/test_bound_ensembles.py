"""Ensembles: joint predictions of the members, and checkpoints."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.dynamics import BoundEnsemble, Ensemble, ForwardModel, specialize
from torchrl_gn.dynamics.ensemble import mean_and_spread
from torchrl_gn.envs import ModelEnv
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.training import CheckpointError, load_pretrained, save_checkpoint

from ..sizes import SMALL

COUNT, BATCH, STEPS = 3, 4, 2


@pytest.fixture
def make_ensemble(scenes, make_model):
    def make(name: str = "cheetah") -> Ensemble:
        return Ensemble([make_model(scenes[name], seed=seed) for seed in range(COUNT)])

    return make


def calibrated(ensemble: Ensemble, steps: int = 1) -> Ensemble:
    """Calibrate an ensemble with factors of 2, 3, ... and floors of 0.01."""
    count = len(BODY_STATE.names)
    factor = torch.arange(2.0, 2 + steps).unsqueeze(-1).expand(-1, count)
    ensemble.calibration.set(factor, torch.full((steps, count), 0.01), torch.ones(count))
    return ensemble


def test_calibrations_of_any_number_of_steps_are_loaded_with_the_weights(make_ensemble):
    fitted, plain, longer = calibrated(make_ensemble(), 2), make_ensemble(), calibrated(make_ensemble(), 5)
    for target in (plain, longer):
        target.load_state_dict(fitted.state_dict())
        for name, value in fitted.state_dict().items():
            torch.testing.assert_close(target.state_dict()[name], value, rtol=0, atol=0)
    fitted.load_state_dict(make_ensemble().state_dict())
    assert not fitted.calibration.fitted  # other weights, without a calibration of their own
    with pytest.raises(RuntimeError, match="calibration.factor"):
        plain.load_state_dict(plain.state_dict() | {"calibration.factor": torch.zeros(2, 9)})


def test_a_prediction_of_no_step_is_the_start(scenes, make_ensemble):
    bound = calibrated(make_ensemble()).bind(scenes["cheetah"])
    state = bound.members[0].reference_state.double().expand(2, -1, -1)
    prediction = bound.predict(state, torch.zeros(2, 0, 6, dtype=torch.float64))
    torch.testing.assert_close(prediction.mean[:, 0], state)
    assert prediction.std.shape == (2, 1, *prediction.std.shape[2:]) and not prediction.std.any()


def test_members_about_a_mean():
    generator = torch.Generator().manual_seed(0)
    states = torch.randn(6, 5, 13, dtype=torch.float64, generator=generator)
    states[..., 3:7] = quaternion.normalize(states[..., 3:7])
    change = 0.3 * torch.randn(2000, 6, 5, 12, dtype=torch.float64, generator=generator)
    members = BODY_STATE.apply(states.expand(2000, -1, -1, -1), change)
    members[:, ..., 3:7] *= torch.where(torch.rand(2000, 6, 5, 1, generator=generator) < 0.5, -1.0, 1.0)  # q and -q
    mean, spread = mean_and_spread(members, BODY_STATE)
    assert BODY_STATE.delta(states, mean).abs().max() < 0.05
    torch.testing.assert_close(spread, torch.full_like(spread, 0.3), rtol=0.1, atol=0)


def test_members_that_are_not_finite_make_the_spread_infinite():
    members = torch.zeros(3, 4, 2, 13, dtype=torch.float64)
    members[..., 3], members[..., 0] = 1.0, torch.tensor([1.0, 2.0, 6.0]).view(3, 1, 1)
    members[2, 1, 0, 8], members[:, 2, 1, 0] = torch.nan, torch.inf
    mean, spread = mean_and_spread(members, BODY_STATE)
    torch.testing.assert_close(mean[..., 0][[0, 3]], torch.full((2, 2), 3.0).double())
    torch.testing.assert_close(spread[[0, 3]][..., 0], torch.full((2, 2), 7.0).double().sqrt())
    assert (mean[1, :, 0] == 1.5).all() and spread[1].isinf().all()
    assert spread[2].isinf().all() and mean[2].isnan().all()


def test_it_predicts_the_members_and_how_far_off_they_may_be(scenes, make_ensemble, random_states, random_actions):
    scene, ensemble = scenes["cheetah"], calibrated(make_ensemble(), STEPS)
    bound = ensemble.bind(scene)
    state, actions = random_states(scene, BATCH), torch.stack([random_actions(scene, BATCH)] * (STEPS + 1), 1)
    mean, std, members = bound.predict(state, actions)
    expected = torch.stack([model.bind(scene).rollout(state, actions)[0] for model in ensemble.models])
    torch.testing.assert_close(members, expected)
    torch.testing.assert_close(bound.step(state, actions[:, 0]), expected[:, :, 1])
    wanted_mean, spread = mean_and_spread(expected, scene.layout)
    torch.testing.assert_close(mean, wanted_mean)
    assert not std[:, 0].any()
    factors = torch.tensor([2.0, 3.0, 3.0]).view(-1, 1, 1)  # the last holds for all further steps
    moves = torch.as_tensor(scene.movable)
    torch.testing.assert_close(std[:, 1:], factors * (spread[:, 1:].square() + 1e-4).sqrt() * moves)
    entries = bound(TensorDict({"state": state, "action": actions[:, 0]}, [BATCH]))
    torch.testing.assert_close(entries["next", "state"], mean[:, 1])
    torch.testing.assert_close(entries["next", "state_std"], std[:, 1])


def test_doubt_is_the_expected_error_by_the_usual_one(scenes, make_ensemble, random_states, random_actions):
    scene, ensemble = scenes["cheetah"], calibrated(make_ensemble())
    usual = torch.tensor([0.5, 1.0, 2.0, 0.0])  # the last component counts as fixed
    ensemble.calibration.set(ensemble.calibration.factor, ensemble.calibration.floor, usual)
    bound, state, action = ensemble.bind(scene), random_states(scene, BATCH), random_actions(scene, BATCH)
    std, moves = bound.predict(state, action.unsqueeze(1)).std[:, 1], torch.as_tensor(scene.movable)
    parts = [std[..., where][:, moves[:, where]].square().mean(-1) for where in scene.layout.delta_slices.values()]
    wanted = torch.stack([part / by**2 for part, by in zip(parts[:3], usual, strict=False)]).mean(0).sqrt()
    torch.testing.assert_close(bound.doubt(state, action), wanted)
    state[1, 2, 8] = torch.nan
    assert not bound.doubt(state, action)[1].isfinite() and bound.doubt(state, action)[0].isfinite()


def test_gradients_pass_through_the_mean_and_its_standard_deviation(
    scenes, make_ensemble, random_states, random_actions
):
    scene = scenes["cheetah"]
    bound = calibrated(make_ensemble()).bind(scene)
    action = random_actions(scene, BATCH).requires_grad_()
    mean, std, _ = bound.predict(random_states(scene, BATCH), action.unsqueeze(1))
    for value in (mean, std):
        (gradient,) = torch.autograd.grad(value.sum(), action, retain_graph=True)
        assert gradient.isfinite().all() and gradient.norm() > 0


def test_specialised_members_predict_the_same(scenes, make_ensemble, random_states, random_actions):
    scene = scenes["cheetah"]
    bound = calibrated(make_ensemble()).bind(scene)
    quick = specialize(bound, executor="eager")
    state, actions = random_states(scene, BATCH), random_actions(scene, BATCH).unsqueeze(1)
    assert isinstance(quick, BoundEnsemble)
    for one, other in zip(quick.predict(state, actions), bound.predict(state, actions), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    with pytest.raises(TypeError, match="takes a bound model"):
        specialize(quick)


@pytest.mark.parametrize("native", [False, True])
def test_split_members_predict_their_shares(scenes, make_ensemble, random_states, random_actions, native):
    scene = scenes["cheetah"]
    bound = make_ensemble().bind(scene)
    bound = specialize(bound) if native else bound
    env = ModelEnv(bound).by_member()
    state = random_states(scene, COUNT * BATCH)
    actions = torch.stack([random_actions(scene, COUNT * BATCH, seed=seed) for seed in range(2)], 1)
    found = env.imagine(TensorDict({"state": state}, [len(state)]), actions)[0]
    shares = zip(bound.members, state.chunk(COUNT), actions.chunk(COUNT), strict=True)
    expected = torch.cat([member.rollout(*share)[0] for member, *share in shares])
    assert torch.equal(found, expected)
    stepped = env.step(TensorDict({"state": state, "action": actions[:, 0]}, [len(state)]))
    torch.testing.assert_close(stepped["next", "state"], expected[:, 1], rtol=1e-6, atol=1e-8)
    with pytest.raises(ValueError, match="number of samples, 4, must be a multiple of the 3 members"):
        env.imagine(TensorDict({"state": state[:4]}, [4]), actions[:4])


def test_an_ensemble_refuses_samples_of_another_variant(scenes, make_ensemble, random_states, random_actions):
    scene = scenes["cheetah"]
    bound = make_ensemble().bind(scene)
    other = bound.members[0].own_parameters()
    other["nodes"] = 2 * other["nodes"]
    entries = {"state": random_states(scene, COUNT), "action": random_actions(scene, COUNT)}
    rows = TensorDict({**entries, "parameters": other.expand(COUNT)}, [COUNT])
    for env in (ModelEnv(bound), ModelEnv(bound).by_member()):
        with pytest.raises(ValueError, match="parameters"):
            env.step(rows.clone())
        with pytest.raises(ValueError, match="parameters"):
            env.imagine(rows.exclude("action"), rows["action"].unsqueeze(1))


def test_what_is_not_calibrated_says_so(scenes, make_ensemble, random_states, random_actions):
    scene = scenes["cheetah"]
    with pytest.raises(RuntimeError, match="not calibrated.*calibrate"):
        make_ensemble().bind(scene).predict(random_states(scene), random_actions(scene).unsqueeze(0))


def test_members_must_be_alike(scenes):
    models = [ForwardModel.for_scene(scenes["pendulum"], hidden=hidden) for hidden in (8, 16)]
    with pytest.raises(ValueError, match="same options"):
        Ensemble(models)
    with pytest.raises(ValueError, match="two members or more, not 1"):
        Ensemble(models[:1])
    with pytest.raises(ValueError, match="no hidden state"):
        Ensemble.for_scene(scenes["pendulum"], count=2, core="recurrent", **SMALL).bind(scenes["pendulum"])
    made = Ensemble.for_scene("pendulum", **SMALL)
    first, second = (next(model.core.parameters()) for model in made.models[:2])
    assert len(made.models) == 5 and not torch.equal(first, second)


def test_checkpoints_hold_ensembles(scenes, make_ensemble, random_states, random_actions, tmp_path):
    scene, path = scenes["cheetah"], tmp_path / "ensemble.safetensors"
    ensemble = calibrated(make_ensemble(), STEPS)
    save_checkpoint(path, ensemble, scene=scene)
    checkpoint = load_pretrained(path)
    state, actions = random_states(scene, BATCH), random_actions(scene, BATCH).unsqueeze(1)
    found = checkpoint.ensemble.bind(checkpoint.scene()).predict(state, actions)
    for one, other in zip(found, ensemble.bind(scene).predict(state, actions), strict=True):
        assert torch.equal(one, other)
    with pytest.raises(CheckpointError, match="Ensemble, not ForwardModel"):
        _ = checkpoint.model
    description = ensemble.description()
    assert Ensemble.from_description(description).description() == description
