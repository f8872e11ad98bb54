"""Files of episodes: read as they were written, or refused by name."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from _common.episodes import Episodes, read_episodes, transitions
from _common.training_data import extra_trajectories
from torchrl_gn.training.tensor_files import load_tensors, write_tensors


@pytest.fixture
def path(tmp_path):
    """Three steps of two episodes, the second of which becomes unstable in the last."""
    torch.manual_seed(0)
    start = TensorDict({"state": torch.randn(2, 4, 13), "physics": torch.randn(2, 5)}, [2])
    episodes = Episodes(tmp_path / "gn.safetensors", start)
    for step in range(3):
        now = TensorDict({"state": torch.randn(2, 4, 13), "physics": torch.randn(2, 5)}, [2])
        state = now["state"].clone()
        if step == 2:
            state[1] = torch.nan
        records = {"state": state, "action": torch.randn(2, 1), "reward": torch.randn(2)}
        episodes.record(now, {**records, "seconds": torch.tensor(1.0), "planned": torch.randn(4, 13)})
    episodes.save()
    return episodes.path


def test_episodes_go_on_as_they_were(path):
    kept = load_tensors(path)
    again = Episodes(path, TensorDict({"state": torch.zeros(2, 4, 13)}, [2]))
    assert len(again) == 3 and again.over.tolist() == [False, True]
    for name in ("state", "action", "reward", "seconds", "planned"):
        torch.testing.assert_close(again[name], kept[name], rtol=0, atol=0, equal_nan=True)
    assert torch.equal(again.now["physics"], kept["now.physics"])
    assert [tuple(part.shape) for part in transitions(path)] == [(1, 2), (1, 3)]
    write_tensors(path, kept | {"planned": torch.zeros(0)})  # of planners whose plans are not shown
    read_episodes(path)


READERS = {
    "mpc": lambda path: Episodes(path, TensorDict({"state": torch.zeros(2, 4, 13)}, [2])),
    "value": transitions,
    "forward_model": lambda path: extra_trajectories(str(path), 2),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("torn", ["state", "action", "reward", "seconds", "planned", "now.state"])
def test_a_step_that_is_not_whole_is_refused(path, torn, reader):
    kept = load_tensors(path)
    per_episode = torn in ("state", "action", "reward")
    kept[torn] = kept[torn] + 1 if torn == "now.state" else kept[torn][:, :-1] if per_episode else kept[torn][:-1]
    write_tensors(path, kept)
    with pytest.raises(ValueError, match=r"gn\.safetensors is damaged: .*step"):
        READERS[reader](path)


@pytest.mark.parametrize(
    ("reader", "name"),
    [("mpc", "now.state"), ("mpc", "seconds"), ("value", "reward"), ("forward_model", "action"), ("value", "state")],
)
def test_other_files_are_refused(path, reader, name):
    kept = load_tensors(path)
    del kept[name]
    write_tensors(path, kept)
    with pytest.raises(ValueError, match=rf"gn\.safetensors has no {name}: it is not a file of episodes"):
        READERS[reader](path)
    write_tensors(path, kept | {name: torch.zeros(2)})
    with pytest.raises(ValueError, match=r"gn\.safetensors is damaged"):
        READERS[reader](path)
