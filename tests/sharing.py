"""Paths that another user could have written."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

SHARED = ["group", "all", "another's"]


def share(path: Path, how: str, monkeypatch: pytest.MonkeyPatch, *, user: int = 65534) -> None:
    """Let the group or all write a path, or let it look like another user's."""
    if how != "another's":
        path.chmod(path.stat().st_mode | {"group": 0o020, "all": 0o002}[how])
        return
    itself = os.lstat(path)

    def owned_by(found: os.stat_result) -> os.stat_result:
        return os.stat_result([*found[:4], user, *found[5:10]]) if os.path.samestat(found, itself) else found

    for name in ("fstat", "lstat"):
        look = getattr(os, name)
        monkeypatch.setattr(os, name, lambda at, look=look, **options: owned_by(look(at, **options)))
