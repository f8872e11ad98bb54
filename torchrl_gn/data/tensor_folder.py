"""Folders of memory-mapped TensorDicts: reading without pickle or changes to files, writing with checked disk space."""

from __future__ import annotations

import json
import math
import os
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, is_leaf_nontensor
from torch import Tensor

from torchrl_gn.atomic import naming_full_disk, read_json, sync_all, write_json

_DTYPES = {
    str(dtype): dtype
    for dtype in (
        *(torch.float64, torch.float32, torch.float16, torch.bfloat16),
        *(torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool),
    )
}
_LAYOUT, _SUMS = "meta.json", "checksums.json"
_UNFINISHED: dict[str, int] = {}  # checksums of a folder that is being written
_LARGEST = 2**20  # bytes of a layout, which has an entry per tensor
_NAME = r"\w[\w.-]*"  # of a tensor or folder
_TAKEN = {"device", "shape", "_type", _LAYOUT, _SUMS}  # entries of a layout, and files
_DEEPEST = 20  # nesting of folders, and number of dimensions


def open_tensors(folder: str | os.PathLike) -> TensorDict:
    """Map the tensors of a folder that ``TensorDict.memmap`` wrote, copy-on-write: its files never change.

    ``TensorDict.load_memmap`` would run the code of pickles in the folder, and lengthen files that are too short.

    Raises:
        ValueError: if the folder holds anything but tensors, or a file is missing, has another size than its tensor, or
            does not match its checksum (of :func:`save_tensors`).
    """
    folder = Path(folder)
    if (folder / _SUMS).is_file():
        _check_sums(folder)
    _, batch = _layout(folder)
    return TensorDict(dict(_tensors(folder, batch, ())), batch_size=batch)


def save_tensors(folder: str | os.PathLike, data: TensorDict) -> None:
    """Write tensors with checksums to a folder for :func:`open_tensors`, replacing old ones.

    Raises:
        ValueError: if :func:`open_tensors` could not read them again; old ones are kept.
        OSError: if the disk has no room; :func:`open_tensors` then refuses the folder until it is written again.
    """
    folder = Path(folder)
    _check_readable(data)
    write_json(folder / _SUMS, _UNFINISHED, checked=True)
    create_tensors(folder, data)
    TensorDict.load_memmap(folder, allow_pickle=False).copy_(data)
    sync_all(folder)
    files = sorted((*folder.rglob("*.memmap"), *folder.rglob(_LAYOUT)))
    write_json(folder / _SUMS, {file.relative_to(folder).as_posix(): _crc32(file) for file in files}, checked=True)


def _check_readable(data: TensorDict) -> None:
    """Raise ValueError, naming it, for an entry that :func:`open_tensors` would refuse."""
    for key, value in data.items(include_nested=True, leaves_only=True, is_leaf=is_leaf_nontensor):
        path = key if isinstance(key, tuple) else (key,)
        if not all(re.fullmatch(_NAME, name, re.ASCII) for name in path) or {*path} & _TAKEN:
            raise ValueError(
                f"{key!r} cannot be the name of a tensor in a folder: take letters, digits, '_', '-', '.'."
            )
        if not isinstance(value, Tensor) or value.dtype not in _DTYPES.values() or value.layout != torch.strided:
            kind = f"{value.dtype}, {value.layout}" if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(f"{key!r} is not a plain tensor of real numbers, but {kind}: leave it out.")


def _check_sums(folder: Path) -> None:
    """Raise ValueError, naming the file, if a file differs from what :func:`save_tensors` wrote."""
    sums = read_json(folder / _SUMS)
    if sums == _UNFINISHED:
        raise ValueError(f"{folder}: writing was interrupted; write it again.")
    for name, expected in sums.items() if isinstance(sums, dict) else [("", None)]:
        if not re.fullmatch(r"\w[\w.-]*(/\w[\w.-]*)*", name):
            raise ValueError(f"{folder / _SUMS}: {name!r} is not a name of a file.")
        file = folder / name
        if not file.is_file() or file.is_symlink():
            raise ValueError(f"{file}: no such file.")
        if _crc32(file) != expected:
            what = f"{file}: its checksum differs: damaged, or written by another program"
            raise ValueError(f"{what} (delete {_SUMS} beside it then).")


def _crc32(file: Path) -> int:
    total = 0
    with open(file, "rb") as stream:
        while part := stream.read(2**24):
            total = zlib.crc32(part, total)
    return total


def create_tensors(folder: Path, like: TensorDict) -> None:
    """Create files for tensors shaped like ``like`` and reserve their disk space; OSError if there is too little.

    Without reserved space, a write to a mapped file could kill the process.
    """
    try:
        like.memmap_like(str(folder))
    except RuntimeError as error:
        if (number := re.search(r"unable to (?:resize|write to|stretch) file .*\((\d+)\)$", str(error))) is None:
            raise
        what = f"{folder} cannot be written: {os.strerror(int(number[1]))}. Make room and run the same again"
        raise OSError(int(number[1]), what) from error
    for file in folder.rglob("*.memmap") if hasattr(os, "posix_fallocate") else ():
        with naming_full_disk(file), open(file, "r+b") as stream:
            os.posix_fallocate(stream.fileno(), 0, file.stat().st_size)


def _tensors(folder: Path, batch: list[int], path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Yield key and tensor of all tensors in a folder and its subfolders."""
    if len(path) > _DEEPEST:
        raise ValueError(f"{folder}: more than {_DEEPEST} nested folders.")
    for name, entry in _layout(folder)[0].items():
        what = f"{folder / _LAYOUT}: {name!r}"
        if not re.fullmatch(_NAME, name):
            raise ValueError(f"{what} is not a name of a tensor: use letters, digits, '_', '-' and '.'.")
        if "type" in entry:
            if entry["type"] != "TensorDict":
                raise ValueError(f"{what} is of type {entry['type']!r}, and only tensors are read: leave it out.")
            if (folder / name).is_symlink():  # a link could lead to its own folder
                raise ValueError(f"{folder / name}: a link, not a folder.")
            yield from _tensors(folder / name, batch, (*path, name))
            continue
        dtype, shape = _DTYPES.get(str(entry.get("dtype"))), _shape(entry)
        if dtype is None or shape is None or shape[: len(batch)] != batch or entry.get("is_nested"):
            described = f"dtype {entry.get('dtype')!r} and shape {entry.get('shape')!r}"
            raise ValueError(f"{what} is not a plain tensor of real numbers {[*batch, '...']}: it has {described}.")
        yield (*path, name), _mapped(folder / f"{name}.memmap", shape, dtype)


def _layout(folder: Path) -> tuple[dict[str, dict], list[int]]:
    """Read a folder's description of its tensors and subfolders, by name, and its batch size."""
    file = folder / _LAYOUT
    if not file.is_file():
        raise ValueError(f"{file}: no such file, so the folder holds no tensors that TensorDict.memmap wrote.")
    if (size := file.stat().st_size) > _LARGEST:
        raise ValueError(f"{file}: {size} bytes are too many for a description of tensors.")
    try:
        metadata = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file}: damaged ({error}).") from error
    kind = metadata.get("_type") if isinstance(metadata, dict) else type(metadata).__name__
    if kind != str(TensorDict):
        raise ValueError(f"{file}: describes {kind}, but only tensors in a TensorDict are read: leave it out.")
    if (batch := _shape(metadata)) is None:
        raise ValueError(f"{file}: damaged ({metadata.get('shape')!r} is not a batch size).")
    return {name: entry for name, entry in metadata.items() if isinstance(entry, dict)}, batch


def _shape(entry: dict[str, Any]) -> list[int] | None:
    """Return the shape of an entry; None if it is not a valid one."""
    shape = entry.get("shape")
    if not isinstance(shape, list) or not all(type(size) is int and size >= 0 for size in shape):
        return None
    # Strides are products of sizes, also of empty tensors, and must not overflow.
    return shape if math.prod(max(size, 1) for size in shape) < 2**60 and len(shape) <= _DEEPEST else None


def _mapped(file: Path, shape: list[int], dtype: torch.dtype) -> Tensor:
    count = math.prod(shape)
    if not count:  # a scene without actuators
        return torch.empty(shape, dtype=dtype, device="cpu")
    if not file.is_file():
        raise ValueError(f"{file}: missing.")
    size, expected = file.stat().st_size, count * dtype.itemsize
    if size != expected:
        raise ValueError(f"{file}: {size} bytes, should be {expected}: truncated or changed.")
    if dtype != torch.bool:
        return torch.from_file(str(file), shared=False, size=count, dtype=dtype).view(shape)
    values = torch.from_file(str(file), shared=False, size=count, dtype=torch.uint8).view(shape)
    if bool((values > 1).any()):
        raise ValueError(f"{file}: holds other numbers than false and true.")
    return values.view(torch.bool)
