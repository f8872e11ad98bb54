"""The forward-model loss: its value, its noise, its windows, its gradients, and TorchRL's contract."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_gn.data import create_dataset, trajectory_buffer
from torchrl_gn.dynamics import BoundPredictor, Canonicalizer, ForwardModel
from torchrl_gn.dynamics.bound import dynamic_graph
from torchrl_gn.dynamics.executors import EagerExecutor
from torchrl_gn.dynamics.program import PreparedStep, StepProgram
from torchrl_gn.evaluation import evaluate_errors
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene

from ..sizes import SMALL

COMPONENTS = BODY_STATE.names


@pytest.fixture
def predict(monkeypatch) -> Callable[[Callable], list[Tensor]]:
    """Make models predict ``delta(state, action)``; the list collects the states they are fed."""

    def predict(delta: Callable) -> list[Tensor]:
        fed: list[Tensor] = []

        class Stub(EagerExecutor):
            def delta(self, program: StepProgram, state: Tensor, action: Tensor, hidden: None) -> tuple[Tensor, None]:
                fed.append(state)
                return delta(state, action) * program.movable, hidden

        def prepared(self: BoundPredictor, parameters: TensorDictBase | None) -> PreparedStep:
            program = self.program(parameters)
            return PreparedStep(Stub(program), program)

        monkeypatch.setattr(BoundPredictor, "prepared_for_training", prepared)
        return fed

    return predict


def unit_scale(loss: ForwardModelLoss) -> None:
    """Weigh every channel by one."""
    normalizer = loss.model.model.delta_normalizer
    one = torch.ones(12, dtype=torch.float64)
    normalizer.load_state_dict({"count": one, "mean": 0 * one, "m2": one})
    loss.error_weight.fill_(-1)


def by_hand(loss: ForwardModelLoss, delta: Tensor, target: Tensor) -> dict[str, Tensor]:
    """Mean squared error of each component, in units of its change's spread, over movable channels."""
    normalizer, movable = loss.model.model.delta_normalizer, loss.model.movable
    errors = {}
    for name in COMPONENTS:
        where = BODY_STATE.delta_slices[name]
        difference = delta[..., where] - target[..., where]
        if name == "orientation":
            expected, predicted = quaternion.exp(target[..., where]), quaternion.exp(delta[..., where])
            difference = 2 * quaternion.product(quaternion.conjugate(expected), predicted)[..., 1:]
        counts = (movable & ~normalizer.constant)[:, where]
        scaled = (difference * normalizer.inverse_std[where])[..., counts]
        errors[name] = scaled.square().mean() if counts.any() else torch.zeros((), dtype=torch.float64)
    return errors


@pytest.mark.slow
def test_a_fitted_loss_loads_into_a_fresh_one(make_loss, windows):
    loss, fresh = make_loss(noise=0.1), make_loss(fitted=False, noise=0.1)
    fresh.load_state_dict({name: value.clone() for name, value in loss.state_dict().items()})
    values = []
    for each in (loss, fresh):
        torch.manual_seed(0)
        values.append(each(windows["swimmer6"])["loss_forward_model"])
    assert torch.equal(*values)
    unfitted = make_loss(fitted=False)
    fresh.load_training_state(unfitted.training_state())
    fresh.load_training_state({**unfitted.training_state(), "error_weight": None})  # as of older files
    assert torch.equal(fresh.error_weight, unfitted.error_weight)


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "falling"])
def test_perfect_predictions_cost_nothing(make_loss, windows, name):
    loss = make_loss(name)
    batch = windows[name].reshape(-1)
    batch = TensorDict({"state": batch["state"], "action": batch["action"]}, batch.batch_size)
    batch["next", "state"] = loss.model.step(batch["state"], batch["action"])[0].detach()
    assert loss(batch)["loss_forward_model"] < 1e-24


@pytest.mark.parametrize("name", ["pendulum", "swimmer6", "falling"])
def test_the_value_is_the_mean_over_components_of_scaled_errors(make_loss, windows, name):
    loss = make_loss(name)
    batch = windows[name].reshape(-1)
    out = loss(batch)
    delta = loss.model.delta(batch["state"], batch["action"])
    expected = by_hand(loss, delta, BODY_STATE.delta(batch["state"], batch["next", "state"]))
    for component, error in expected.items():
        torch.testing.assert_close(out[f"error_{component}"], error.detach(), rtol=1e-12, atol=0)
    movable = [error for error in expected.values() if error > 0]
    assert len(movable) == (2 if name == "pendulum" else 4)  # the pendulum's body frame never moves
    torch.testing.assert_close(out["loss_forward_model"], sum(movable) / len(movable), rtol=1e-12, atol=0)


def test_predicting_the_mean_change_costs_one(make_loss, windows, predict):
    """Errors are in units of the change's own variance, whatever the component."""
    loss = make_loss("falling")
    normalizer = loss.model.model.delta_normalizer
    predict(lambda state, action: normalizer.mean.expand(*state.shape[:-1], 12))
    out = loss(windows["falling"].reshape(-1))
    for component in COMPONENTS:
        # Rotation vectors of 0.1 rad are the difference only to third order.
        assert out[f"error_{component}"].item() == pytest.approx(1, rel=2e-2 if component == "orientation" else 1e-10)


@pytest.mark.parametrize("angle", [0.1, 1.0, 3.0])
def test_the_orientation_error_is_the_papers_corrected_formula(make_loss, angle, predict):
    """``4 (1 - (q_e . q_p)^2)``, spread over three channels, for moderate rotations in float64."""
    loss = make_loss("falling")
    unit_scale(loss)
    generator = torch.Generator().manual_seed(1)
    state, turn = torch.randn(2, 50, 2, 4, generator=generator, dtype=torch.float64)
    state = torch.cat((torch.zeros(50, 2, 3), quaternion.normalize(state), torch.zeros(50, 2, 6)), -1)
    state[:, 0, 3:7] = torch.tensor([1.0, 0, 0, 0])
    change = torch.zeros(50, 2, 12, dtype=torch.float64)
    change[:, 1, 3:6] = angle * turn[:, 1, 1:] / turn[:, 1, 1:].norm(dim=-1, keepdim=True)
    truth, guess = BODY_STATE.apply(state, change), BODY_STATE.apply(state, change.roll(1, 0))
    predict(lambda state, action: change.roll(1, 0))
    batch = TensorDict({"state": state, "action": torch.zeros(50, 0), "next": {"state": truth}}, [50])
    cosine = (truth[:, 1, 3:7] * guess[:, 1, 3:7]).sum(-1)
    expected = (4 * (1 - cosine.square()) / 3).mean()
    torch.testing.assert_close(loss(batch)["error_orientation"], expected, rtol=1e-11, atol=0)


def test_tiny_rotations_keep_their_digits_in_float32(make_loss, predict):
    """1e-6 rad a step, where ``1 - (q_e . q_p)^2`` is exactly 0 in float32."""
    loss = make_loss("falling")
    unit_scale(loss)
    generator = torch.Generator().manual_seed(1)
    true, guess = 1e-6 * torch.randn(2, 50, 2, 12, generator=generator, dtype=torch.float64)
    true[:, 0], guess[:, 0] = 0, 0
    state = torch.zeros(50, 2, 13, dtype=torch.float64)
    state[..., 3] = 1
    errors = {}
    for dtype in (torch.float64, torch.float32):
        predict(lambda state, action: guess.to(dtype))  # noqa: B023
        after = BODY_STATE.apply(state, true).to(dtype)
        batch = TensorDict({"state": state.to(dtype), "action": torch.zeros(50, 0), "next": {"state": after}}, [50])
        errors[dtype] = loss(batch)["error_orientation"]
    naive = 1 - (BODY_STATE.apply(state, true).float() * BODY_STATE.apply(state, guess).float())[..., 3:7].sum(-1) ** 2
    assert naive.abs().max() == 0
    expected = (true - guess)[:, 1, 3:6].square().mean()
    torch.testing.assert_close(errors[torch.float64], expected, rtol=1e-9, atol=0)
    assert abs(errors[torch.float32] / errors[torch.float64] - 1) < 1e-5


@pytest.mark.slow
def test_float64_states_give_a_float32_network_its_full_precision(make_loss, windows):
    batch = windows["swimmer6"].reshape(-1)
    exact = make_loss()
    quick = make_loss()
    quick.model.model.float()
    torch.testing.assert_close(
        quick(batch)["loss_forward_model"], exact(batch)["loss_forward_model"], rtol=1e-5, atol=0
    )


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_windows_feed_the_model_its_own_predictions(make_loss, windows, noise):
    generator = torch.Generator()
    loss = make_loss("swimmer6", noise=noise, generator=generator)
    batch = windows["swimmer6"]
    generator.manual_seed(3)
    out = loss(batch)
    generator.manual_seed(3)
    current, total = loss.perturb(batch["state"][:, 0]), 0.0
    for step in range(batch.shape[1]):
        delta = loss.model.delta(current, batch["action"][:, step])
        target = BODY_STATE.delta(current, batch["next", "state"][:, step])
        total = total + sum(by_hand(loss, delta, target).values()) / 4
        current, _ = loss.model.step(current, batch["action"][:, step])
    torch.testing.assert_close(out["loss_forward_model"], total / batch.shape[1], rtol=1e-12, atol=0)


def test_states_and_next_states_may_have_different_dtypes(make_loss, windows):
    loss, batch = make_loss("pendulum"), windows["pendulum"]
    expected = loss(batch)["loss_forward_model"]
    for key in ("state", ("next", "state")):
        mixed = batch.clone().set(key, batch[key].float())
        torch.testing.assert_close(loss(mixed)["loss_forward_model"], expected, rtol=1e-3, atol=0, check_dtype=False)
        loss.fit_scales(mixed.reshape(-1))


@pytest.mark.parametrize("options", [{}, {"core": "recurrent", "hidden_state": [4, 4, 4]}])
def test_batches_of_inference_mode_train(make_loss, windows, options):
    """Episodes played and windows drawn in inference mode stopped the gradient."""
    loss, batch = make_loss("pendulum", model=options), windows["pendulum"]
    with torch.inference_mode():
        inferred = batch.clone()
        without = loss(inferred)["loss_forward_model"]
        loss.model.step(inferred["state"], inferred["action"])
    action = batch["action"].clone().requires_grad_()
    loss.model.step(batch["state"], action)[0].sum().backward()  # what the model keeps serves gradients, too
    for given in (inferred, inferred.reshape(-1)) if not options else (inferred,):
        loss(given)["loss_forward_model"].backward()
    assert all(weight.grad is not None for weight in loss.trained.core.parameters() if weight.numel())
    torch.testing.assert_close(loss(inferred)["loss_forward_model"].detach(), without.clone())


def test_a_window_of_one_step_is_a_transition(make_loss, windows):
    loss = make_loss()
    batch = windows["swimmer6"][:, :1]
    window, transition = (loss(each)["loss_forward_model"] for each in (batch, batch.squeeze(1)))
    torch.testing.assert_close(window, transition, rtol=1e-12, atol=0)


def test_gradients_flow_through_the_whole_window(make_loss, windows):
    loss = make_loss()
    batch = windows["swimmer6"][:5, :3].clone()
    names, weights = zip(*loss.model.model.core.named_parameters(), strict=True)

    def value(*values: Tensor) -> Tensor:
        with torch.no_grad():
            for parameter, new in zip(weights, values, strict=True):
                parameter.copy_(new)
        return loss(batch)["loss_forward_model"]

    analytic = torch.autograd.grad(value(*[w.detach().clone() for w in weights]), weights)
    start = [w.detach().clone() for w in weights]
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        direction = [torch.randn(w.shape, generator=generator, dtype=w.dtype) for w in start]
        slope = sum((g * d).sum() for g, d in zip(analytic, direction, strict=True))
        step = 1e-6
        ahead, behind = (
            value(*[w + sign * step * d for w, d in zip(start, direction, strict=True)]).detach() for sign in (1, -1)
        )
        torch.testing.assert_close((ahead - behind) / (2 * step), slope, rtol=1e-5, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_truncated_gradients_are_those_of_pieces_of_the_window(make_loss, windows, steps):
    whole, truncated = make_loss(), make_loss(bptt_steps=steps)
    batch = windows["swimmer6"][:5, :3].clone()
    value = truncated(batch)["loss_forward_model"]
    torch.testing.assert_close(value, whole(batch)["loss_forward_model"], rtol=1e-12, atol=0)
    value.backward()
    current = batch["state"][:, 0]
    for start in range(0, 3, steps):  # pieces that start at the window's own predictions, each by itself
        piece = batch[:, start : start + steps].clone()
        piece["state"][:, 0] = current
        (whole(piece)["loss_forward_model"] * piece.shape[1] / 3).backward()
        for step in range(piece.shape[1]):
            current = whole.model.step(current, piece["action"][:, step])[0].detach()
    for ours, theirs in zip(truncated.parameters(), whole.parameters(), strict=True):
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-9, atol=1e-12)


def test_truncation_needs_a_step(make_loss):
    with pytest.raises(ValueError, match="bptt_steps=0"):
        make_loss(bptt_steps=0)


def test_backward_reaches_every_weight_of_the_core(make_loss, windows):
    loss = make_loss()
    loss(windows["swimmer6"].reshape(-1))["loss_forward_model"].backward()
    named = dict(loss.named_parameters())
    assert set(named) == {f"model.model.core.{name}" for name, _ in loss.model.model.core.named_parameters()}
    for name, parameter in named.items():
        assert parameter.grad is not None and parameter.grad.isfinite().all() and parameter.grad.abs().sum() > 0, name


def test_noise_has_the_size_of_each_channels_spread(make_loss, windows, predict):
    generator = torch.Generator().manual_seed(0)
    loss = make_loss("swimmer6", noise=0.1, generator=generator)
    batch = windows["swimmer6"].reshape(-1)[:1].expand(20000).contiguous()
    fed = predict(lambda state, action: state.new_zeros(*state.shape[:-1], 12))
    loss(batch)
    noise = BODY_STATE.delta(batch["state"], fed[0])
    movable = loss.model.movable
    assert torch.equal(fed[0][:, 0], batch["state"][:, 0])  # the world
    assert (noise[:, ~movable][..., :].abs() < 1e-15).all()
    expected = (0.1 * loss.noise_scale).expand_as(movable)
    spread, mean = noise.std(0), noise.mean(0)
    assert (expected[movable] > 0).all()
    torch.testing.assert_close(spread[movable], expected[movable], rtol=0.03, atol=0)
    assert (mean[movable].abs() < 5 * expected[movable] / 20000**0.5).all()
    # Radians for orientations; each state channel's own spread for the rest.
    assert torch.equal(loss.noise_scale[3:6], torch.ones(3).double())
    moving = loss.model.canonicalizer.recentered(windows["swimmer6"]["state"])[..., loss.model.incidence.predicted, :]
    position = moving[..., :3].flatten(0, -2)
    torch.testing.assert_close(loss.noise_scale[:3], position.std(0, correction=0), rtol=1e-10, atol=1e-9)


def test_the_target_leads_from_the_noisy_input_to_the_clean_next_state(make_loss, windows, predict):
    loss = make_loss("swimmer6", noise=0.1, generator=torch.Generator().manual_seed(0))
    batch = windows["swimmer6"].reshape(-1)
    fed = predict(lambda state, action: BODY_STATE.delta(state, batch["next", "state"]))
    # Whatever the noise, the right answer is the change that repairs it.
    assert loss(batch)["loss_forward_model"] < 1e-24
    assert not torch.equal(fed[0], batch["state"])
    predict(lambda state, action: BODY_STATE.delta(batch["state"], batch["next", "state"]))
    assert loss(batch)["loss_forward_model"] > 1e-4


@pytest.mark.slow
def test_noise_comes_from_the_generator_alone(make_loss, windows):
    batch = windows["swimmer6"].reshape(-1)
    values = []
    for seed, global_seed in ((0, 0), (0, 1), (1, 0)):
        loss = make_loss("swimmer6", noise=0.1, generator=torch.Generator())
        loss.generator.manual_seed(seed)
        torch.manual_seed(global_seed)
        values.append(loss(batch)["loss_forward_model"])
    assert torch.equal(values[0], values[1])
    assert not torch.equal(values[0], values[2])


@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"integrate": False},
        {"canonicalizer": Canonicalizer(recenter=False)},
        {"canonicalizer": Canonicalizer(yaw=False)},
    ],
)
def test_fitted_normalisers_give_the_network_unit_targets(make_loss, windows, noise, options):
    """The network's inputs and its targets have mean 0 and variance 1 over the noisy data."""
    loss = make_loss("swimmer6", noise=noise, generator=torch.Generator().manual_seed(0), model=options)
    model, batch = loss.model.model, windows["swimmer6"].reshape(-1)
    loss.generator.manual_seed(0)
    state = loss.perturb(batch["state"])
    target = BODY_STATE.delta(state, batch["next", "state"])
    if model.integrate:
        target = BODY_STATE.residual(state, target, loss.model.scene.timestep)
    if model.canonicalizer.yaw:
        turn = loss.model.canonicalizer.yaw_rotation(state, loss.model.scene_parameters).quaternion
        target = BODY_STATE.rotate_delta(target, quaternion.conjugate(turn))
    movable = loss.model.movable
    targets = model.residual_normalizer(target)
    for channel in movable.any(0).nonzero().flatten().tolist():
        seen = targets[..., channel][:, movable[:, channel]]
        assert seen.mean().item() == pytest.approx(0, abs=1e-9)
        assert seen.var(correction=0).item() == pytest.approx(1, rel=1e-9)
    dynamic = dynamic_graph(loss.model, state, batch["action"])
    for features in (dynamic.nodes.flatten(0, -2), dynamic.edges.flatten(0, -2)):
        varies = features.std(0) > 0
        torch.testing.assert_close(features.mean(0), torch.zeros(len(varies)).double(), rtol=0, atol=1e-9)
        torch.testing.assert_close(features.var(0, correction=0)[varies], torch.ones(int(varies.sum())).double())


def test_training_steps_do_not_touch_statistics_or_batch(make_loss, windows):
    loss = make_loss("swimmer6", noise=0.1)
    batch = windows["swimmer6"].clone()
    before, statistics = batch.clone(), {k: v.clone() for k, v in loss.state_dict().items()}
    loss(batch)["loss_forward_model"].backward()
    assert (batch == before).all() and set(batch.keys(True)) == set(before.keys(True))
    assert all(torch.equal(value, statistics[key]) for key, value in loss.state_dict().items())


def test_torchrl_contract(make_loss, windows):
    loss = make_loss()
    batch = windows["swimmer6"].reshape(-1)
    assert loss.in_keys == ["state", "action", ("next", "state")]
    assert loss.out_keys == ["loss_forward_model", *(f"error_{name}" for name in COMPONENTS)]
    out = loss(batch)
    assert set(out.keys()) == set(loss.out_keys)
    assert all(value.shape == () for value in out.values())
    assert out["loss_forward_model"].requires_grad
    assert not any(out[key].requires_grad for key in loss.out_keys[1:])
    # Dispatch: the same with tensors, as a tuple in the order of out_keys.
    tensors = loss(state=batch["state"], action=batch["action"], next_state=batch["next", "state"])
    assert all(torch.equal(got, out[key]) for got, key in zip(tensors, loss.out_keys, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("key", ["observation", ("robot", "body")])
def test_keys_can_be_set(make_loss, windows, key):
    loss = make_loss()
    batch = windows["swimmer6"].reshape(-1)
    loss.set_keys(state=key, action="control")
    nested = ("next", key) if isinstance(key, str) else ("next", *key)
    assert loss.in_keys == [key, "control", nested]
    renamed = TensorDict(batch_size=batch.batch_size)
    renamed[key], renamed["control"], renamed[nested] = (
        batch["state"],
        batch["action"],
        batch["next", "state"],
    )
    assert torch.equal(loss(renamed)["loss_forward_model"], make_loss()(batch)["loss_forward_model"])
    with pytest.raises(ValueError, match="reward"):
        loss.set_keys(reward="r")


def test_batches_that_do_not_fit_are_named(make_loss, windows):
    loss, batch = make_loss(), windows["swimmer6"].reshape(-1)
    with pytest.raises(KeyError, match=r"needs \('next', 'state'\), the batch has"):
        loss(batch.exclude("next"))
    with pytest.raises(ValueError, match=r"State must be \[B, N, 13\] or \[B, H, N, 13\] .* got \[7, 13\]"):
        loss(batch[0])
    with pytest.raises(ValueError, match=r"\('next', 'state'\) must be \[240, 7, 13\] as 'state', got \[240, 7, 12\]"):
        loss(TensorDict({**batch, "next": {"state": batch["next", "state"][..., :12]}}, batch.batch_size))
    for empty in (batch[:0], windows["swimmer6"][:, :0]):
        with pytest.raises(ValueError, match="is empty"):
            loss(empty)
    with pytest.raises(ValueError, match="noise=-1 must not be negative"):
        make_loss(noise=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "cartpole",
        "swimmer3",
        pytest.param("cheetah", marks=pytest.mark.slow),
        pytest.param("jaco", marks=pytest.mark.slow),
    ],
)
def test_samples_of_variants_cost_what_their_own_scenes_say(tmp_path, name):
    torch.manual_seed(0)
    scene = load_scene(name)
    data = create_dataset(tmp_path, scene, train=6, validation=1, test=1, steps=4, variants=6)
    model = ForwardModel.for_scene(scene, **SMALL).double()
    loss = ForwardModelLoss(model.bind(scene, parameters_key="parameters"))
    loss.fit_normalizers(trajectory_buffer(data.train, batch_size=200, seed=0).sample())
    for window in (1, 3):
        batch = trajectory_buffer(data.train, batch_size=3, window=window, seed=1).sample()
        alone = []
        for sample in batch:
            own = data.scene_of("train", int(sample["index"].flatten()[0]))
            one = ForwardModelLoss(model.bind(own, strict=True))(sample.exclude("parameters").unsqueeze(0))
            alone.append(one["loss_forward_model"])
        torch.testing.assert_close(loss(batch)["loss_forward_model"], torch.stack(alone).mean(), rtol=1e-9, atol=0)
    model.requires_grad_(False)
    table = evaluate_errors(model.bind(scene, parameters_key="parameters"), data.train[:1], horizons=(4,))
    own = evaluate_errors(model.bind(data.scene_of("train", 0)), data.train[:1].exclude("parameters"), horizons=(4,))
    for error in ("one_step_error", "rollout_error_4"):
        assert table[error].total == pytest.approx(own[error].total, rel=1e-9)


def test_channels_weigh_as_told(make_loss, windows):
    plain = make_loss("falling")
    weights = 0.1 + torch.rand(plain.model.movable.shape, generator=torch.Generator().manual_seed(0))
    weighted = make_loss("falling", channel_weights=weights)
    batch = windows["falling"].reshape(-1)
    delta = plain.model.delta(batch["state"], batch["action"])
    target = BODY_STATE.delta(batch["state"], batch["next", "state"])
    # Perfect but for one channel: its weight is the ratio.
    for channel in (0, 2, 7, 11):
        off = torch.where(torch.arange(12) == channel, delta, target)
        ratio = weighted.component_errors(off, target).sum() / plain.component_errors(off, target).sum()
        assert ratio.item() == pytest.approx(weights[1, channel].item(), rel=1e-5)
    assert weighted.state_dict().keys() == plain.state_dict().keys()
    with pytest.raises(ValueError, match="channel_weights must be above 0"):
        make_loss("falling", channel_weights=0 * weights)


def test_calm_samples_weigh_more_down_to_the_floor(make_loss, windows):
    plain, weighted = make_loss("falling"), make_loss("falling", size_floor=0.1)
    scale = plain.error_weight * plain.model.movable
    batch = windows["falling"].reshape(-1)[:3]
    target = BODY_STATE.delta(batch["state"], batch["next", "state"])
    delta = plain.model.delta(batch["state"], batch["action"]).detach()
    # Three predicted sizes; the errors of each sample alone say what it weighs.
    for factor in (0.0, 1.0, 30.0):
        predicted = (factor * delta).requires_grad_()
        for row in range(3):
            own, true = predicted[row : row + 1], target[row : row + 1]
            size = (own * scale).square().sum() / (scale > 0).sum()
            ratio = weighted.component_errors(own, true) / plain.component_errors(own, true)
            moves = plain.component_errors(own, true) > 0
            expected = (1.1 / (0.1 + size)).expand(4)
            torch.testing.assert_close(ratio[moves], expected[moves], rtol=1e-5, atol=0)
        # The weight itself has no gradient.
        (found,) = torch.autograd.grad(weighted.component_errors(predicted[:1], target[:1]).sum(), predicted)
        (usual,) = torch.autograd.grad(plain.component_errors(predicted[:1], target[:1]).sum(), predicted)
        size = (predicted[:1] * scale).square().sum() / (scale > 0).sum()
        torch.testing.assert_close(found, usual * 1.1 / (0.1 + size), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("floor", [0.0, -1.0, math.nan, math.inf])
def test_a_bad_size_floor_is_refused(make_loss, floor):
    with pytest.raises(ValueError, match=f"size_floor={floor} must be above 0"):
        make_loss(size_floor=floor)
