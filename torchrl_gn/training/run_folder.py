"""Folder of a run: the only place that a recipe writes to."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

from filelock import FileLock, Timeout

from torchrl_gn.atomic import atomic_path, remove_leftovers, write_json
from torchrl_gn.processor import instruction_sets, processor_name, restrictions
from torchrl_gn.training.checkpoint import CHECKPOINT_FILE, package_versions

CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.json"
LOCK_FILE = ".lock"  # locked by the process that runs in the folder
_RECIPE = "# A run of "  # start of the first line of CONFIG_FILE, before the recipe's name


def plain_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Convert a configuration, of Hydra or not, to dictionaries, lists and plain values; resolve references."""
    return {str(name): _plain(value) for name, value in config.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return plain_config(value)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(entry) for entry in value]
    return value


class RunFolder:
    """Folder with a run's configuration, metrics, checkpoint, figures and videos; an existing one is resumed.

    The default path is ``runs/<name>/<time>``. The folder is locked until this process ends or calls :meth:`release`.
    Temporary files of processes that were killed while writing to it are removed.

    Raises:
        ValueError: the folder holds a run of another recipe, or is in use by another process.
    """

    _latest: ClassVar[RunFolder | None] = None
    _locks: ClassVar[dict[Path, FileLock]] = {}  # held by this process

    def __init__(self, path: str | os.PathLike | None, name: str) -> None:
        self.path = Path(path) if path else _new_folder(Path("runs") / name)
        if self.path.exists() and not self.path.is_dir():
            raise NotADirectoryError(f"run_dir={self.path} is a file; name a folder.")
        self.name, config = name, self.path / CONFIG_FILE
        first = config.read_text(errors="replace").partition("\n")[0] if config.exists() else ""
        if first.startswith(_RECIPE) and (other := first.removeprefix(_RECIPE)) != name:
            raise ValueError(f"run_dir={self.path} holds a run of {other}, not of {name}. Name a new run_dir.")
        self.path.mkdir(parents=True, exist_ok=True)
        if (place := self.path.resolve()) not in self._locks and (lock := lock_folder(place)) is not None:
            self._locks[place] = lock
        # Remove all leftovers from a run's folder; from another folder, only those of a run killed in its first write.
        remove_leftovers(self.path, target=None if first.startswith(_RECIPE) else config)
        self._start = time.perf_counter()
        self._written: list[Path] = []
        RunFolder._latest = self

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        RunFolder._latest = self  # for the processes that share the folder of rank 0

    @classmethod
    def release(cls) -> None:
        """Unlock this process's folders."""
        while cls._locks:
            cls._locks.popitem()[1].release(force=True)

    @classmethod
    def what_is_kept(cls) -> str:
        """Describe what an interrupted run leaves in this process's latest folder, and how to resume."""
        run = cls._latest
        if run is None or not any(path.name not in (CONFIG_FILE, LOCK_FILE) for path in run.path.glob("*")):
            return "nothing was kept."
        return f"progress is saved in {run.path}; resume with run_dir={run.path}."

    @property
    def checkpoint(self) -> Path:
        return self.path / CHECKPOINT_FILE

    @property
    def data(self) -> Path:
        return self.path / "data"

    def file(self, name: str) -> Path:
        """Return the path of a file, and list it in :attr:`written`."""
        path = self.path / name
        if path not in self._written:
            self._written.append(path)
        return path

    @property
    def written(self) -> list[Path]:
        """Paths that :meth:`file` returned, in order, if the files exist."""
        return [path for path in self._written if path.exists()]

    def refuse_changes(self, before: Mapping[str, Any], now: Mapping[str, Any], *, free: Collection[str]) -> None:
        """Refuse a resumed run that changes options.

        Args:
            before: options of the run so far.
            now: options of the resumed run.
            free: options that may change: ``"data.folder"`` is one option of a group, ``"data"`` the whole group.

        Raises:
            ValueError: if other options change; the message names them.
        """
        old, new = _flat(plain_config(before)), _flat(plain_config(now))
        changed = [
            f"{name}={new.get(name)} (was {old.get(name)})"
            for name in sorted(old.keys() | new.keys())
            if old.get(name) != new.get(name) and not {name, name.split(".")[0]} & set(free)
        ]
        if changed:
            raise ValueError(
                f"run_dir={self.path} holds a run with other options: {', '.join(changed)}. To resume it,"
                " repeat its options (its config.yaml lists them); for another run, name a new run_dir."
            )

    def write_config(self, text: str) -> None:
        """Write ``config.yaml``: the recipe's name, then ``text``; delete old metrics, as the run continues."""
        (self.path / METRICS_FILE).unlink(missing_ok=True)
        with atomic_path(self.file(CONFIG_FILE)) as temporary:
            temporary.write_text(f"{_RECIPE}{self.name}\n{text}")

    def write_metrics(self, metrics: Mapping[str, Any], *, seed: int) -> dict[str, Any]:
        """Write ``metrics.json``, with processor, versions, seed and seconds; NaN and infinity become null."""
        everything = {
            **{k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in metrics.items()},
            "seed": seed,
            "wall_clock_seconds": round(time.perf_counter() - self._start, 3),
            "processor": ", ".join([processor_name(), instruction_sets(), *restrictions()]),
            **{f"version/{name}": version for name, version in package_versions().items()},
        }
        write_json(self.file(METRICS_FILE), everything, checked=True)
        return everything


def lock_folder(path: Path, *, seconds: float = 0.0) -> FileLock | None:
    """Lock a run folder for this process, waiting up to ``seconds`` for it; the lock ends with the process.

    Return None on a file system without locks.

    Raises:
        ValueError: another process holds the lock.
    """
    lock = FileLock(path / LOCK_FILE)
    try:
        lock.acquire(timeout=seconds)
    except Timeout:
        raise ValueError(
            f"run_dir={path} is in use by another process; wait for its end, or name a new run_dir."
        ) from None
    except NotImplementedError:
        return None
    return lock


def _new_folder(parent: Path) -> Path:
    """Make a folder named by the time, with a number if one from the same second exists."""
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
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat
