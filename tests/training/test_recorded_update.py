"""Updates recorded as CUDA graphs, which need a GPU."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.training import Budget, Trainer, make_optimizer
from torchrl_gn.training.recorded_update import RecordedUpdates, UpdateGraph

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]


@pytest.fixture(scope="module")
def data(scenes):
    return collect_trajectories(scenes["swimmer6"], 16, 32, 0)


def _trainer(scenes, data, device, steps=12, preset="muon"):
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scenes["swimmer6"], hidden=32).to(device)
    loss = ForwardModelLoss(model.bind(scenes["swimmer6"]))
    loss.fit_normalizers(trajectory_buffer(data, batch_size=500, seed=0).sample().to(device))
    trainer = Trainer(
        loss,
        trajectory_buffer(data.to(device), batch_size=64, seed=0),
        make_optimizer(model, preset),
        Budget(steps=steps),
        unroll=trajectory_buffer(data.to(device), batch_size=32, window=4, seed=1),
        unroll_fraction=0.5,
    )
    return trainer


@pytest.mark.parametrize("preset", ["muon", "adam"])
def test_recorded_updates_are_those_of_torch(scenes, data, preset, monkeypatch):
    recorded, plain = (_trainer(scenes, data, "cuda", preset=preset) for _ in range(2))
    found = [progress.loss for progress in recorded.run()]
    assert len(recorded._recorded._recorded) == 2  # transitions and windows
    monkeypatch.setattr(RecordedUpdates, "of", lambda *_: None)
    wanted = [progress.loss for progress in plain.run()]
    torch.testing.assert_close(torch.tensor(found), torch.tensor(wanted), rtol=2e-3, atol=1e-6)


def test_a_recorded_update_on_nan_changes_nothing(scenes, data):
    trainer = _trainer(scenes, data, "cuda")
    updates = RecordedUpdates.of(trainer.loss, trainer.optimizer, trainer.device)
    for _ in trainer.run():
        pass
    batch = trainer.buffer.sample()
    updates = trainer._recorded
    before = [weight.clone() for weight in trainer.model.parameters()]
    batch["state"][0, 0, 0] = torch.nan
    with pytest.raises(FloatingPointError, match="The loss is nan at step 12"):
        updates(batch, 12, 0.5)
    assert all(torch.equal(a, b) for a, b in zip(before, trainer.model.parameters(), strict=True))
    batch["state"][0, 0, 0] = 0.1
    assert updates(batch, 12, 0.5) > 0


def test_what_cannot_be_recorded_is_left_to_torch(scenes, data):
    trainer = _trainer(scenes, data, "cuda")
    noisy = ForwardModelLoss(trainer.loss.model, noise=0.1)
    assert RecordedUpdates.of(noisy, trainer.optimizer, trainer.device) is None
    assert RecordedUpdates.of(trainer.loss, trainer.optimizer, torch.device("cpu")) is None


def test_an_update_that_waits_for_the_gpu_is_left_to_torch():
    number = torch.zeros((), device="cuda")
    with pytest.warns(UserWarning, match="run without a CUDA graph, more slowly"):
        assert UpdateGraph.or_none(lambda: number.add_(torch.rand_like(number).item()), [number], []) is None
    assert torch.rand(3, device="cuda").isfinite().all() and number == 0
    graph = UpdateGraph.or_none(lambda: number.add_(1).clone(), [number], [])
    assert graph is not None and [graph(), graph()] == [1.0, 2.0]
    graph.undo()
    assert number == 1
