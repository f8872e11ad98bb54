"""Replay buffer: true transitions, every one equally likely, repeatable."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from scipy import stats
from tensordict import TensorDict
from torchrl.data import ReplayBufferEnsemble

from torchrl_gn.data import collect_trajectories, create_dataset, load_dataset, trajectory_buffer
from torchrl_gn.scenes import Scene, load_scene


def _counting(num: int, steps: int, first: int = 0) -> TensorDict:
    """States and actions that tell their trajectory and time: ``100 m + t``."""
    here = 100.0 * torch.arange(first, first + num)[:, None] + torch.arange(steps + 1)
    return TensorDict(
        {
            "state": here[..., None, None].expand(num, steps + 1, 2, 13).double().contiguous(),
            "action": here[:, :-1, None].double().contiguous(),
            "physics": here[..., None].double().contiguous(),
        },
        batch_size=[num],
    )


@pytest.mark.parametrize("window", [1, 4])
def test_samples_are_consecutive_transitions(swimmer: Scene, window: int) -> None:
    data = collect_trajectories(swimmer, 6, 9, seed=0)
    batch = trajectory_buffer(data, batch_size=50, window=window, seed=0).sample()
    shape = (50,) if window == 1 else (50, window)
    assert batch.shape == shape and batch["next"].shape == shape
    assert batch["state"].shape == (*shape, 7, 13) and batch["action"].shape == (*shape, 5)
    assert batch["state"].dtype == torch.float64
    trajectory, time = batch["index"].unbind(-1)
    assert torch.equal(batch["state"], data["state"][trajectory, time])
    assert torch.equal(batch["next", "state"], data["state"][trajectory, time + 1])
    assert torch.equal(batch["action"], data["action"][trajectory, time])
    if window > 1:
        assert torch.equal(batch["next", "state"][:, :-1], batch["state"][:, 1:])
        assert (trajectory == trajectory[:, :1]).all() and (time.diff(dim=1) == 1).all()


def test_a_part_of_the_time(swimmer: Scene) -> None:
    data = collect_trajectories(swimmer, 3, 9, seed=0)
    part = TensorDict({"state": data["state"][:, 4:8], "action": data["action"][:, 4:7]}, [3])
    batch = trajectory_buffer(part, batch_size=50, seed=0).sample()
    trajectory, time = batch["index"].unbind(-1)
    assert torch.equal(batch["next", "state"], data["state"][trajectory, time + 5])


@pytest.mark.parametrize("window", [1, 3, 5])
def test_every_window_is_equally_likely(window: int) -> None:
    buffer = trajectory_buffer(_counting(4, 5), batch_size=20_000, window=window, seed=1)
    drawn = buffer.sample()["index"].reshape(20_000, window, 2)[:, 0]
    counts = torch.zeros(4, 5 - window + 1).index_put_(drawn.unbind(-1), torch.ones(20_000), accumulate=True)
    assert stats.chisquare(counts.flatten().numpy()).pvalue > 1e-3


def test_draws_repeat_and_resume() -> None:
    data = _counting(5, 7)
    first, second = (trajectory_buffer(data, batch_size=8, seed=3) for _ in range(2))
    assert torch.equal(first.sample()["index"], second.sample()["index"])
    saved = first.state_dict()
    expected = [first.sample()["index"] for _ in range(3)]
    torch.manual_seed(0)  # the global generator has no part in it
    resumed = trajectory_buffer(data, batch_size=8, seed=99)
    resumed.load_state_dict(saved)
    assert all(torch.equal(resumed.sample()["index"], index) for index in expected)
    assert not saved["_storage"]  # the data are not part of a checkpoint
    other = trajectory_buffer(data, batch_size=8, seed=4)
    assert not torch.equal(other.sample()["index"], expected[0])


def test_statics_are_gathered_by_trajectory() -> None:
    data = _counting(5, 7)
    mass = torch.arange(5.0)[:, None]
    data["parameters"] = TensorDict({"nodes": mass[..., None].expand(5, 2, 1)}, batch_size=[5])
    for window in (1, 3):
        batch = trajectory_buffer(data, batch_size=20, window=window, seed=0).sample()
        assert batch["parameters"].batch_size == batch.batch_size
        assert torch.equal(batch["parameters", "nodes"][..., 0, 0], batch["index"][..., 0].float())


def test_extending_gives_way_to_the_newest() -> None:
    buffer = trajectory_buffer(_counting(3, 5), batch_size=500, window=2, seed=0, capacity=5)
    assert len(buffer) == 3 and set(_trajectories(buffer)) == {0, 1, 2}
    buffer.extend(_counting(4, 5, first=3))
    assert len(buffer) == 5 and set(_trajectories(buffer)) == {2, 3, 4, 5, 6}
    batch = buffer.sample()
    assert torch.equal(batch["next", "state"], batch["state"] + 1)
    saved = buffer.state_dict()
    other = trajectory_buffer(_counting(3, 5, first=50), batch_size=500, window=2, seed=7, capacity=5)
    other.load_state_dict(saved)
    assert torch.equal(other.sample()["state"], buffer.sample()["state"])


def test_extending_refuses_what_does_not_fit() -> None:
    buffer, more = trajectory_buffer(_counting(3, 5), batch_size=500, seed=0, capacity=5), _counting(2, 5, first=3)
    ends = torch.zeros(2, 5, 1, dtype=torch.bool)
    ends[1, 2] = True
    with pytest.raises(ValueError, match="ends .* inside the trajectories"):
        buffer.extend(more.clone().set("next", TensorDict({"done": ends}, [2])))
    with pytest.raises(KeyError, match="have no 'action'"):
        buffer.extend(more.exclude("action"))
    with pytest.raises(ValueError, match=r"'(state|action)' must be \[2, [56], .*\] as in the buffer"):
        buffer.extend(_counting(2, 6))
    assert len(buffer) == 3 and set(_trajectories(buffer)) == {0, 1, 2}
    buffer.extend(more.apply(lambda value: value.double() if value.is_floating_point() else value))
    buffer.add(_counting(1, 5, first=7)[0])
    assert set(_trajectories(buffer)) == {1, 2, 3, 4, 7} and buffer.sample()["state"].dtype == more["state"].dtype


def _trajectories(buffer) -> list[int]:
    return (buffer.sample()["action"][..., 0] // 100).long().unique().tolist()


def test_reads_a_data_set_on_disk_silently(tmp_path: Path, pendulum: Scene, capfd) -> None:
    create_dataset(tmp_path, pendulum, train=6, validation=1, test=1, steps=8)
    data = load_dataset(tmp_path).train
    buffer = trajectory_buffer(data, batch_size=10, window=8, seed=0)
    batch = buffer.sample()
    assert torch.equal(batch["next", "state"], data["state"][batch["index"][:, 0, 0], 1:])
    assert torch.equal(buffer[2]["state"], data["state"][2])
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        buffer.extend(data.clone())
    assert "".join(capfd.readouterr()) == ""


@pytest.mark.parametrize("window", [1, 3])
def test_several_systems_give_a_sub_batch_each(window: int, pendulum: Scene) -> None:
    data = [collect_trajectories(scene, 4, 6) for scene in (pendulum, load_scene("acrobot"))]
    buffers = [trajectory_buffer(each, batch_size=5, window=window, seed=0) for each in data]
    both = ReplayBufferEnsemble(*buffers, batch_size=10, sample_from_all=True)
    for stored, batch in zip(data, both.sample().unbind(0), strict=True):
        assert len(batch) == 5
        trajectory, time = batch["index", "index"].unbind(-1)
        assert torch.equal(batch["next", "state"], stored["state"][trajectory, time + 1])


def test_what_cannot_be_sampled_is_refused() -> None:
    data = _counting(3, 5)
    with pytest.raises(ValueError, match="window is 6 transitions, but the trajectories have 5"):
        trajectory_buffer(data, batch_size=2, window=6)
    with pytest.raises(ValueError, match="no trajectory"):
        trajectory_buffer(data[:0], batch_size=2)
    with pytest.raises(KeyError, match="no 'action'"):
        trajectory_buffer(data.exclude("action"), batch_size=2)
    with pytest.raises(ValueError, match="one state more than actions"):
        trajectory_buffer(TensorDict({**data, "state": data["state"][:, 1:]}, [3]), batch_size=2)
    with pytest.raises(ValueError, match="capacity is 2, but 3"):
        trajectory_buffer(data, batch_size=2, capacity=2)
    with pytest.raises(ValueError, match="batch_size=0 must be a whole number"):
        trajectory_buffer(data, batch_size=0)


def test_shards_are_the_parts_of_one_draw() -> None:
    whole = trajectory_buffer(_counting(5, 8), batch_size=12, window=3, seed=0)
    parts = [trajectory_buffer(_counting(5, 8), batch_size=12, window=3, seed=0, shard=(rank, 3)) for rank in range(3)]
    for _ in range(2):
        drawn = [part.sample() for part in parts]
        assert [len(part) for part in drawn] == [4, 4, 4]
        torch.testing.assert_close(torch.cat([part["action"] for part in drawn]), whole.sample()["action"])
    with pytest.raises(ValueError, match="batch_size=10 cannot be split evenly among 4 processes"):
        trajectory_buffer(_counting(5, 8), batch_size=10, shard=(0, 4))
    with pytest.raises(ValueError, match=r"shard must be a rank and a size above it, got \(2, 2\)"):
        trajectory_buffer(_counting(5, 8), batch_size=10, shard=(2, 2))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_samples_lie_where_the_data_do() -> None:
    data = _counting(5, 7)
    for window in (1, 3):
        here, there = (
            trajectory_buffer(of, batch_size=20, window=window, seed=0).sample() for of in (data, data.cuda())
        )
        assert there["state"].is_cuda and torch.equal(there["state"].cpu(), here["state"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"action": torch.ones(1, 6, 1)}, r"'action' must be \[1, 6, 2\] as in the buffer, got \[1, 6, 1\]"),
        ({"action": torch.ones(1, 1, 2)}, r"'action' must be \[1, 6, 2\] as in the buffer, got \[1, 1, 2\]"),
        ({"state": torch.ones(1, 7, 1, 13)}, r"'state' must be \[1, 7, 3, 13\] as in the buffer"),
        ({"action": None}, "trajectories have no 'action'"),
    ],
)
def test_what_would_be_repeated_does_not_extend(change, message) -> None:
    """PyTorch repeats a single action, body or step to the shape of what it is assigned to."""
    first = TensorDict({"state": torch.zeros(2, 7, 3, 13), "action": torch.zeros(2, 6, 2)}, [2])
    buffer = trajectory_buffer(first, batch_size=4, seed=0, capacity=2)
    more = {"state": torch.ones(1, 7, 3, 13), "action": torch.ones(1, 6, 2)} | change
    with pytest.raises((ValueError, KeyError), match=message):
        buffer.extend(TensorDict({name: value for name, value in more.items() if value is not None}, [1]))
    stored = buffer[:]
    assert not stored["state"].any() and not stored["action"].any()


@pytest.mark.parametrize(
    "how", [torch.Tensor.bfloat16, lambda value: torch._neg_view(-value), lambda value: value.mT.mT]
)
def test_transitions_of_any_storage_are_drawn(how) -> None:
    state = torch.arange(2 * 7 * 13.0).reshape(2, 7, 1, 13) / 8
    plain = TensorDict({"state": state, "action": state[:, :-1, 0, :2]}, [2])
    stored = TensorDict({name: how(value) for name, value in plain.items()}, [2])
    drawn, expected = (trajectory_buffer(each, batch_size=9, seed=0).sample() for each in (stored, plain))
    for key in ("state", "action", ("next", "state")):
        assert torch.equal(drawn[key].float(), expected[key].to(drawn[key].dtype).float())
