"""Files of a data set: raw float64 rows, written in checksummed chunks, and a manifest.

::

    manifest.json                                 what the data are, which chunks are done
    train/state.bin, action.bin, physics.bin      little-endian float64, row after row
    train/static/nodes.bin, ...                   of variants, the numbers of each sequence's scene
    validation/..., test/...
"""

from __future__ import annotations

import json
import math
import os
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock
from tensordict import TensorDict

from torchrl_gn.data.errors import DatasetError

FORMAT = 3
SPLITS = ("train", "validation", "test")
_KEYS = {"format", "request", "description", "entries", "features", "versions", "chunks"}


def simulation_versions() -> dict[str, str]:
    """Versions of the packages that the numbers depend on."""
    return {package: version(package) for package in ("mujoco", "numpy", "scipy")}


class DatasetFiles:
    """Read and write the folder of a data set, whose manifest is the caller's to keep.

    Rows of a split are written chunk by chunk, each followed by the manifest, which is replaced
    atomically: whatever interrupts this, the chunks in the manifest are whole.

    Args:
        root: the folder.
    """

    def __init__(self, root: Path):
        self.root = root
        self.manifest_path = root / "manifest.json"
        self._temporary = root / "manifest.json.tmp"
        if sys.byteorder != "little":
            raise NotImplementedError("Data sets are little-endian.")

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from making the same data set; they wait. Nobody does where nothing can be written."""
        root = self.root.absolute()
        root.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(root.parent, os.W_OK):
            yield
            return
        with FileLock(root.with_name(f".{root.name}.lock")):
            yield

    def exists(self) -> bool:
        """Whether a data set is there.

        Raises:
            DatasetError: something else is.
        """
        if self.manifest_path.is_file():
            return True
        if self.root.exists() and not self.root.is_dir():
            raise DatasetError(f"{self.root}: not a folder. Use another path.")
        if self.root.is_dir() and any(file != self._temporary for file in self.root.iterdir()):
            raise DatasetError(
                f"{self.root}: the folder is not empty and has no manifest.json, so it is no data set or a "
                "damaged one. Use another folder."
            )
        return False

    def create(self, manifest: dict) -> None:
        """Make the folder and a manifest without chunks."""
        # Nothing before the manifest, without which the folder would be none of ours.
        self.root.mkdir(parents=True, exist_ok=True)
        self._write(manifest)

    def read(self) -> dict:
        """The manifest.

        Raises:
            DatasetError: it is missing, damaged or of another format.
        """
        try:
            manifest = json.loads(self.manifest_path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise DatasetError(
                f"{self.manifest_path}: no such file, so there is no data set. Make one with create_dataset."
            ) from None
        except ValueError as error:
            raise DatasetError(f"{self.manifest_path}: damaged ({error}). {_REMEDY}") from error
        if not isinstance(manifest, dict) or not isinstance(manifest.get("format"), int):
            raise DatasetError(f"{self.manifest_path}: damaged (no format number). {_REMEDY}")
        if manifest["format"] > FORMAT:
            raise DatasetError(
                f"{self.manifest_path}: format {manifest['format']} is newer than {FORMAT}, the only one that "
                "this version reads. Update torchrl_gn."
            )
        if manifest["format"] < FORMAT:
            raise DatasetError(
                f"{self.manifest_path}: format {manifest['format']} is older than {FORMAT}, the only one that this "
                "version reads. Delete the data set's folder and create it again, with the same seed, or use another."
            )
        if missing := _KEYS - manifest.keys():
            raise DatasetError(f"{self.manifest_path}: damaged (no {sorted(missing)}). {_REMEDY}")
        return manifest

    def is_complete(self, manifest: dict) -> bool:
        """Whether all chunks are done."""
        return all(_rows_done(manifest, split) == manifest["request"]["sizes"][split] for split in SPLITS)

    def verify(self, manifest: dict, *, checksums: bool = True) -> None:
        """Compare the files with the manifest's chunks.

        Raises:
            DatasetError: a file is missing, too short or changed.
        """
        complete = self.is_complete(manifest)
        for split in SPLITS:
            done = _rows_done(manifest, split)
            for name, shape in manifest["entries"].items():
                file, row = self._file(split, name), 8 * math.prod(shape)
                if not done:
                    continue
                if not file.is_file():
                    raise DatasetError(f"{file}: missing. {_REMEDY}")
                size = file.stat().st_size
                if size < done * row or (complete and size != done * row):
                    raise DatasetError(f"{file}: {size} bytes, should be {done * row}: truncated or changed. {_REMEDY}")
                if checksums:
                    self._check_checksums(manifest, split, name, file, row)

    def append(self, manifest: dict, split: str, arrays: dict[str, np.ndarray], rejected: int) -> None:
        """Write the next chunk of a split, then the manifest with it.

        Args:
            manifest: gets the chunk's entry.
            split: name of the split.
            arrays: ``[rows, *shape]`` float64 by name; a part of a name before ``/`` is a folder.
            rejected: simulations that were drawn again for this chunk.
        """
        done, sums = _rows_done(manifest, split), {}
        for name, array in arrays.items():
            values = np.ascontiguousarray(array, dtype=np.float64)
            path = self._file(split, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            with open(path, "r+b" if done else "wb") as file:
                file.seek(done * 8 * math.prod(manifest["entries"][name]))
                file.truncate()
                file.write(values.data)
                file.flush()
                os.fsync(file.fileno())
            sums[name] = zlib.crc32(values.data)
        manifest["chunks"][split].append({"rejected": rejected, "crc32": sums})
        self._write(manifest)

    def open(self, manifest: dict, split: str) -> TensorDict:
        """The split, mapped from disk copy-on-write: writing to it never reaches the files."""
        size = manifest["request"]["sizes"][split]
        entries = {}
        for name, shape in manifest["entries"].items():
            numel = size * math.prod(shape)
            if numel:
                file = str(self._file(split, name))
                flat = torch.from_file(file, shared=False, size=numel, dtype=torch.float64)
            else:  # a scene without actuators
                flat = torch.empty(0, dtype=torch.float64)
            entries[tuple(name.split("/"))] = flat.view(size, *shape)
        return TensorDict(entries, batch_size=[size])

    def _file(self, split: str, name: str) -> Path:
        return self.root / split / f"{name}.bin"

    def _check_checksums(self, manifest: dict, split: str, name: str, file: Path, row: int) -> None:
        chunk, size = manifest["request"]["chunk"], manifest["request"]["sizes"][split]
        with open(file, "rb") as stream:
            for number, written in enumerate(manifest["chunks"][split]):
                first, last = number * chunk, min((number + 1) * chunk, size)
                if zlib.crc32(stream.read((last - first) * row)) != written["crc32"][name]:
                    raise DatasetError(
                        f"{file}: sequences {first} to {last - 1} do not have their checksum: damaged. " + _REMEDY
                    )

    def _write(self, manifest: dict) -> None:
        with open(self._temporary, "w", encoding="utf-8") as file:
            json.dump(manifest, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        os.replace(self._temporary, self.manifest_path)


_REMEDY = "Restore it from a copy, or delete the data set's folder and create it again."


def _rows_done(manifest: dict, split: str) -> int:
    return min(len(manifest["chunks"][split]) * manifest["request"]["chunk"], manifest["request"]["sizes"][split])
