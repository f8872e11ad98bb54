"""Files of a data set: a manifest, and a memory-mapped TensorDict for each split, filled chunk by chunk."""

from __future__ import annotations

import os
import zlib
from contextlib import AbstractContextManager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import cast

import torch
from filelock import FileLock
from tensordict import TensorDict

from torchrl_gn.atomic import parse_json, remove_leftovers, sync_all, write_json
from torchrl_gn.data.tensor_folder import create_tensors, open_tensors

FORMAT = 6
SPLITS = ("train", "validation", "test")
_KEYS = {"format", "request", "description", "features", "versions", "chunks"}
_LATER = ("keyframe",)  # parts of a request that older data sets lack
_REMEDY = "Restore it from a copy, or delete the data set's folder and create it again."


class DatasetError(RuntimeError):
    """A data set on disk is damaged, incomplete, of a newer format or of another scene."""


def simulation_versions() -> dict[str, str]:
    """Return the versions of the packages that determine the simulated numbers."""
    return {package: version(package) for package in ("mujoco", "numpy", "scipy")}


class DatasetFiles:
    """Folder of a data set; every chunk in its manifest is complete, even after an interruption."""

    def __init__(self, root: Path):
        self.root, self.manifest_path = root, root / "manifest.json"
        self.manifest: dict = {}

    def error(self, message: str) -> DatasetError:
        """Make an error that names the manifest."""
        return DatasetError(f"{self.manifest_path}: {message}")

    def lock(self) -> AbstractContextManager:
        """Lock the data set against other processes; do nothing if its location is not writable."""
        root = self.root.absolute()
        root.parent.mkdir(parents=True, exist_ok=True)
        writable = os.access(root.parent, os.W_OK)
        return FileLock(root.with_name(f".{root.name}.lock")) if writable else nullcontext()

    def find(self, request: dict) -> bool:
        """Return True if the requested data set exists and is intact, False without files; else DatasetError."""
        if os.access(self.root, os.W_OK):
            remove_leftovers(self.root, target=self.manifest_path)
        if not self.manifest_path.is_file():
            if self.root.exists() and not self.root.is_dir():
                raise DatasetError(f"{self.root}: not a folder. Use another path.")
            if self.root.is_dir() and any(self.root.iterdir()):
                raise DatasetError(f"{self.root}: not empty and has no manifest.json. Use another folder.")
            return False
        self.read()
        there = {key: request.get(key) for key in _LATER} | self.manifest["request"]
        if differing := [key for key in {**request, **there} if there.get(key) != request.get(key)]:
            what = ", ".join(f"{key} is {there.get(key)}, not {request.get(key)}" for key in differing)
            raise self.error(f"another data set is there ({what}). Use another folder, or delete this one.")
        for split in filter(self.rows_done, SPLITS):
            self.open(split, checksums=True)
        return True

    def read(self) -> None:
        """Read the manifest; DatasetError if it is missing, damaged or of another format."""
        try:
            manifest = parse_json(self.manifest_path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise self.error("no such file, so there is no data set. Make one with create_dataset.") from None
        except ValueError as error:
            raise self.error(f"damaged ({error}). {_REMEDY}") from error
        if not isinstance(manifest, dict) or not isinstance(manifest.get("format"), int):
            raise self.error(f"damaged (no format number). {_REMEDY}")
        if manifest["format"] != FORMAT:
            remedy = "Update torchrl_gn." if manifest["format"] > FORMAT else "Delete the folder and create it again."
            raise self.error(f"format {manifest['format']}, but this version reads only {FORMAT}. {remedy}")
        if missing := _KEYS - manifest.keys():
            raise self.error(f"damaged (no {sorted(missing)}). {_REMEDY}")
        if wrong := _wrong(manifest):
            raise self.error(f"damaged ({wrong}). {_REMEDY}")
        self.manifest = manifest

    def create(self, **entries: object) -> None:
        """Make the folder and a manifest without chunks."""
        self.root.mkdir(parents=True, exist_ok=True)
        self.manifest = {"format": FORMAT, **entries, "chunks": {split: [] for split in SPLITS}}
        self._write()

    def _write(self) -> None:
        write_json(self.manifest_path, self.manifest, checked=True)

    def rows_done(self, split: str) -> int:
        """Count the rows in a split's finished chunks."""
        request = self.manifest["request"]
        return min(len(self.manifest["chunks"][split]) * request["chunk"], request["sizes"][split])

    def is_complete(self) -> bool:
        """Return True if all chunks are finished."""
        return all(self.rows_done(split) == size for split, size in self.manifest["request"]["sizes"].items())

    def append(self, split: str, rows: TensorDict, rejected: int) -> None:
        """Write the next chunk of a split, then the manifest with its checksums and number of redrawn simulations."""
        folder, chunks, first = self.root / split, self.manifest["chunks"][split], self.rows_done(split)
        for path in (self.manifest_path, folder, *folder.rglob("*")):
            if path.is_symlink():
                raise DatasetError(f"{path}: a link, to which nothing is written. {_REMEDY}")
        if not chunks:
            size = self.manifest["request"]["sizes"][split]
            create_tensors(folder, cast(TensorDict, rows[:1]).expand(size))
        TensorDict.load_memmap(folder, allow_pickle=False)[first : first + len(rows)] = rows
        sync_all(folder)
        layout = {file.relative_to(folder).as_posix(): file for file in sorted(folder.rglob("meta.json"))}
        sums = {name: zlib.crc32(file.read_bytes()) for name, file in layout.items()}
        chunks.append({"rejected": rejected, "crc32": {**sums, **_checksums(rows)}})
        self._write()

    def open(self, split: str, *, checksums: bool) -> TensorDict:
        """Map a started split from disk, copy-on-write; DatasetError if a file is missing or changed."""
        folder, chunks, count = self.root / split, self.manifest["chunks"][split], self.manifest["request"]["chunk"]
        for name, expected in chunks[0]["crc32"].items():
            file = folder / name
            if not file.is_file():
                raise DatasetError(f"{file}: missing. {_REMEDY}")
            if file.suffix == ".json" and zlib.crc32(file.read_bytes()) != expected:
                raise DatasetError(f"{file}: its checksum differs: damaged. {_REMEDY}")
        try:
            data = open_tensors(folder)
        except ValueError as error:
            raise DatasetError(f"{error} {_REMEDY}") from error
        widths = {("state",): None, ("action",): None, ("physics",): None}
        widths |= {("parameters", part): len(names) for part, names in (self.manifest["features"] or {}).items()}
        found = {key: value for key in widths if isinstance(value := data.get(key, None), torch.Tensor)}
        if list(data.batch_size) != [self.manifest["request"]["sizes"][split]] or found.keys() != widths.keys():
            raise DatasetError(f"{folder}: not the trajectories that {self.manifest_path.name} lists. {_REMEDY}")
        for key, width in widths.items():
            if width not in (None, found[key].shape[-1]):
                raise DatasetError(f"{folder}: {key} does not have {width} columns. {_REMEDY}")
        for first, chunk in zip(range(0, len(data), count), chunks if checksums else (), strict=False):
            rows = cast(TensorDict, data[first : first + count])
            for name, found in _checksums(rows).items():
                if chunk["crc32"].get(name) != found:
                    where = f"{folder / name}: sequences {first} to {first + len(rows) - 1}"
                    raise DatasetError(f"{where} have other checksums: damaged. {_REMEDY}")
        return data


def _wrong(manifest: dict) -> str | None:
    """Describe the first error in a manifest's structure; None if there is none."""

    def are(kind: type, *values: object) -> bool:
        return all(type(value) is kind for value in values)

    request, chunks, features = manifest["request"], manifest["chunks"], manifest["features"]
    if not are(dict, request, chunks) or not {"scene", "fingerprint", "sizes", "chunk", "variants"} <= request.keys():
        return "request or chunks are incomplete"
    sizes = request["sizes"]
    if not are(dict, sizes) or {*sizes} != {*SPLITS} or not are(int, request["chunk"], *sizes.values()):
        return "sizes of splits and chunks are not whole numbers"
    if min(request["chunk"], *sizes.values()) < 1:
        return "sizes of splits and chunks must be positive"
    if {*chunks} != {*SPLITS} or not are(list, *chunks.values()):
        return f"chunks of {[*SPLITS]} are missing"
    for chunk in (chunk for each in chunks.values() for chunk in each):
        if not are(dict, chunk) or not are(int, chunk.get("rejected")) or not are(dict, chunk.get("crc32")):
            return "a chunk lacks its checksums"
    if features is not None and not (
        are(dict, features)
        and {*features} == {"nodes", "edges", "globals_"}
        and are(list, *features.values())
        and are(str, *(name for names in features.values() for name in names))
    ):
        return "features have no names"
    return None


def _checksums(rows: TensorDict) -> dict[str, int]:
    leaves = rows.flatten_keys("/").items()
    return {f"{name}.memmap": zlib.crc32(leaf.contiguous().numpy().data) for name, leaf in leaves if leaf.numel()}
