"""One loss over several scenes: equal shares, whatever their scales, on one set of weights."""

from __future__ import annotations

import pytest
import torch
from torchrl.data import ReplayBufferEnsemble

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives import ForwardModelLoss, SeveralScenesLoss
from torchrl_gn.scenes import load_scene

from ..sizes import SMALL

NAMES = ("pendulum", "cartpole")  # both turn about one axis, at different speeds


@pytest.fixture
def losses() -> list[ForwardModelLoss]:
    """Losses of two scenes that share a model."""
    torch.manual_seed(0)
    model = ForwardModel.for_scene(load_scene("pendulum"), **SMALL).double()
    return [ForwardModelLoss(model.bind(load_scene(name))) for name in NAMES]


@pytest.fixture(scope="module")
def buffer() -> ReplayBufferEnsemble:
    """Equal shares of both scenes."""
    data = [collect_trajectories(load_scene(name), num=20, steps=6) for name in NAMES]
    buffers = [trajectory_buffer(each, batch_size=30, seed=0) for each in data]
    return ReplayBufferEnsemble(*buffers, batch_size=60, sample_from_all=True)


def test_it_is_the_mean_of_the_scenes_losses(losses, buffer):
    loss, batch = SeveralScenesLoss(losses), buffer.sample()
    loss.fit_normalizers(batch)
    out = loss(batch)
    alone = [each(part) for each, part in zip(losses, batch.unbind(0), strict=True)]
    assert set(loss.out_keys) == set(out.keys())
    for key in alone[0].keys():
        torch.testing.assert_close(out[key], (alone[0][key] + alone[1][key]) / 2)
    for name, each in zip(NAMES, alone, strict=True):
        assert torch.equal(out[f"scene_{name}"], each["loss_forward_model"])
    out["loss_forward_model"].backward()
    assert all(weight.grad.abs().sum() > 0 for weight in loss.trained.core.parameters() if weight.ndim == 2)


def test_every_scene_counts_by_its_own_scale(losses, buffer):
    """Errors have the weights of training on one scene, though the network's output is scaled for all scenes."""
    batch = buffer.sample()
    SeveralScenesLoss(losses).fit_normalizers(batch)
    shared = losses[0].trained.delta_normalizer
    for loss, part in zip(losses, batch.unbind(0), strict=True):
        model = ForwardModel.from_description(loss.trained.description()).double()
        alone = ForwardModelLoss(model.bind(loss.model.scene))
        alone.fit_normalizers(part)
        assert torch.equal(loss.error_weight, model.delta_normalizer.inverse_std)
        movable = loss.model.movable.any(0)
        assert (loss.error_weight[movable] != shared.inverse_std[movable]).any()


def test_a_training_goes_on_with_the_scales_it_had(losses, buffer):
    loss = SeveralScenesLoss(losses)
    loss.fit_normalizers(buffer.sample())
    again = SeveralScenesLoss([ForwardModelLoss(each.model) for each in losses])
    again.load_training_state(loss.training_state())
    batch = buffer.sample()
    assert torch.equal(again(batch)["loss_forward_model"], loss(batch)["loss_forward_model"])


def test_what_does_not_fit_is_named(losses, buffer, make_loss):
    with pytest.raises(ValueError, match="at least one loss"):
        SeveralScenesLoss([])
    with pytest.raises(ValueError, match="of one model"):
        SeveralScenesLoss([losses[0], make_loss("swimmer6")])
    with pytest.raises(ValueError, match=r"\['pendulum', 'pendulum'\] must have different names"):
        SeveralScenesLoss([losses[0], losses[0]])
    with pytest.raises(ValueError, match="has 1 sub-batches for 2 scenes"):
        SeveralScenesLoss(losses)([buffer.sample()[0]])
