"""Arrays of robot logs in .npz, .csv, .parquet and .hdf5 files, and in LeRobot dataset folders."""

from __future__ import annotations

import csv
import json
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_gn.data.dataset_files import DatasetError

Source = str | Sequence[str]  # name of an array, a pattern of columns, or several of these
Names = Mapping[str, Source]
_DEMO = re.compile(r"demo_?(\d+)")


@dataclass
class LogArrays:
    """Arrays of a file, the names of their columns, and their default roles."""

    arrays: dict[str, np.ndarray]
    columns: dict[str, list[str]] = field(default_factory=dict)
    names: dict[str, str] = field(default_factory=dict)  # default of ``names=`` of :func:`load_robot_log`
    unread: dict[str, str] = field(default_factory=dict)
    only_named: bool = False  # arrays that are not named are not read as extra channels
    numbers: dict[str, list[str]] = field(default_factory=dict)  # of the columns that make up an array


def read_log_arrays(path: Path) -> LogArrays:
    """Read all arrays of a file or a LeRobot folder; ImportError if the format needs a package that is missing."""
    if path.is_dir():
        return _read_lerobot(path)
    return READERS[path.suffix](path)


@contextmanager
def naming_unreadable(path: Path, what: str) -> Iterator[None]:
    """Turn the errors of readers, whose types are many for a damaged file, into a DatasetError with its path."""
    try:
        yield
    except ImportError:
        raise
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise DatasetError(f"{path} cannot be read as {what}: {reason}") from error


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read the named arrays of a file; errors of many types if it is damaged or has other content."""
    file = np.load(path, allow_pickle=False)
    if isinstance(file, np.ndarray):
        raise ValueError("it is a single array (.npy), no .npz file of named ones")
    with file:
        _refuse_twice(file.files)
        arrays = dict(file)
    if others := [name for name, values in arrays.items() if not isinstance(values, np.ndarray)]:
        raise ValueError(f"{others} in it are not arrays")
    return arrays


def _read_npz(path: Path) -> LogArrays:
    return LogArrays(read_npz(path))


def _read_csv(path: Path) -> LogArrays:
    with path.open(encoding="utf-8-sig") as file:  # spreadsheets begin files with a byte order mark
        # Some programs put names in quotes, or the header behind the mark of a comment.
        header = [name.strip() for name in next(csv.reader([file.readline().lstrip("# ")]), [])]
    _refuse_twice(header)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without rows
        table = np.loadtxt(path, delimiter=",", skiprows=1, dtype=np.float64, ndmin=2)
    if not table.size:
        raise ValueError("it has no rows")
    if table.shape[1] != len(header):
        raise ValueError(f"{len(header)} names for {table.shape[1]} columns")
    return _grouped(dict(zip(header, table.T, strict=True)))


def _refuse_twice(names: Sequence[str]) -> None:
    """Raise ValueError if several columns share a name."""
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        where = [index for index, name in enumerate(names) if name == twice[0]]
        raise ValueError(f"columns {where} are all named {twice[0]!r}; give each a name of its own")


def _read_parquet(path: Path) -> LogArrays:
    arrays, unread = _parquet_columns([path])
    return replace(_grouped(arrays), unread=unread)


def _read_lerobot(path: Path) -> LogArrays:
    """Read a LeRobot dataset: version 2 has one file per episode, version 3 several episodes per file."""
    info_file, files = path / "meta" / "info.json", sorted((path / "data").glob("**/*.parquet"))
    if not info_file.is_file() or not files:
        raise ValueError("a folder is read if it is a LeRobot dataset, with meta/info.json and data/**/*.parquet")
    info = json.loads(info_file.read_text(encoding="utf-8"))
    arrays, unread = _parquet_columns(files)
    if step := _period(_entry(info, "fps"), "fps of meta/info.json"):
        arrays["timestep"] = np.array(step)
    features, columns = _entry(info, "features"), {}
    for name, values in arrays.items():
        labels = _entry(_entry(features, name), "names")
        if isinstance(labels, dict):  # {"motors": [...]}
            labels = next(iter(labels.values()), None)
        if isinstance(labels, list) and values.ndim == 2 and len(labels) == values.shape[1]:
            columns[name] = [str(label) for label in labels]
    names = {"angle": "observation.state", "velocity": "", "command": "action", "episode": "episode_index"}
    names |= {"time": "timestamp"} if "timestamp" in arrays else {}
    return LogArrays(arrays, columns, names, unread, only_named=True)


def _read_hdf5(path: Path) -> LogArrays:
    """Read robomimic's layout, one group ``data/demo_<k>`` per episode, or datasets of any name that hold all rows."""
    h5py = _optional("h5py", path)
    with h5py.File(path, "r") as file:
        data = file.get("data")
        demos = sorted(filter(_DEMO.fullmatch, data), key=_demo_number) if isinstance(data, h5py.Group) else []
        if elsewhere := [demo for demo in demos if not _is_in(data.get(demo), file)]:
            raise ValueError(f"{elsewhere} of its data lie in another file")
        if not demos:
            arrays, unread = _hdf5_arrays(file, h5py)
            attributes = {name: np.asarray(value) for name, value in file.attrs.items() if np.isrealobj(value)}
            arrays = attributes | arrays  # an attribute may tell the unit or date of an array of its name
            return LogArrays(arrays, unread=unread)
        demo_arrays = [_hdf5_arrays(data[demo], h5py) for demo in demos]
        unread = demo_arrays[0][1]
        parts = [{name: values for name, values in arrays.items() if values.ndim} for arrays, _ in demo_arrays]
        shared = [name for name in parts[0] if all(name in part for part in parts)]
        unread |= {name: "not in every episode" for part in parts for name in part if name not in shared}
        arrays = {name: np.concatenate([part[name] for part in parts]) for name in shared}
        names = {"angle": "obs/robot0_joint_pos", "velocity": "obs/robot0_joint_vel", "command": "actions"}
        names = {name: source for name, source in names.items() if source in arrays}
        if "actions" in arrays:
            arrays["length"] = np.array([len(part["actions"]) for part in parts])
        environment = _entry(json.loads(str(data.attrs.get("env_args", "{}"))), "env_kwargs")
        if step := _period(_entry(environment, "control_freq"), "control_freq of its env_args"):
            arrays["timestep"] = np.array(step)
        return LogArrays(arrays, names=names, unread=unread, only_named=True)


def _entry(described: Any, name: str) -> Any:
    """Return an entry of a description; None if there is none, or it has another structure."""
    return described.get(name) if isinstance(described, dict) else None


def _period(rate: Any, what: str) -> float | None:
    """Return the seconds between rows at a rate, None without one; ValueError if it is not a rate."""
    if not rate:
        return None
    if type(rate) not in (int, float) or not 0 < rate < float("inf"):
        raise ValueError(f"{what} is {rate!r}, no number of rows a second")
    return 1 / rate


READERS: dict[str, Callable[[Path], LogArrays]] = {
    ".npz": _read_npz,
    ".csv": _read_csv,
    ".parquet": _read_parquet,
    ".hdf5": _read_hdf5,
    ".h5": _read_hdf5,
}


def _optional(package: str, path: Path) -> Any:
    try:
        return import_module(package)
    except ImportError as error:
        raise ImportError(
            f"{path} needs {package}: pip install 'torchrl_gn[logs]' (or {package.split('.')[0]})."
        ) from error


def _grouped(columns: dict[str, np.ndarray]) -> LogArrays:
    """Join columns ``name0``, ``name1``, ... ``[R]`` into arrays ``name`` ``[R, columns]``; keep others."""
    groups: dict[str, list[tuple[int, np.ndarray]]] = {}
    for name, values in columns.items():
        base, number = re.fullmatch(r"(.*?)(\d*)", name, re.DOTALL).groups()  # pyright: ignore[reportOptionalMemberAccess]
        single = values.ndim == 1 and np.issubdtype(values.dtype, np.number)
        groups.setdefault(base if single else name, []).append((int(number or 0) if single else 0, values))
    for base, group in groups.items():
        numbers = [number for number, _ in group]
        if len(set(numbers)) < len(numbers):
            raise ValueError(f"several columns are {base!r} with the number {max(numbers, key=numbers.count)}")
    ordered = {
        base: [values for _, values in sorted(group, key=lambda entry: entry[0])] for base, group in groups.items()
    }
    arrays = {
        base: group[0] if group[0].ndim > 1 or not np.issubdtype(group[0].dtype, np.number) else np.stack(group, 1)
        for base, group in ordered.items()
    }
    numbers = {
        base: [str(number) for number in sorted(number for number, _ in group)] for base, group in groups.items()
    }
    return LogArrays(arrays, numbers=numbers)


def _parquet_columns(files: Sequence[Path]) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read columns ``[R]``, or ``[R, k]`` for lists of equal length; also return the reasons why others are skipped."""
    pq = _optional("pyarrow.parquet", files[0])
    schema = pq.read_schema(files[0])
    _refuse_twice(schema.names)
    flat = {entry.name for entry in schema if not _nested(entry.type)}
    unread = {name: "neither numbers nor text, nor lists of them" for name in schema.names if name not in flat}
    names = [name for name in schema.names if name in flat]
    tables = [pq.read_table(file, columns=names, page_checksum_verification=True) for file in files]
    arrays = {}
    for name in names:
        try:
            arrays[name] = np.concatenate([_column(table.column(name).combine_chunks()) for table in tables])
        except ValueError as error:
            unread[name] = str(error)
    return arrays, unread


def _nested(kind: Any) -> bool:
    inner = kind.value_type if hasattr(kind, "value_type") else kind
    return inner.num_fields > 0 or str(inner) in ("binary", "large_binary")


def _column(values: Any) -> np.ndarray:
    kind = str(values.type)
    if "list" in kind:
        lengths = set(values.value_lengths().to_pylist()) if "fixed" not in kind else {values.type.list_size}
        if len(lengths) != 1 or None in lengths:
            raise ValueError("of lists of several lengths")
        return values.flatten().to_numpy(zero_copy_only=False).reshape(len(values), -1)
    if kind.startswith(("timestamp", "duration")):
        per_second = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[values.type.unit]
        return values.cast("int64").to_numpy(zero_copy_only=False) / per_second
    return values.to_numpy(zero_copy_only=False)


def _hdf5_arrays(group: Any, h5py: Any) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Read datasets of up to two dimensions below a group, by path; also return the reasons why others are skipped."""
    arrays, unread = {}, {}
    for name, values in _datasets(group, h5py, "", {group}):
        if values is None:
            unread[name] = "in another file, or the same as another group"
        elif values.ndim > 2:
            unread[name] = f"of shape {list(values.shape)}"
        else:
            arrays[name] = values.asstr()[()] if h5py.check_string_dtype(values.dtype) else np.asarray(values[()])
    return arrays, unread


def _datasets(group: Any, h5py: Any, prefix: str, seen: set[Any]) -> Iterator[tuple[str, Any]]:
    """Yield datasets below a group, by path; None for external ones and ``seen`` groups (links may form cycles)."""
    for name in group:
        entry, path = group.get(name), f"{prefix}{name}"
        if not _is_in(entry, group) or entry in seen:
            yield path, None
        elif isinstance(entry, h5py.Group):
            seen.add(entry)
            yield from _datasets(entry, h5py, f"{path}/", seen)
        elif isinstance(entry, h5py.Dataset):
            yield path, None if entry.external or entry.is_virtual else entry


def _is_in(entry: Any, group: Any) -> bool:
    """Return True if an entry of a group lies in the group's own file."""
    return entry is not None and entry.file.filename == group.file.filename


def _demo_number(name: str) -> int:
    return int(_DEMO.fullmatch(name)[1])  # pyright: ignore[reportOptionalSubscript]
