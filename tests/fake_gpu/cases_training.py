"""Training, identification and evaluation on the device, with data there or on the CPU beside it."""

from __future__ import annotations

import pytest
import torch
from torch import nn

import torchrl_gn as gn
from torchrl_gn.data import trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, MujocoPhysics
from torchrl_gn.evaluation import baseline_errors, identification_errors
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.objectives import ForwardModelLoss, IdentificationLoss, SeveralScenesLoss
from torchrl_gn.scenes import sample_variants
from torchrl_gn.training import Budget, Trainer, fit_physics, load_pretrained, make_optimizer

from .conftest import SYSTEMS, close
from .device import waits, without_waits

scenes = pytest.mark.parametrize("name", SYSTEMS)


def places(data, name, gpu):
    """Weights and data: both on the CPU, only the weights on the device, both on the device."""
    return [("cpu", data[name]), (gpu, data[name]), (gpu, data[name].to(gpu))]


def fresh(scene, device, **options) -> ForwardModel:
    torch.manual_seed(0)
    return ForwardModel.for_scene(scene, hidden=8, layers=1, **options).double().to(device)


@scenes
def test_training_is_that_of_the_cpu(gpu, systems, data, name):
    losses, errors = [], []
    for device, given in places(data, name, gpu):
        model = fresh(systems[name], device).bind(systems[name])
        history = gn.fit(model, given, steps=4, noise=0.01, validation=given, progress=False)
        losses.append(history.losses)
        errors.append(gn.evaluate_errors(model, given, horizons=(1, 5), keep=1))
        assert [each.device for each in model.model.parameters()] == [torch.device(device)] * len([*model.parameters()])
    for other in (1, 2):
        assert losses[other] == pytest.approx(losses[0], rel=1e-6)
        for error in ("one_step_error", "rollout_error_5"):
            assert errors[other][error].total == pytest.approx(errors[0][error].total, rel=1e-6)
            assert errors[other][error].diverged == errors[0][error].diverged
        torch.testing.assert_close(errors[other].rollouts, errors[0].rollouts, rtol=1e-6, atol=1e-6)


def test_windows_and_resuming_from_a_file(gpu, systems, data, tmp_path):
    scene, losses = systems["cheetah"], []
    for device, given in places(data, "cheetah", gpu):
        model = fresh(scene, device)
        noise = {"noise": 0.01, "generator": torch.Generator().manual_seed(0)}
        loss = ForwardModelLoss(model.bind(scene), teacher_forced_steps=2, bptt_steps=2, **noise)
        loss.fit_normalizers(trajectory_buffer(given, batch_size=50, seed=0).sample().to(device))

        def trainer(steps: int, given=given, model=model, loss=loss) -> Trainer:
            buffers = [trajectory_buffer(given, batch_size=4, window=window, seed=0) for window in (1, 4)]
            options = {"unroll": buffers[1], "unroll_fraction": 0.5, "validate": lambda: 1.0}
            return Trainer(loss, buffers[0], make_optimizer(model), Budget(steps=steps), **options)

        first, second = trainer(4), trainer(6)
        losses.append([now.loss for now in first.run()])
        gn.save_checkpoint(path := tmp_path / "run.safetensors", model, training=first.state_dict())
        second.load_state_dict(load_pretrained(path).training)
        losses[-1] += [now.loss for now in second.run()]
        second.restore_best()
    assert losses[1] == pytest.approx(losses[0], rel=1e-6) and losses[2] == pytest.approx(losses[0], rel=1e-6)


@pytest.mark.parametrize("optimizer", ["muon", "adam"])
def test_a_step_waits_for_its_checks_alone(gpu, systems, data, optimizer):
    """Waits: the batch's numbers, the loss, the gradient's norm, and TorchRL's copy of a sample's indices."""
    scene, given = systems["swimmer6"], data["swimmer6"].to(gpu)
    model = fresh(scene, gpu)
    loss = ForwardModelLoss(model.bind(scene), noise=0.01, generator=torch.Generator(gpu).manual_seed(0))
    buffer = trajectory_buffer(given, batch_size=8, seed=0)
    loss.fit_normalizers(trajectory_buffer(given, batch_size=50, seed=0).sample())
    steps = Trainer(loss, buffer, make_optimizer(model, optimizer), Budget(steps=4)).run()
    next(steps)  # also asks whether the normalisers have data
    before = waits()
    next(steps)
    whole, before = waits() - before, waits()
    batch = buffer.sample()
    sampling, before = waits() - before, waits()
    found = loss(batch)["loss_forward_model"]
    assert waits() - before == 1 and whole - sampling == 3
    with without_waits():
        found.backward()


def test_noise_of_any_generator(gpu, systems, data):
    scene = systems["swimmer6"]
    batch = trajectory_buffer(data["swimmer6"], batch_size=50, seed=0).sample().to(gpu)
    for generator in (None, torch.Generator(), torch.Generator(gpu)):
        loss = ForwardModelLoss(fresh(scene, gpu).bind(scene), noise=0.01, generator=generator)
        loss.fit_normalizers(batch)
        loss.load_training_state(loss.training_state())
        assert loss(batch)["loss_forward_model"].device == gpu


def test_a_loss_moves_with_its_model(gpu, systems, data):
    scene = systems["jaco"]
    model = fresh(scene, "cpu").bind(scene)
    loss = ForwardModelLoss(model, channel_weights=torch.ones(model.movable.shape))
    batch = trajectory_buffer(data["jaco"], batch_size=50, seed=0).sample()
    loss.fit_normalizers(batch)
    wanted = loss(batch)
    found = loss.to(gpu)(batch.to(gpu))
    for key in wanted.keys():
        close(found[key], wanted[key])


def test_what_is_not_finite_is_refused(gpu, systems, data):
    scene = systems["swimmer6"]
    loss = ForwardModelLoss(fresh(scene, gpu).bind(scene))
    batch = trajectory_buffer(data["swimmer6"], batch_size=50, seed=0).sample().to(gpu)
    loss.fit_normalizers(batch)
    batch["action"][3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"'action' of the batch has nan at index \(3, 1\)"):
        loss(batch)


def test_several_scenes(gpu, systems, data):
    several = [systems["swimmer6"], gn.load_scene("swimmer3")]
    given = [data["swimmer6"], gn.collect_trajectories(several[1], 3, steps=6, seed=0)]
    found = []
    for device in ("cpu", gpu):
        torch.manual_seed(0)
        model = ForwardModel.for_scene(several, hidden=8, layers=1).double().to(device)
        loss = SeveralScenesLoss([ForwardModelLoss(model.bind(scene)) for scene in several])
        batches = [trajectory_buffer(each, batch_size=8, seed=0).sample().to(device) for each in given]
        loss.fit_normalizers(batches)
        found.append(loss(batches)["loss_forward_model"])
    close(found[1], found[0])


def test_identification(gpu, systems, tmp_path):
    scene = systems["swimmer6"]
    data = gn.collect_trajectories(sample_variants("swimmer6", 4, rng=0), 4, steps=12, seed=0)
    found = []
    for device, given in (("cpu", data), (gpu, data)):
        model = IdentifyingModel(fresh(scene, "cpu", parameters="inferred"), node_hidden=[4]).double().to(device)
        noise = {"noise": 0.01, "generator": torch.Generator().manual_seed(0)}
        loss = IdentificationLoss(model, scene, context_length=4, shortest=2, **noise)
        loss.fit_normalizers(trajectory_buffer(data, batch_size=20, seed=0).sample().to(device))
        buffer = trajectory_buffer(given, batch_size=4, window=8, seed=0)
        losses = [now.loss for now in Trainer(loss, buffer, make_optimizer(model), Budget(steps=2)).run()]
        bound, inference = model.bind(scene)
        state, action = data["state"].to(device), data["action"].to(device)
        estimate = inference.identify(state, action)
        rollouts = [each.rollout(state[:, 0], action, estimate)[0] for each in (bound, gn.specialize(bound))]
        table = identification_errors(bound, inference, data[:2], data[2:], steps=4, horizons=(3,))
        found.append((losses, rollouts, table["rollout_error_3"].total))
        gn.save_checkpoint(path := tmp_path / "model.safetensors", model)
        assert next(load_pretrained(path).trained.parameters()).is_cpu
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-6)
    assert found[1][2] == pytest.approx(found[0][2], rel=1e-6)
    for there, here in zip(found[1][1], found[0][1], strict=True):
        close(there, here, tolerance=1e-6)


class Drag(nn.Module):
    """Known physics with one unknown number, the drag."""

    def __init__(self) -> None:
        super().__init__()
        self.drag = nn.Parameter(torch.zeros((), dtype=torch.float64))

    def forward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return torch.cat((state[..., :7], state[..., 7:] * (1 - self.drag)), dim=-1)


def test_physics(gpu, systems, data):
    scene, given = systems["swimmer6"], data["swimmer6"]
    fitted = [
        fit_physics(Drag().to(device), scene, each, steps=3, window=2) for device, each in places(data, "swimmer6", gpu)
    ]
    assert fitted[1] == pytest.approx(fitted[0]) and fitted[2] == pytest.approx(fitted[0])
    totals = []
    for physics, trajectories in (
        (MujocoPhysics(scene), given),
        (MujocoPhysics(scene), given.to(gpu)),
        (Drag().to(gpu), given),
    ):
        totals.append(baseline_errors(scene, trajectories, physics, horizons=(2,))["physics"]["rollout_error_2"].total)
    assert totals[1] == pytest.approx(totals[0], rel=1e-9)
    losses = []
    for device in ("cpu", gpu):
        for physics in (MujocoPhysics(scene), Drag()):
            loss = ForwardModelLoss(fresh(scene, device, physics=physics).bind(scene), residual_weight=0.1)
            batch = trajectory_buffer(given, batch_size=20, seed=0).sample().to(device)
            loss.fit_normalizers(batch)
            torch.manual_seed(0)
            losses.append(loss(batch)["loss_forward_model"])
            losses[-1].backward()
    for here, there in zip(losses[:2], losses[2:], strict=True):
        close(there, here)


def test_buffers_keep_trajectories_where_they_are(gpu, data):
    for options in ({"window": 3}, {"window": 2, "query_windows": (2, 3)}, {"capacity": 6}):
        samples = [
            trajectory_buffer(each, batch_size=8, seed=0, **options).sample()
            for each in (data["jaco"], data["jaco"].to(gpu))
        ]
        for key in ("state", "action", ("next", "state")):
            close(samples[1][key], samples[0][key], tolerance=0)


def test_whole_batches_are_needed_on_one_device(gpu, systems, data):
    loss = ForwardModelLoss(fresh(systems["swimmer6"], gpu).bind(systems["swimmer6"]))
    with pytest.raises(RuntimeError, match="same device"):
        loss.fit_normalizers(trajectory_buffer(data["swimmer6"], batch_size=50, seed=0).sample())


def test_evaluation_waits_as_often_however_long_it_is(gpu, systems, data):
    model, given, counts = fresh(systems["swimmer6"], gpu).bind(systems["swimmer6"]), data["swimmer6"].to(gpu), []
    gn.fit(model, given, steps=1, progress=False)
    for horizon in (3, 3, 9):  # constants go there once
        before = waits()
        gn.evaluate_errors(model, given, horizons=(horizon,))
        counts.append(waits() - before)
    assert counts[1] == counts[2]
