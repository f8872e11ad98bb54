"""Ways in which a file is damaged, by a power cut, a full disk, a bad disk or a hand."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

_EDGE = 64  # bytes of the head and the end


def _cut(path: Path, keep: int) -> None:
    path.write_bytes(path.read_bytes()[:keep])


def _flip(path: Path, place: int, draw: random.Random) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1 << draw.randrange(8)
    path.write_bytes(content)


def _zero(path: Path, draw: random.Random) -> None:
    content = bytearray(path.read_bytes())
    first = draw.randrange(len(content))
    last = min(len(content), first + draw.randrange(1, 600))
    content[first:last] = bytes(last - first)
    path.write_bytes(content)


def _replace(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _head(size: int, draw: random.Random) -> int:
    return draw.randrange(min(size, _EDGE))


def _end(size: int, draw: random.Random) -> int:
    return size - 1 - draw.randrange(min(size, _EDGE))


DAMAGES: dict[str, Callable[[Path, int, random.Random], object]] = {
    "emptied": lambda path, size, draw: _cut(path, 0),
    "cut in its head": lambda path, size, draw: _cut(path, _head(size, draw)),
    "cut in the middle": lambda path, size, draw: _cut(path, draw.randrange(size)),
    "cut at its end": lambda path, size, draw: _cut(path, _end(size, draw)),
    "lengthened": lambda path, size, draw: path.write_bytes(path.read_bytes() + draw.randbytes(draw.randrange(1, 99))),
    "flipped in its head": lambda path, size, draw: _flip(path, _head(size, draw), draw),
    "flipped in the middle": lambda path, size, draw: _flip(path, draw.randrange(size), draw),
    "flipped at its end": lambda path, size, draw: _flip(path, _end(size, draw), draw),
    "zeroed in part": lambda path, size, draw: _zero(path, draw),
    "replaced by a folder": lambda path, size, draw: _replace(path),
    "missing": lambda path, size, draw: path.unlink(),
}


def damage(path: Path, how: str, draw: random.Random) -> bool:
    """Damage a file at a random place; return False if the file stays the same, such as an empty one."""
    before = path.read_bytes()
    if not before:
        return False
    DAMAGES[how](path, len(before), draw)
    return not path.is_file() or path.read_bytes() != before
