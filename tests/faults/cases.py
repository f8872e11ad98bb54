"""Smallest runs of recipes that write and resume, and the files of their run folders."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_gn.training.tensor_files import read_tensors


@dataclass(frozen=True)
class Case:
    """A run of a recipe.

    Attributes:
        options: ``PREPARED`` stands for a folder in which :data:`PREPARATION` was run.
        settings: constants of the recipe's module.
    """

    recipe: str
    options: tuple[str, ...]
    settings: dict[str, Any] = field(default_factory=dict)


_DATA = ("data.train=20", "data.validation=5", "data.test=5")
_MODEL = ("model.hidden=8", "+model.latent=4")
_OFTEN = ("checkpoint_seconds=0", "logger=csv")
_PLANNING = ("horizon=2", "gn.warm_up=1", "gn.samples=2", "gn.iterations=1", "video=false")
_LEARNING = ("num_envs=2", "evaluate_episodes=1", "task.steps=20", "trainer.frames_per_batch=20", "trainer.frames=120")
_LEARNING += ("trainer.random_frames=40", "trainer.evaluate_frames=40", "trainer.batch_size=16")
_LEARNING += ("trainer.updates_per_frame=0.1", "trainer.compile=false")


def _quoted(*options: str) -> str:
    return "[" + ",".join(f"'{option}'" for option in options) + "]"


PREPARED = "PREPARED"
PREPARATION = Case("mpc", ("system=pendulum", "planner=gn", "steps=60", "episodes=3", *_PLANNING))
CASES = {
    case.recipe: case
    for case in (
        Case("forward_model", ("system=pendulum", *_DATA, *_MODEL, *_OFTEN, "threads=1", "steps=12",
             "unroll_fraction=0.3", "noise=1e-3")),
        Case("inference_model", (*_DATA, *_MODEL, *_OFTEN, "steps=6", "context_length=5", "test.systems=8",
             "test.steps=[1,5]")),
        Case("contacts", (*_MODEL, *_OFTEN, "steps=10", "length=20", "window=10",
             "episodes={train: 5, validation: 2, test: 2}")),
        Case("real_robot", (*_MODEL, *_OFTEN, "steps=5", "simulated.episodes=12", "simulated.steps=40", "length=30",
             "burn_in=5", "share={validation: 0.1, test: 0.1}", "horizons=[1,10]")),
        Case("shac", ("system=pendulum", "reward=balance", "timestep=null", "first.trajectories=4", "first.length=50",
             "first.steps=5", "updates=3", "batch_size=8", "horizon=3", "hidden=[8]", "episodes=2", "steps=50",
             "model_steps=3", "model={hidden:8,latent:8}", "evaluate.episodes=2", "evaluate.steps=20", "rounds=3",
             "logger=csv")),
        Case("mpc", ("system=pendulum", "planner=[random,gn,cem]", "steps=12", "episodes=2", "gn.candidates=2",
             "cem.iterations=1", "cem.candidates=4", "cem.top_k=2", *_PLANNING, "video=true"), {"SAVE_SECONDS": 0}),
        Case("value", (f"episodes=[{PREPARED}/run/gn.safetensors]", "hidden=[8]", "fit.iterations=2", "fit.steps=3",
             "imitate.steps=5", "logger=csv")),
        Case("svg", ("horizon=1", "model_lr=1e-3", *_LEARNING, *_OFTEN)),
        Case("ddpg", (*_LEARNING, *_OFTEN)),
        Case("compare", ("systems=[pendulum]", "seeds=[0]", "only=[default,MLP]", "minutes=null", "steps=5",
             f"overrides={_quoted(*_DATA, 'model.hidden=8', 'checkpoint_seconds=0')}")),
        Case("mlp_baseline", ("systems=[pendulum]", "sizes=[[1,8]]", "optimizers=[['optimizer=muon']]", "keep=1",
             "seeds=[0]", f"overrides={_quoted(*_DATA, 'model.hidden=8', 'minutes=null', 'steps=3')}")),
        Case("data_shift", ("system=swimmer3", "seeds=[0]", "swimming={train: 10, test: 3}", "sequences=3",
             "random={train: 20, validation: 5, test: 5}",
             "search={generations: 1, population: 4, starts: 1, steps: 20}", "mlp=['model.hidden=[8]']",
             f"overrides={_quoted('model.hidden=8', 'minutes=null', 'steps=3')}")),
        Case("plan_and_learn", ("system=pendulum", "rounds=1", "episodes=2", "steps=100", "value=true", "policy=true",
             f"planning={_quoted(*_PLANNING)}", f"training={_quoted(*_DATA, 'minutes=null', 'steps=3')}",
             f"valuing={_quoted('hidden=[8]', 'fit.iterations=2', 'fit.steps=3', 'imitate.steps=5')}")),
        Case("learning_curves", ("only=[DDPG]", "seeds=[0,1]", f"overrides={_quoted(*_LEARNING)}")),
    )
}  # fmt: skip

_TIMES = re.compile(r"seconds|minutes|share|wall_clock|spent|_ms\b|_ms_|per_second|ms_first")
_UNLIKE = re.compile(r"\.lock|log\.txt|table\.md")  # tables show times


def numbers_of(place: Path) -> dict[str, Any]:
    """All that the run folder in a working folder holds, by file and name, but for times."""
    folder, found = place / "run", {}
    for file in sorted(folder.rglob("*")):
        if not file.is_file() or _UNLIKE.search(file.name):
            continue
        name = file.relative_to(folder).as_posix()
        found[name] = True
        for key, value in _content(file, str(place.resolve())):
            if not _TIMES.search(key) and key != "sha256":
                found[f"{name}: {key}"] = value
    return found


def _content(file: Path, place: str) -> Iterator[tuple[str, Any]]:
    if file.suffix == ".safetensors":
        tensors, _ = read_tensors(file)
        if (text := tensors.pop("description", None)) is not None:
            yield from _flat(json.loads(text.numpy().tobytes().decode().replace(place, "")))
        for name, value in tensors.items():
            numbers = value.contiguous().flatten().view(-1).numpy().tobytes()
            yield name, (str(value.dtype), list(value.shape), hashlib.sha256(numbers).hexdigest())
    elif file.suffix == ".json":
        yield from _flat(json.loads(file.read_text().replace(place, "")))
    elif file.suffix == ".csv":
        with file.open(newline="") as rows:
            for row in csv.DictReader(rows):
                yield from ((f"{row['step']}.{name}", value) for name, value in row.items())
    else:
        yield "content", hashlib.sha256(file.read_bytes().replace(place.encode(), b"")).hexdigest()


def _flat(values: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(values, dict) and values.keys() == {"dict"}:  # nested state in a checkpoint: pairs
        values = {str(key): value for key, value in values["dict"]}
    if isinstance(values, (dict, list)):
        for key, value in values.items() if isinstance(values, dict) else enumerate(values):
            yield from _flat(value, f"{name}.{key}".lstrip("."))
    else:
        yield name, values


def differences(whole: dict[str, Any], resumed: dict[str, Any]) -> list[str]:
    """Names of the entries that differ."""
    return sorted(name for name in whole.keys() | resumed.keys() if whole.get(name) != resumed.get(name))
