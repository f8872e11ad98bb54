"""The folder that a recipe writes to, and nothing else."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Collection, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

from torchrl_gn.atomic import atomic_path, write_json
from torchrl_gn.processor import instruction_sets, processor_name, restrictions
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE, package_versions
from torchrl_gn.training.config import plain_config

CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.json"
_RECIPE = "# A run of "  # begins that file, and the recipe's name


class RunFolder:
    """A run's folder: configuration, metrics, checkpoint, figures and videos.

    A folder that already holds a run is continued.

    Args:
        path: the folder; by default ``runs/<name>/<time>``.
        name: name of the recipe.

    Raises:
        NotADirectoryError: if ``path`` is a file.
        ValueError: if it holds a run of another recipe, which would be written over.
    """

    _latest: ClassVar[RunFolder | None] = None

    def __init__(self, path: str | os.PathLike | None, name: str) -> None:
        self.path = Path(path) if path else _new_folder(Path("runs") / name)
        if self.path.exists() and not self.path.is_dir():
            raise NotADirectoryError(f"run_dir={self.path} is a file; name a folder.")
        self.name = name
        self._refuse_another_recipe()
        self.path.mkdir(parents=True, exist_ok=True)
        self._start = time.perf_counter()
        self._written: list[Path] = []
        RunFolder._latest = self

    def _refuse_another_recipe(self) -> None:
        config = self.path / CONFIG_FILE
        first = config.read_text().partition("\n")[0] if config.exists() else ""
        if first.startswith(_RECIPE) and first != _RECIPE + self.name:
            other = first.removeprefix(_RECIPE)
            raise ValueError(f"run_dir={self.path} holds a run of {other}, not of {self.name}. Name a new run_dir.")

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        RunFolder._latest = self  # of workers that share the first one's

    @classmethod
    def what_is_kept(cls) -> str:
        """What a run that stops now leaves in this process's latest folder, as a person is told."""
        run = cls._latest
        if run is None or not any(path.name != CONFIG_FILE for path in run.path.glob("*")):
            return "nothing was kept."
        return f"what was done is in {run.path}, and run_dir={run.path} goes on from there."

    @property
    def checkpoint(self) -> Path:
        """Where the run's checkpoint lies."""
        return self.path / CHECKPOINT_FILE

    @property
    def data(self) -> Path:
        """Where the run keeps data that it collects."""
        return self.path / "data"

    def file(self, name: str) -> Path:
        """Path of a file of this run, listed in :attr:`written`."""
        path = self.path / name
        if path not in self._written:
            self._written.append(path)
        return path

    @property
    def written(self) -> list[Path]:
        """Files of this run that exist, in the order they were asked for."""
        return [path for path in self._written if path.exists()]

    def refuse_changes(self, before: Mapping[str, Any], now: Mapping[str, Any], *, free: Collection[str]) -> None:
        """Refuse to continue a run with options that would make it another run.

        Args:
            before: configuration that the run was begun with.
            now: configuration that it is to go on with.
            free: names of options that may differ, for example ``"minutes"``, ``"data.folder"`` or all of ``"data"``.

        Raises:
            ValueError: naming every other option that differs.
        """
        old, new = _flat(plain_config(before)), _flat(plain_config(now))
        changed = [
            f"{name}={new.get(name)} (was {old.get(name)})"
            for name in sorted(old.keys() | new.keys())
            if old.get(name) != new.get(name) and not {name, name.split(".")[0]} & set(free)
        ]
        if changed:
            raise ValueError(
                f"run_dir={self.path} holds a run with other options: {', '.join(changed)}. Name a new run_dir."
            )

    def write_config(self, text: str) -> None:
        """Write ``config.yaml``, with the recipe's name in its first line."""
        with atomic_path(self.file(CONFIG_FILE)) as temporary:
            temporary.write_text(f"{_RECIPE}{self.name}\n{text}")

    def write_metrics(self, metrics: Mapping[str, Any], *, seed: int) -> dict[str, Any]:
        """Write ``metrics.json``: flat names and plain numbers, processor, versions, seed and seconds.

        JSON has no infinity: a number that is not finite (the error of a diverged
        rollout) is written as null.

        Returns:
            What was written.
        """
        numbers = {key: _plain(value) for key, value in metrics.items()}
        everything = {
            **numbers,
            "seed": seed,
            "wall_clock_seconds": round(time.perf_counter() - self._start, 3),
            "processor": ", ".join([processor_name(), instruction_sets(), *restrictions()]),
            **{f"version/{name}": version for name, version in package_versions().items()},
        }
        write_json(self.file(METRICS_FILE), everything)
        return everything


def _new_folder(parent: Path) -> Path:
    """A folder named by the time; of two that begin in one second, the later is the next one."""
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    path, number = parent / name, 1
    while True:
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            number += 1
            path = parent / f"{name}_{number}"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = value
    return flat


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
