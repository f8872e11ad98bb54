"""Trajectories of one's own as data of the main job."""

from __future__ import annotations

import os

import pytest
import torch
from tensordict import NonTensorData, TensorDict

from _common import training_data
from _common.training_data import extra_trajectories
from torchrl_gn.data import collect_trajectories
from torchrl_gn.scenes import load_scene
from torchrl_gn.training.tensor_files import write_tensors

from ..data.test_tensor_folder import Planted


def test_trajectories_of_a_policy_are_extra_data(tmp_path):
    swung = collect_trajectories(
        load_scene("pendulum"), 3, 100, policy=lambda entries: entries["state"][:, 1, 11:12].sign()
    )
    swung.memmap(tmp_path / "swung")
    extra = extra_trajectories(str(tmp_path / "swung"), 100)
    assert torch.equal(extra["state"], swung["state"]) and torch.equal(extra["action"], swung["action"])


@pytest.fixture
def swung() -> TensorDict:
    """Five trajectories of four steps."""
    generator = torch.Generator().manual_seed(0)
    states, actions = torch.rand(5, 5, 2, 13, generator=generator), torch.rand(5, 4, 1, generator=generator)
    return TensorDict({"state": states, "action": actions}, [5])


@pytest.mark.parametrize("key", ["state", "action"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("row", [3, 699])
def test_numbers_that_are_not_finite_are_refused(swung, tmp_path, key, value, row):
    many = swung[torch.arange(700) % 5]  # looked at in several parts
    many[key][row, 2] = value
    many.memmap(tmp_path / "swung")
    with pytest.raises(ValueError, match=f"data.extra={tmp_path / 'swung'}: {key} of trajectory {row} is not finite"):
        extra_trajectories(str(tmp_path / "swung"), 4)


def test_folders_of_anything_else_are_refused_and_kept(swung, tmp_path):
    folder, ran = tmp_path / "swung", tmp_path / "ran"
    swung.set("note", NonTensorData(Planted(ran), batch_size=[5])).memmap(folder)
    with pytest.raises(ValueError, match=f"data.extra={folder} cannot be read: .*'note' is of type 'NonTensorData'"):
        extra_trajectories(str(folder), 4)
    assert not ran.exists()
    swung.exclude("note").memmap(folder)
    os.truncate(folder / "state.memmap", 100)
    with pytest.raises(ValueError, match="state.memmap: 100 bytes, should be 2600: truncated"):
        extra_trajectories(str(folder), 4)
    assert (folder / "state.memmap").stat().st_size == 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.exclude("action"), r"has no \['action'\], only \['state'\]"),
        (lambda data: data[0], r"holds trajectories \[\]; it must be \[M\]"),
        (lambda data: data[:0], r"holds trajectories \[0\]; it must be \[M\], at least one"),
    ],
)
def test_folders_without_trajectories_are_refused(swung, tmp_path, change, message):
    change(swung).memmap(tmp_path / "swung")
    with pytest.raises(ValueError, match=message):
        extra_trajectories(str(tmp_path / "swung"), 4)


def test_steps_of_episodes_that_are_not_finite_are_left_out(swung, tmp_path):
    file, episodes = tmp_path / "episodes.safetensors", swung.to_dict()
    episodes["state"][1, 4], episodes["action"][2, 0] = torch.nan, torch.nan
    write_tensors(file, episodes)
    found = extra_trajectories(str(file), 2)  # two pieces of each episode
    expected = torch.cat([swung["state"][:, :3], swung["state"][:, 2:]])
    assert len(found) == 8 and bool(found["action"].isfinite().all()) and bool(found["state"].isfinite().all())
    assert {tuple(piece.flatten().tolist()) for piece in found["state"]} <= {
        tuple(piece.flatten().tolist()) for piece in expected
    }
    write_tensors(file, {"state": episodes["state"]})
    with pytest.raises(ValueError, match="has no action: it is not a file of episodes"):
        extra_trajectories(str(file), 2)


def test_models_that_are_slow_to_simulate_have_fewer_trajectories_by_default():
    legs = "".join(f'<body pos="{i} 0 1"><joint axis="0 1 0"/><geom size=".1"/></body>' for i in range(17))
    counts = [
        training_data._default_count(load_scene(each))
        for each in (
            "pendulum",
            "swimmer20",
            f"<mujoco><worldbody>{legs}</worldbody></mujoco>",
            "tests/zoo/servo_arm.xml",
        )
    ]
    assert counts == [10_000, 10_000, 4_000, 10_000]
