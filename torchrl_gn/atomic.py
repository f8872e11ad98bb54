"""Write a file completely or not at all."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that replaces it once the block succeeds.

    The temporary file keeps the suffix, from which writers tell the format.
    Missing parent folders are made. If the block fails, ``path`` stays as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield temporary
        # Some writers keep others out; a file is as readable as any that the user writes.
        temporary.chmod(_mode())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _mode() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask


def write_json(path: str | os.PathLike, values: Any) -> None:
    """Write plain values as indented JSON, atomically; NaN and Inf are refused by name."""
    try:
        text = json.dumps(values, indent=2, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; JSON holds finite numbers only.") from error
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n")
