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

_CHECKSUM = "sha256"  # key of the checksum in JSON files
_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{8}(\.[^.]*)?")  # names of atomic_path's temporary files


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path, with the same suffix, that replaces ``path`` if the block succeeds.

    A link stays, and the file that it leads to is replaced. Makes missing parent folders. Flushes the file to disk
    before the rename and its folder afterwards, so that a power cut leaves the old file or the new one. If the block
    fails, ``path`` is unchanged.

    Raises:
        OSError: if there is no space; the message names the path and the remedy.
    """
    path = Path(path)
    target = path.resolve()
    _make_folder(target.parent)
    # The suffix of the given name, from which writers find the format.
    temporary = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        with naming_full_disk(path):
            yield temporary
            # Some writers deny access to others: give the file the user's default mode.
            os.umask(mask := os.umask(0))
            temporary.chmod(0o666 & ~mask)
            _sync(temporary)
            os.replace(temporary, target)
            sync_folder(target.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def naming_full_disk(path: Path) -> Iterator[None]:
    """Add ``path`` to the error if disk space runs out in the block, which must write ``path`` atomically."""
    try:
        yield
    except OSError as error:
        if error.errno in NO_SPACE and str(path) not in str(error):
            raise OSError(
                error.errno,
                f"{path} cannot be written: {os.strerror(error.errno)}. The old file is unchanged; free some space"
                " and run the same again",
            ) from error
        raise


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries, the names of its files, to disk."""
    try:
        _sync(folder)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that cannot sync folders, or need not
            raise


def sync_all(folder: Path) -> None:
    """Flush a folder's whole content and its own name to disk."""
    for path in folder.rglob("*"):
        sync_folder(path) if path.is_dir() else _sync(path)
    sync_folder(folder)
    sync_folder(folder.parent)


def remove_leftovers(folder: str | os.PathLike, *, target: Path | None = None) -> list[Path]:
    """Remove temporary files that killed processes left in a folder or its subfolders; return their paths.

    If ``target`` is given, remove only the leftovers of that file, or of the file that this link leads to, from its own
    folder. No other process may be writing there.
    """
    if target is None:
        candidates = Path(folder).rglob(".*")
    else:
        place = target.resolve()
        candidates = place.parent.glob(f".{place.stem}.*{target.suffix}")
    leftovers = [path for path in candidates if _TEMPORARY.fullmatch(path.name) and path.is_file()]
    for path in leftovers:
        path.unlink(missing_ok=True)
    return leftovers


def write_json(path: str | os.PathLike, values: Any, *, checked: bool = False) -> None:
    """Write plain values as indented JSON, atomically; raise ValueError for NaN and infinity.

    If ``checked``, append a checksum to the dictionary ``values``; meant for numbers that results are computed from.
    """
    try:
        more = {_CHECKSUM: _digest(values)} if checked else {}
        text = json.dumps({**values, **more} if checked else values, indent=2, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; JSON holds finite numbers only.") from error
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n")


def read_json(path: str | os.PathLike) -> Any:
    """Read a file of :func:`write_json`; raise ValueError, naming the file, if it is damaged."""
    try:
        return parse_json(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}); delete it, and repeat the run that made it.") from error


def parse_json(text: str) -> Any:
    """Parse the text of :func:`write_json`; raise ValueError for invalid JSON or a wrong checksum (if it has one)."""
    values = json.loads(text)
    if isinstance(values, dict) and _CHECKSUM in values and values.pop(_CHECKSUM) != _digest(values):
        raise ValueError("checksum differs")
    return values


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, allow_nan=False).encode()).hexdigest()


def _make_folder(folder: Path) -> None:
    """Make a folder and its missing parents; flush their names to disk, so that a power cut does not lose them."""
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
