"""Every file that is read again, damaged in every region: refused by name, or read as it was."""

from __future__ import annotations

import random
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.atomic import read_json, write_json
from torchrl_gn.data import create_dataset, load_dataset, open_tensors, save_tensors
from torchrl_gn.data.dataset_files import DatasetError
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained, save_checkpoint
from torchrl_gn.training.csv_log import CsvLog
from torchrl_gn.training.tensor_files import load_tensors, write_tensors

from .damage import DAMAGES, damage

PLACES, MOST = 18, 200  # places of each damage in a file, and tries of a kind of files
PENDULUM = load_scene("pendulum")
NUMBERS = {"error": 0.125, "steps": 7, "of": [1.5]}
GENERATOR = torch.Generator().manual_seed(0)
TENSORS = TensorDict(
    {"state": torch.rand(4, 3, generator=GENERATOR), "inner": {"action": torch.rand(4, 2, generator=GENERATOR)}}, [4]
)


@dataclass(frozen=True)
class Kind:
    """Files of a kind in a folder: how they are written, and read.

    Attributes:
        unseen: damages that their format cannot show.
    """

    write: Callable[[Path], object]
    read: Callable[[Path], Any]
    unseen: tuple[str, ...] = ()


def _write_checkpoint(folder: Path) -> None:
    torch.manual_seed(0)
    model = ForwardModel.for_scene(PENDULUM, hidden=4, latent=2, layers=1)
    save_checkpoint(folder / "c.safetensors", model, scene=PENDULUM, training={"step": 3, "best": torch.ones(3)})


def _read_checkpoint(folder: Path) -> Any:
    found = load_pretrained(folder / "c.safetensors")
    return dict(found.model.state_dict()), found.model.description(), found.scene_descriptions, found.training


def _read_tensors(folder: Path) -> Any:
    return load_tensors(folder / "gn.safetensors")


def _read_dataset(folder: Path) -> Any:
    found = load_dataset(folder / "d", PENDULUM)
    return [getattr(found, split).to_dict() for split in ("train", "validation", "test")], found.manifest


def _write_tensors(folder: Path) -> None:
    TENSORS.memmap(str(folder / "d"))


OPTIONS = "# A run of mpc\nsystem: pendulum\nseed: 0\nlr: 0.001\ngn:\n  samples: 64\n  noise: 0.25\nplanner:\n- gn\n"


def _read_config(folder: Path) -> Any:
    from _common.run import read_config
    from torchrl_gn.training.run_folder import plain_config

    found = plain_config(read_config(folder / "config.yaml"))
    if found != {"system": "pendulum", "seed": 0, "lr": 0.001, "gn": {"samples": 64, "noise": 0.25}, "planner": ["gn"]}:
        raise ValueError("config.yaml: other options")  # as RunFolder.refuse_changes says
    return found


def _write_log(folder: Path) -> None:
    log = CsvLog(folder / "numbers.csv")
    for step in range(9):
        log.log({"loss": 1 / (1 + step)}, step)


def _read_log(folder: Path) -> None:
    """Append to the log: nothing reads it, but logging must continue."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        CsvLog(folder / "numbers.csv").log({"loss": 1.0}, 99)
        warnings.simplefilter("error")
        CsvLog(folder / "numbers.csv")


KINDS = {
    "checkpoint": Kind(_write_checkpoint, _read_checkpoint),
    "episodes": Kind(
        lambda folder: write_tensors(folder / "gn.safetensors", {"state": torch.ones(2, 3), "action": torch.ones(2)}),
        _read_tensors,
    ),
    "data set": Kind(
        lambda folder: create_dataset(folder / "d", PENDULUM, 4, 2, 2, steps=3, variants=2), _read_dataset
    ),
    "folder of tensors": Kind(
        lambda folder: save_tensors(folder / "d", TENSORS), lambda folder: open_tensors(folder / "d").to_dict()
    ),
    "folder of another program": Kind(  # without checksums
        _write_tensors,
        lambda folder: open_tensors(folder / "d").to_dict(),
        tuple(how for how in DAMAGES if how.startswith(("flipped", "zeroed"))),
    ),
    "numbers": Kind(
        lambda folder: write_json(folder / "metrics.json", NUMBERS, checked=True),
        lambda folder: {name: read_json(folder / "metrics.json")[name] for name in NUMBERS},
    ),
    "options": Kind(lambda folder: (folder / "config.yaml").write_text(OPTIONS), _read_config),
    "log": Kind(_write_log, _read_log),
}


def same(first: Any, second: Any) -> bool:
    if isinstance(first, torch.Tensor):
        return first.dtype == second.dtype and torch.equal(first, second)
    if isinstance(first, Mapping):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, (list, tuple)):
        return len(first) == len(second) and all(map(same, first, second))
    return bool(first == second)


@pytest.mark.parametrize("name", KINDS)
def test_damaged_files_are_refused_by_name_or_read_as_they_were(name, tmp_path):
    kind, draw = KINDS[name], random.Random(name)
    kind.write(tmp_path)
    expected = kind.read(tmp_path)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".lock")
    tries = [(file, how) for file in files for how in DAMAGES if how not in kind.unseen for _ in range(PLACES)]
    refused = 0
    for file, how in draw.sample(tries, min(len(tries), MOST)):
        before = file.read_bytes()
        if damage(file, how, draw):
            try:
                found = kind.read(tmp_path)
            except (ValueError, OSError, DatasetError) as error:
                assert file.name in str(error), f"{file} {how}: {error!r}"
                refused += 1
            else:
                assert same(expected, found), f"{file} {how}: other numbers"
        if file.is_dir():
            file.rmdir()
        file.write_bytes(before)
    assert refused or name == "log"
