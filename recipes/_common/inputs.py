"""Checksums of the files that a run learns from, so that a resumed run has the same data."""

from __future__ import annotations

import hashlib
from pathlib import Path

from _common.options import as_list
from torchrl_gn.atomic import read_json, write_json
from torchrl_gn.training import RunFolder

INPUTS_FILE = "inputs.json"
_PART = 1 << 20  # bytes that are read at once
_DATA = (".json", ".jsonl", ".parquet", ".memmap")  # files of folders that hold numbers; others are videos


def keep_inputs(run: RunFolder, *, resumed: bool, **sources: object) -> None:
    """Write the checksums of a run's data files and folders to its ``inputs.json``, or compare a resumed run's.

    Other data of the same name would be split anew: what the model was trained on would become test data.

    Args:
        run: the run's folder.
        resumed: the run has a trained model.
        sources: paths, single or in lists, by option, with ``__`` for a dot; None: no files.

    Raises:
        ValueError: if files of a resumed run have changed.
    """
    now = {}
    for option, paths in sources.items():
        sums = [_checksum(Path(str(path))) for path in as_list(paths)]
        if sums:
            now[option.replace("__", ".")] = sums
    file = run.path / INPUTS_FILE
    if resumed and file.is_file():
        before = read_json(file)
        for option, sums in now.items():
            if before.get(option, sums) != sums:
                raise ValueError(
                    f"run_dir={run.path} holds a run on other data: {option}= has changed since. Name a new run_dir."
                )
    if now:
        write_json(file, now, checked=True)


def _checksum(path: Path) -> str:
    """Return the checksum of a file, or of the names and contents of a folder's data files."""
    digest = hashlib.sha256()
    folder = path.is_dir()
    files = sorted(file for file in path.rglob("*") if file.suffix in _DATA) if folder else [path]
    for file in files:
        if folder:
            digest.update(f"{file.relative_to(path).as_posix()}\n".encode())
            digest.update(f"{file.stat().st_size}\n".encode())
        with file.open("rb") as opened:
            while part := opened.read(_PART):
                digest.update(part)
    return digest.hexdigest()
