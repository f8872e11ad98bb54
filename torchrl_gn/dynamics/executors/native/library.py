"""Build the C++ code once for this processor, and call it."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from torch import Tensor

from torchrl_gn.atomic import atomic_path
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths
from torchrl_gn.dynamics.executors.native.tape import Tape
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.processor import processor_flags, processor_name

SOURCES = sorted(path for path in Path(__file__).parent.iterdir() if path.suffix in (".h", ".cpp"))
_OPTIONS = ("-std=c++17", "-O3", "-fPIC", "-shared", "-ffp-contract=fast", "-fno-math-errno", "-pthread")
TILE = 24  # samples that stay in a processor's cache from layer to layer
DTYPES = {torch.float32: 0, torch.float64: 1}  # as the C++ code tells them apart
_P, _I = ctypes.c_void_p, ctypes.c_int64


class NoCompilerError(FileNotFoundError):
    """There is no C++ compiler, or it failed: the message is one line."""


def load_library() -> ctypes.CDLL:
    """The compiled code, built at the first use on a processor and kept in ``~/.cache/torchrl_gn`` (20 s).

    Raises:
        NoCompilerError: without a working C++ compiler (``CXX``, which may have arguments, else c++, g++ or clang++).
    """
    found = _library_or_reason()
    if isinstance(found, str):
        raise NoCompilerError(found)
    return found


@functools.cache
def _library_or_reason() -> ctypes.CDLL | str:
    try:
        return _load()
    except (OSError, ValueError) as error:
        return str(error)


def _load() -> ctypes.CDLL:
    compiler = shlex.split(os.environ.get("CXX", "")) or list(filter(shutil.which, ("c++", "g++", "clang++")))[:1]
    if not compiler or shutil.which(compiler[0]) is None:
        raise NoCompilerError("There is no C++ compiler: install g++ for the native executor.")
    options = [*_OPTIONS, *instruction_flags(), *shlex.split(os.environ.get("TORCHRL_GN_CXXFLAGS", ""))]
    version = _run([*compiler, "--version"]).splitlines()[:1]
    parts = [*compiler, *version, *options, processor_name(), processor_flags(), sys.platform]
    digest = hashlib.sha256("\n".join([*parts, *(path.read_text() for path in SOURCES)]).encode())
    name, command = f"native-{digest.hexdigest()[:16]}.so", [*compiler, *options]
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl_gn"
        file = folder / name
        if (library := _opened(file)) is not None:
            return library
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / f".{name}.lock"):  # others wait for whoever builds
            if (library := _opened(file)) is None:
                for left in folder.glob(f".{file.stem}.*.so"):  # by a build that was interrupted
                    left.unlink()
                _build(command, file)
                library = _opened(file)
        if library is not None:
            return library
    except NoCompilerError:
        raise
    except (OSError, RuntimeError):  # no home, or none to write to
        pass
    with tempfile.TemporaryDirectory(prefix="torchrl_gn-") as temporary:
        file = Path(temporary) / name  # code in the home may not be run, either
        _build(command, file)
        return _declared(ctypes.CDLL(str(file)))


def _build(command: Sequence[str], file: Path) -> None:
    """Compile to a file that ends with its SHA-256."""
    sys.stderr.write("Building the native executor for this processor, once: about 20 s.\n")
    source = next(path for path in SOURCES if path.suffix == ".cpp")
    with atomic_path(file) as temporary:
        _run([*command, str(source), "-o", str(temporary)])
        with temporary.open("ab") as out:
            out.write(hashlib.sha256(temporary.read_bytes()).digest())


def _opened(file: Path) -> ctypes.CDLL | None:
    """The library of a whole file; None if it is missing or damaged, which could end the process."""
    with contextlib.suppress(OSError, AttributeError):
        content = file.read_bytes()
        if hashlib.sha256(content[:-32]).digest() == content[-32:]:
            return _declared(ctypes.CDLL(str(file)))
    return None


def instruction_flags() -> list[str]:
    """Compiler flags for what torch uses of this processor, which ``ATEN_CPU_CAPABILITY`` restricts."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return []
    sets = {"AVX512": ["-march=native"], "AVX2": ["-mavx2", "-mfma"]}
    return sets.get(torch.backends.cpu.get_cpu_capability(), [])


def _run(command: Sequence[str]) -> str:
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        lines = (getattr(error, "stderr", "") or str(error)).splitlines()
        first = next((line for line in lines if "error" in line), "".join(lines[-1:]))
        raise NoCompilerError(f"The C++ compiler {command[0]} failed: {first.strip()}") from error


class _Array(ctypes.Structure):
    _fields_ = (("data", _P), ("is_double", _I))


class _Tape(ctypes.Structure):
    _fields_ = (
        ("instructions", _P),
        ("constants", _P),
        ("ends", _P),
        ("registers", _I),
        ("groups", _I),
        ("inputs", _P),
        ("outputs", _P),
    )


class _Maths(ctypes.Structure):
    _fields_ = (
        *((name, _I) for name in ("size", "varying_count", "actions", "outputs", "node_inputs", "edge_inputs")),
        *((name, _I) for name in ("node_width", "edge_width", "output_width")),
        *((name, _P) for name in ("varying", "constant", "values")),
        ("forward", _Tape),
        ("adjoint", _Tape),
    )


class _Call(ctypes.Structure):
    _fields_ = (
        *((name, _I) for name in ("batch", "steps", "tile", "threads")),
        ("states", _Array),
        ("state_stride", _I),
        ("actions", _Array),
        ("out", _Array),
        ("with_start", _I),
        ("grad_state", _Array),
        ("grad_actions", _Array),
        ("stored", _P),
    )


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    signatures: dict[str, tuple[Any, list]] = {
        "gn_network_new": (_P, [_I, _P, _P, _P]),
        "gn_network_delete": (None, [_P, _I]),
        "gn_network_stored": (_I, [_P, _I]),
        "gn_rollout": (_I, [_P, _I, _P, _P]),
        "gn_rollout_adjoint": (None, [_P, _I, _P, _P]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class NativeNetwork:
    """A layer list packed for the processor; freed with the object."""

    def __init__(self, layers: LayerList) -> None:
        self.library = load_library()
        self.dtype = layers.layers[0].weight.dtype
        self.is_double = int(self.dtype == torch.float64)
        self.code = layers.code().contiguous()
        weights, tables, self._kept = _pointers(layers)
        self.pointer = self.library.gn_network_new(self.is_double, self.code.data_ptr(), weights, tables)
        last = layers.layers[-1]
        # Numbers of a sample and step that its gradient needs: activations' derivatives and the output.
        self.kept = self.library.gn_network_stored(self.pointer, self.is_double) + last.count * len(last.weight)

    def equals(self, other: NativeNetwork) -> bool:
        """Whether both are the same but for their weights."""
        return self.dtype == other.dtype and torch.equal(self.code, other.code)

    def __del__(self) -> None:
        if (pointer := getattr(self, "pointer", None)) is not None:
            self.library.gn_network_delete(pointer, self.is_double)


def _pointers(layers: LayerList) -> tuple[Any, Any, Any]:
    weights, tables = layers.tensors()
    return (
        (_P * len(weights))(*(each.data_ptr() for each in weights)),
        (_P * len(tables))(*(None if each is None else each.data_ptr() for each in tables)),
        (weights, tables),
    )


class NativeMaths:
    """State maths of one scene in the form that the C++ code reads."""

    def __init__(self, maths: StateMaths, layers: LayerList) -> None:
        self.maths, self._lock = maths, threading.Lock()
        last = layers.layers[-1]
        self._kept: list[Any] = []
        self.struct = _Maths(
            size=maths.is_constant.size,
            varying_count=len(maths.varying),
            actions=maths.actions,
            outputs=last.count * len(last.weight),
            node_inputs=layers.nodes[0] * layers.nodes[1],
            edge_inputs=layers.edges[0] * layers.edges[1],
            node_width=layers.nodes[1],
            edge_width=layers.edges[1],
            output_width=len(last.weight),
            varying=maths.varying.ctypes.data,
            constant=maths.constant.ctypes.data,
            values=maths.values.ctypes.data,
            forward=self._tape(maths.forward),
        )
        self.reference = ctypes.addressof(self.struct)

    def add_adjoint(self) -> None:
        """Prepare gradients; once."""
        with self._lock:
            if not self.struct.adjoint.instructions:
                self.struct.adjoint = self._tape(self.maths.adjoint)

    def fits(self, states: np.ndarray) -> np.ndarray:
        """Which of flat states ``[count, N * C]`` have these constant channels, as ``gn_rollout`` finds."""
        difference = np.abs(states[:, self.maths.constant] - self.maths.values)
        return (difference <= 1e-9 * (1 + np.abs(self.maths.values))).all(1)

    def _tape(self, tape: Tape) -> _Tape:
        ends = np.array(tape.phases, dtype=np.int32)
        tables = [(_P * len(part))(*(each.ctypes.data for each in part)) for part in (tape.inputs, tape.outputs)]
        self._kept += [tape, ends, tables]
        return _Tape(
            tape.instructions.ctypes.data,
            tape.constants.ctypes.data,
            ends.ctypes.data,
            tape.registers,
            len(tape.inputs),
            *(ctypes.addressof(table) for table in tables),
        )


NOTHING = (None, 0)  # no array


def forward_call(state: Tensor, actions: Tensor, many: bool, stored: Tensor | None = None) -> tuple[tuple, Tensor]:
    """Fields of a call for contiguous inputs, which must live as long as the call, and its result.

    That is the next state for an action ``[*B, A]``; for ``many``, ``[*B, T, A]``, states ``[*B, T + 1, N, C]``.
    """
    shape, threads = state.shape, torch.get_num_threads()
    size = shape[-2] * shape[-1]
    count, steps = state.numel() // size, actions.shape[-2] if many else 1
    out_shape = (*shape[:-2], steps + 1, *shape[-2:]) if many else shape
    out = torch.empty(out_shape, dtype=state.dtype, device="cpu")
    tile = min(TILE, -(-count // threads))  # such that there are tiles for all threads
    call = (
        *(count, steps, tile, threads),
        *((state.data_ptr(), DTYPES[state.dtype]), size, (actions.data_ptr(), DTYPES[actions.dtype])),
        *((out.data_ptr(), DTYPES[out.dtype]), many, NOTHING, NOTHING),
        None if stored is None else stored.data_ptr(),
    )
    return call, out


def adjoint_call(
    sizes: tuple, states: Tensor, actions: Tensor, gradient: Tensor, many: bool, stored: Tensor | None
) -> tuple[tuple, Tensor, Tensor]:
    """Fields of the call for the gradient of another, whose first fields are ``sizes``; gradients of state and actions.

    ``states`` are the start states, or for ``many`` all; all tensors must live as long as the call.
    """
    size = states.shape[-2] * states.shape[-1]
    shape = (*states.shape[:-3], *states.shape[-2:]) if many else states.shape
    of_state = torch.empty(shape, dtype=states.dtype, device="cpu")
    of_actions = torch.empty_like(actions)
    call = (
        *sizes,
        *((states.data_ptr(), DTYPES[states.dtype]), size * (sizes[1] + 1 if many else 1)),
        *((actions.data_ptr(), DTYPES[actions.dtype]), (gradient.data_ptr(), DTYPES[gradient.dtype]), many),
        *((of_state.data_ptr(), DTYPES[states.dtype]), (of_actions.data_ptr(), DTYPES[actions.dtype])),
        None if stored is None else stored.data_ptr(),
    )
    return call, of_state, of_actions


def rollout(network: NativeNetwork, maths: NativeMaths, call: tuple) -> bool:
    """Run ``gn_rollout`` on the fields of a call; False if a start state has other constant channels."""
    reference = ctypes.byref(_Call(*call))
    return not network.library.gn_rollout(network.pointer, network.is_double, maths.reference, reference)


def rollout_adjoint(network: NativeNetwork, maths: NativeMaths, call: tuple) -> None:
    """Run ``gn_rollout_adjoint`` on the fields of a call."""
    maths.add_adjoint()
    reference = ctypes.byref(_Call(*call))
    network.library.gn_rollout_adjoint(network.pointer, network.is_double, maths.reference, reference)
