"""Build the C++ code once for this processor, and call it."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.atomic import atomic_path
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths
from torchrl_gn.dynamics.executors.native.tape import Tape
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.processor import processor_name

SOURCES = sorted(path for path in Path(__file__).parent.iterdir() if path.suffix in (".h", ".cpp"))
_OPTIONS = ("-std=c++17", "-O3", "-fPIC", "-shared", "-ffp-contract=fast", "-fno-math-errno", "-pthread")
_P, _I = ctypes.c_void_p, ctypes.c_int64


class NoCompilerError(FileNotFoundError):
    """There is no C++ compiler, or it failed."""


@functools.cache
def load_library() -> ctypes.CDLL:
    """The compiled code, built at the first use on a processor and kept in ``~/.cache/torchrl_gn`` (20 s).

    Raises:
        NoCompilerError: without a working C++ compiler (``CXX``, else c++, g++ or clang++).
    """
    compiler = os.environ.get("CXX") or next(filter(shutil.which, ("c++", "g++", "clang++")), None)
    if compiler is None or shutil.which(compiler) is None:
        raise NoCompilerError("There is no C++ compiler: install g++ for the native executor.")
    options = [*_OPTIONS, *instruction_flags(), *os.environ.get("TORCHRL_GN_CXXFLAGS", "").split()]
    version = _run([compiler, "--version"]).splitlines()[0]
    text = "\n".join([compiler, version, *options, processor_name(), sys.platform, *(p.read_text() for p in SOURCES)])
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl_gn"
    name = f"native-{hashlib.sha256(text.encode()).hexdigest()[:16]}.so"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:  # no home to write to
        folder = Path(tempfile.mkdtemp(prefix="torchrl_gn-"))
    file = folder / name
    if file.exists():
        with contextlib.suppress(OSError, AttributeError):  # damaged: build again
            return _declared(ctypes.CDLL(str(file)))
    sys.stderr.write("Building the native executor for this processor, once: about 20 s.\n")
    with atomic_path(file) as temporary:
        source = next(path for path in SOURCES if path.suffix == ".cpp")
        _run([compiler, *options, str(source), "-o", str(temporary)])
    return _declared(ctypes.CDLL(str(file)))


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
        text = getattr(error, "stderr", "") or str(error)
        raise NoCompilerError(f"The C++ compiler failed: {' '.join(command)}\n{text[-2000:]}") from error


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
        *((name, _I) for name in ("size", "varying_count", "result_size", "result_count", "is_state", "actions")),
        *((name, _I) for name in ("outputs", "node_inputs", "edge_inputs", "node_width", "edge_width", "output_width")),
        *((name, _P) for name in ("varying", "constant", "values", "results")),
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
        ("train", _I),
        ("grad_weights", _P),
        ("grad_tables", _P),
    )


def _declared(library: ctypes.CDLL) -> ctypes.CDLL:
    signatures: dict[str, tuple[Any, list]] = {
        "gn_network_new": (_P, [_I, _P, _P, _P]),
        "gn_network_update": (None, [_P, _I, _P, _P]),
        "gn_network_delete": (None, [_P, _I]),
        "gn_has_bfloat16": (_I, []),
        "gn_stored": (_I, [_P, _I, _P, _P]),
        "gn_rollout": (_I, [_P, _I, _P, _P]),
        "gn_rollout_adjoint": (None, [_P, _I, _P, _P]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class NativeNetwork:
    """A layer list packed for the processor; freed with the object.

    TypeError for bfloat16 on a processor that does not multiply it.
    """

    def __init__(self, layers: LayerList, dtype: torch.dtype) -> None:
        self.library, self.dtype = load_library(), dtype
        self.kind = {torch.float32: 0, torch.float64: 1, torch.bfloat16: 2}[dtype]
        if self.kind == 2 and not self.library.gn_has_bfloat16():
            raise TypeError("the native executor multiplies no bfloat16 on this processor")
        self.code = layers.code().contiguous()
        self.kept = _pointers(layers, self.number)
        self.pointer = self.library.gn_network_new(self.kind, self.code.data_ptr(), *self.kept[:2])

    @property
    def number(self) -> torch.dtype:
        """Dtype of sums, weights and tables."""
        return torch.float64 if self.kind == 1 else torch.float32

    def fits(self, layers: LayerList, dtype: torch.dtype) -> bool:
        """Whether the network differs in its weights alone."""
        return dtype == self.dtype and torch.equal(layers.code(), self.code)

    def update(self, layers: LayerList) -> None:
        """Take other weights; no call may be running."""
        self.kept = _pointers(layers, self.number)
        self.library.gn_network_update(self.pointer, self.kind, *self.kept[:2])

    def __del__(self) -> None:
        if (pointer := getattr(self, "pointer", None)) is not None:
            self.library.gn_network_delete(pointer, self.kind)


def _pointers(layers: LayerList, dtype: torch.dtype) -> tuple[Any, Any, Any]:
    weights, tables = layers.tensors()
    weights = [each.detach().to(dtype) for each in weights]
    tables = [None if each is None else each.detach().to(dtype) for each in tables]
    return pointers(weights), pointers(tables), (weights, tables)


def pointers(tensors: Sequence[Tensor | None]) -> Any:
    """Addresses of contiguous tensors."""
    return (_P * len(tensors))(*(None if each is None else each.data_ptr() for each in tensors))


class NativeMaths:
    """State maths of one scene in the form that the C++ code reads."""

    def __init__(self, maths: StateMaths, layers: LayerList) -> None:
        self.maths = maths
        last = layers.layers[-1]
        self._kept: list[Any] = []
        self.struct = _Maths(
            size=maths.is_constant.size,
            varying_count=len(maths.varying),
            result_size=maths.result_size,
            result_count=len(maths.results),
            is_state=not maths.change,
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
            results=maths.results.ctypes.data,
            forward=self._tape(maths.forward),
        )
        self.reference = ctypes.addressof(self.struct)

    def add_adjoint(self) -> None:
        """Prepare gradients; once."""
        if not self.struct.adjoint.instructions:
            self.struct.adjoint = self._tape(self.maths.adjoint)

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


def stored_count(network: NativeNetwork, maths: NativeMaths, call: tuple) -> int:
    """Numbers that a call keeps for its adjoint."""
    return network.library.gn_stored(network.pointer, network.kind, maths.reference, ctypes.byref(_Call(*call)))


class Pool:
    """Buffers that are used again: fresh pages cost as much as filling them."""

    def __init__(self) -> None:
        self.free: list[Tensor] = []

    def take(self, count: int, dtype: torch.dtype) -> Lease:
        """A buffer of at least ``count`` numbers."""
        for index, buffer in enumerate(self.free):
            if count <= buffer.numel() <= 2 * count and buffer.dtype == dtype:
                return Lease(self, self.free.pop(index))
        self.free.clear()  # other batches are coming
        return Lease(self, torch.empty(count, dtype=dtype))


class Lease:
    """A buffer that goes back to its pool with this object."""

    def __init__(self, pool: Pool, tensor: Tensor) -> None:
        self.pool, self.tensor = pool, tensor

    def __del__(self) -> None:
        self.pool.free = [*self.pool.free[-1:], self.tensor]


def rollout(network: NativeNetwork, maths: NativeMaths, call: tuple) -> bool:
    """Run ``gn_rollout`` on the fields of a call; False if a start state has other constant channels."""
    reference = ctypes.byref(_Call(*call))
    return not network.library.gn_rollout(network.pointer, network.kind, maths.reference, reference)


def rollout_adjoint(network: NativeNetwork, maths: NativeMaths, call: tuple) -> None:
    """Run ``gn_rollout_adjoint`` on the fields of a call."""
    maths.add_adjoint()
    reference = ctypes.byref(_Call(*call))
    network.library.gn_rollout_adjoint(network.pointer, network.kind, maths.reference, reference)
