"""Atomic writes: a file is complete and on disk, or unchanged."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # a full disk, a quota, a limit on the size of files

_CHECKSUM = "sha256"  # an entry of JSON files
_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{8}(\.[^.]*)?")  # names of atomic_path's temporary files


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path, with the same suffix, that replaces ``path`` if the block succeeds.

    Makes missing parent folders. The file is on disk before it takes the name, and its folder after, so that a power
    cut leaves the old file or the new one. If the block fails, ``path`` is unchanged.

    Raises:
        OSError: if there is no space, with the path and what to do.
    """
    path = Path(path)
    _make_folder(path.parent)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        with naming_full_disk(path):
            yield temporary
            # Some writers deny access to others: give the file the user's default mode.
            os.umask(mask := os.umask(0))
            temporary.chmod(0o666 & ~mask)
            _sync(temporary)
            os.replace(temporary, path)
            sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def naming_full_disk(path: Path) -> Iterator[None]:
    """Let an OSError of the block, if there is no space, name the path that is written whole or not at all."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_SPACE and str(path) not in str(error):
            raise OSError(
                error.errno,
                f"{path} cannot be written: {os.strerror(error.errno)}. What was there is as it was; make room and run"
                " the same again",
            ) from error
        raise


def sync_folder(folder: Path) -> None:
    """Wait until the names of a folder's files are on disk."""
    try:
        _sync(folder)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that cannot, or need not
            raise


def sync_all(folder: Path) -> None:
    """Wait until all that is in a folder is on disk, and its name."""
    for path in folder.rglob("*"):
        sync_folder(path) if path.is_dir() else _sync(path)
    sync_folder(folder)
    sync_folder(folder.parent)


def remove_leftovers(folder: str | os.PathLike, *, of: Path | None = None) -> list[Path]:
    """Remove the temporary files that killed processes left in a folder and those in it; return their paths.

    ``of`` one file only, if it is given. Nobody else may be writing there.
    """
    found = Path(folder).rglob(".*") if of is None else of.parent.glob(f".{of.stem}.*{of.suffix}")
    left = [path for path in found if _TEMPORARY.fullmatch(path.name) and path.is_file()]
    for path in left:
        path.unlink(missing_ok=True)
    return left


def write_json(path: str | os.PathLike, values: Any, *, checked: bool = False) -> None:
    """Write plain values as indented JSON, atomically; raise ValueError for NaN and infinity.

    ``checked``: add a last entry to a dictionary, its checksum, for numbers that results are made of.
    """
    try:
        more = {_CHECKSUM: _digest(values)} if checked else {}
        text = json.dumps({**values, **more} if checked else values, indent=2, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; JSON holds finite numbers only.") from error
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n")


def read_json(path: str | os.PathLike) -> Any:
    """Read what :func:`write_json` wrote; raise ValueError, naming the file, if it is damaged."""
    try:
        return parse_json(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); delete it, and run again what made it.") from error


def parse_json(text: str) -> Any:
    """Parse the text of such a file; raise ValueError if it is no JSON, or not as its checksum, if it has one."""
    values = json.loads(text)
    if isinstance(values, dict) and _CHECKSUM in values and values.pop(_CHECKSUM) != _digest(values):
        raise ValueError("checksum differs")
    return values


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, allow_nan=False).encode()).hexdigest()


def _make_folder(folder: Path) -> None:
    """Make a folder and its missing parents, with names that a power cut does not lose."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for each in reversed(missing):
        sync_folder(each.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
