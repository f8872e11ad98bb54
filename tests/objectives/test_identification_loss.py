"""The loss of system identification: one part of a trajectory gives the estimate that predicts other parts."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.evaluation import identification_errors, linear_probe
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.objectives import ForwardModelLoss, IdentificationLoss
from torchrl_gn.scenes import load_scene, sample_variants

SMALL = {"edge_hidden": (16,), "node_hidden": (16,), "global_hidden": (16,)}


@pytest.fixture(scope="module")
def trajectories():
    """Two trajectories each of eight pendulums."""
    return collect_trajectories(sample_variants("pendulum", 8, rng=0), 16, 30, seed=0)


@pytest.fixture
def make_loss(trajectories):
    def make(**options) -> IdentificationLoss:
        torch.manual_seed(0)
        scene = load_scene("pendulum")
        forward_model = ForwardModel.for_scene(scene, parameters="inferred", latent=16, **SMALL)
        loss = IdentificationLoss(IdentifyingModel(forward_model, **SMALL), scene, **options)
        loss.fit_normalizers(trajectory_buffer(trajectories, batch_size=500, seed=0).sample())
        return loss

    return make


@pytest.mark.parametrize("length", [1, 3])
def test_it_is_the_forward_models_loss_with_the_inferred_graph(make_loss, trajectories, length):
    loss = make_loss(context_length=6, num_queries=2)
    batch = trajectory_buffer(trajectories, batch_size=5, window=6, query_windows=(2, length), seed=0).sample()
    assert batch.shape == (5, 6 + 2 * length)
    time, trajectory = batch["index"][..., 1], batch["index"][..., 0]
    assert (trajectory == trajectory[:, :1]).all() and (time[:, :6].diff(dim=1) == 1).all()
    parameters = loss.inference.infer(
        batch["state"][:, :6], batch["action"][:, :6], batch["next", "state"][:, :6]
    ).parameters
    alone = []
    for sample, own in zip(batch, parameters, strict=True):
        for part in range(2):
            steps = sample[6 + part * length : 6 + (part + 1) * length].select("state", "action", "next")
            steps = steps.set("parameters", own.expand(length)).unsqueeze(0)
            alone.append(loss.prediction(steps)["loss_forward_model"])
    torch.testing.assert_close(loss(batch)["loss_forward_model"], torch.stack(alone).mean())


@pytest.mark.slow
def test_a_random_number_of_steps_is_identified_from_the_last_of_the_phase(make_loss, trajectories):
    loss = make_loss(context_length=6, shortest=4, num_queries=1, generator=torch.Generator().manual_seed(0))
    batch = trajectory_buffer(trajectories, batch_size=5, window=6, query_windows=(1, 1), seed=0).sample()
    fewer = [make_loss(context_length=steps)(batch[:, 6 - steps :])["loss_forward_model"].item() for steps in (4, 5, 6)]
    drawn = [loss(batch)["loss_forward_model"].item() for _ in range(12)]
    nearest = [min(fewer, key=lambda one: abs(one - value)) for value in drawn]
    assert drawn == pytest.approx(nearest, rel=1e-9) and set(nearest) == set(fewer)
    state = loss.training_state()
    assert [loss(batch)["loss_forward_model"].item() for _ in range(5)] != drawn[:5]
    after = loss(batch)["loss_forward_model"].item()
    loss.load_training_state(state)
    assert [loss(batch)["loss_forward_model"].item() for _ in range(6)][-1] == after
    loss.eval()
    assert loss(batch)["loss_forward_model"].item() == pytest.approx(fewer[-1])
    for shortest in (0, 7):
        with pytest.raises(ValueError, match=f"shortest={shortest} must be from 1 to context_length=6"):
            make_loss(context_length=6, shortest=shortest)


@pytest.mark.slow
def test_one_loss_trains_both_models_and_identification_pays(make_loss, trajectories):
    loss = make_loss(context_length=10, num_queries=4)
    buffer = trajectory_buffer(trajectories, batch_size=16, window=10, query_windows=(4, 1), seed=0)
    loss(buffer.sample())["loss_forward_model"].backward()
    for part in (loss.trained.inference, loss.trained.forward_model.core):
        assert all(weight.grad.abs().sum() > 0 for weight in part.parameters() if weight.ndim == 2)
    optimizer = torch.optim.Adam(loss.trained.parameters(), 3e-3)
    for _ in range(300):
        optimizer.zero_grad()
        loss(buffer.sample())["loss_forward_model"].backward()
        optimizer.step()
    pairs = loss.bound, loss.inference, trajectories[:8], trajectories[8:]
    right, wrong = (identification_errors(*pairs, wrong=wrong, horizons=(10,)) for wrong in (False, True))
    assert right["rollout_error_10"].total < 0.8 * wrong["rollout_error_10"].total


def test_true_parameters_in_the_samples_are_not_read(make_loss, trajectories):
    loss = make_loss(context_length=6)
    batch = trajectory_buffer(trajectories, batch_size=5, window=6, query_windows=(1, 1), seed=0).sample()
    mixed = batch.clone().set("parameters", batch["parameters"].apply(lambda value: value.flip(0)))
    assert torch.equal(loss(batch)["loss_forward_model"], loss(mixed)["loss_forward_model"])
    assert "parameters" not in loss.in_keys


def test_what_does_not_fit_is_named(make_loss, trajectories):
    loss = make_loss(context_length=6, num_queries=2)
    batch = trajectory_buffer(trajectories, batch_size=5, window=6, query_windows=(2, 1), seed=0).sample()
    for wrong in (batch[:, :6], batch[:, :7], batch[0]):
        with pytest.raises(ValueError, match=r"must be \[B, 6 \+ 2 \* H\].*query_windows=\(2, H\)"):
            loss(wrong)
    with pytest.raises(KeyError, match=r"needs .{0,2}'action"):
        loss(batch.exclude("action"))
    batch["state"][0, 0, 1, 0] = torch.nan
    with pytest.raises(ValueError, match="'state' of the batch"):
        loss(batch)
    with pytest.raises(ValueError, match="context_length=0"):
        make_loss(context_length=0)
    with pytest.raises(ValueError, match=r"query_windows\[0\]=0 must be"):
        trajectory_buffer(trajectories, batch_size=5, query_windows=(0, 1))
    with pytest.raises(ValueError, match="8 observed and 16 test"):
        identification_errors(loss.bound, loss.inference, trajectories[:8], trajectories)
    for steps in (0, -2):
        with pytest.raises(ValueError, match=f"steps={steps} must be a whole number, 1 or more"):
            identification_errors(loss.bound, loss.inference, trajectories, trajectories, steps=steps)


def test_errors_of_identification_are_measured_without_dropout(make_loss, trajectories):
    loss = make_loss(context_length=6)
    for module in list(loss.inference.modules()):
        for name, part in module.named_children():
            if isinstance(part, nn.SiLU):
                setattr(module, name, nn.Sequential(part, nn.Dropout(0.5)))
    assert any(isinstance(each, nn.Dropout) for each in loss.inference.model.modules())
    pairs = loss.bound, loss.inference, trajectories[:8], trajectories[8:]
    totals = []
    for training in (False, True):
        loss.train(training)
        totals.append(identification_errors(*pairs, horizons=(10,))["rollout_error_10"].total)
    assert totals[0] == totals[1] and loss.inference.training


def test_of_a_model_that_diverged_the_loss_is_nan(make_loss, trajectories):
    """The samples are not to blame: a trainer says so."""
    loss = make_loss(context_length=6)
    batch = trajectory_buffer(trajectories, batch_size=5, window=6, query_windows=(1, 1), seed=0).sample()
    with torch.no_grad():
        for weight in loss.identifying.inference.parameters():
            weight.fill_(torch.nan)
    assert loss(batch)["loss_forward_model"].isnan()


def test_a_model_that_reads_true_parameters_is_no_part_of_it():
    scene = load_scene("pendulum")
    model = ForwardModel.for_scene(scene, latent=16, **SMALL)
    loss = ForwardModelLoss(model.bind(scene))
    assert not isinstance(loss.trained, IdentifyingModel)


def test_other_windows_start_elsewhere(trajectories):
    buffer = trajectory_buffer(trajectories, batch_size=400, window=4, query_windows=(3, 5), seed=0)
    time = buffer.sample()["index"][..., 1]
    first, others = time[:, 0], time[:, 4::5]
    assert (others != first[:, None]).all()
    assert others.unique().tolist() == list(range(26)) and first.unique().tolist() == list(range(27))
    assert (time[:, 4:].unflatten(1, (3, 5)).diff(dim=-1) == 1).all()


def test_a_linear_probe_finds_what_is_linear():
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(400, 6, generator=generator)
    features[:, 5] = 3.0  # says nothing
    targets = torch.stack((features[:, 0] - 2 * features[:, 1], torch.randn(400, generator=generator)), 1)
    found = linear_probe(features, targets, train=300)
    assert found[0] > 0.99 and found[1] < 0.1
    many = torch.cat((features, torch.randn(400, 500, generator=generator)), dim=1)  # more than samples
    found = linear_probe(many, targets, train=300)
    assert found[0] > 0.4 and -0.1 < found[1] < 0.1
    with pytest.raises(ValueError, match="train=399 of 400"):
        linear_probe(features, targets, train=399)
