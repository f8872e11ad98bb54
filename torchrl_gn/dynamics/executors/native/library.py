"""Call the C++ code."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.native import build
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths
from torchrl_gn.dynamics.executors.native.tape import Tape
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.processor import native_threads

TILE = 24  # samples that stay in a processor's cache from layer to layer
DTYPES = {torch.float32: 0, torch.float64: 1}  # as the C++ code tells them apart
_P, _I = ctypes.c_void_p, ctypes.c_int64


class _Array(ctypes.Structure):
    _fields_ = (("data", _P), ("is_double", _I))


class _Tape(ctypes.Structure):
    _fields_ = (
        ("instructions", _P),
        ("constants", _P),
        ("ends", _P),
        ("registers", _I),
        ("inputs", _P),
        ("outputs", _P),
    )


class _Maths(ctypes.Structure):
    _fields_ = (
        *((name, _I) for name in ("size", "varying_count", "result_size", "result_count", "is_state")),
        *((name, _I) for name in ("actions", "parameters")),
        *((name, _I) for name in ("outputs", "node_inputs", "edge_inputs", "node_width", "edge_width", "output_width")),
        *((name, _P) for name in ("varying", "constant", "values", "results")),
        ("forward", _Tape),
        ("adjoint", _Tape),
    )


class Call(ctypes.Structure):
    """What a call of the C++ code reads, as rollout.h says."""

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
        ("sample_tables", _P),
        ("parameters", _P),
        ("parameter_stride", _I),
    )


def load_library() -> ctypes.CDLL:
    """The compiled code; NoCompilerError if it cannot be built."""
    library = build.load_code()
    signatures: dict[str, tuple[Any, list]] = {
        "gn_network_new": (_P, [_I, _P, _P, _P]),
        "gn_network_delete": (None, [_P, _I]),
        "gn_has_bfloat16": (_I, []),
        "gn_stored": (_I, [_P, _I, _P]),
        "gn_rollout": (_I, [_P, _I, _P, _P]),
        "gn_rollout_adjoint": (None, [_P, _I, _P, _P]),
        "gn_muon": (None, [_I, _P, _I, _P, _I]),
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
            raise TypeError("This processor multiplies no bfloat16.")
        self.code, number = layers.code().contiguous(), self.number
        weights, tables = layers.tensors()
        self.weights = [each.detach().to(number) for each in weights]
        # Tables of each sample come with a call.
        self.tables = [None if each is None or each.ndim == 3 else each.detach().to(number) for each in tables]
        addresses = pointers(self.weights), pointers(self.tables)
        self.pointer = self.library.gn_network_new(self.kind, self.code.data_ptr(), *addresses)
        # Numbers of a sample and step that its gradient needs: slopes of the activations, and the output.
        sizes = [layer.count * len(layer.weight) for layer in layers.layers]
        slopes = [size for size, layer in zip(sizes, layers.layers, strict=True) if layer.activation is not None]
        self.kept = sum(slopes) + sizes[-1]

    @property
    def number(self) -> torch.dtype:
        """Dtype of sums, weights and tables."""
        return torch.float64 if self.kind == 1 else torch.float32

    def equals(self, other: NativeNetwork) -> bool:
        """Whether both are the same but for their weights."""
        return self.dtype == other.dtype and torch.equal(self.code, other.code)

    def same_weights(self, other: NativeNetwork) -> bool:
        """Whether equal networks have the same weights and tables, but for those that come with a call."""
        both = zip(self.weights + self.tables, other.weights + other.tables, strict=True)
        return all(a is None or b is None or torch.equal(a, b) for a, b in both)

    def __del__(self) -> None:
        if (pointer := getattr(self, "pointer", None)) is not None:
            self.library.gn_network_delete(pointer, self.kind)


def pointers(tensors: Sequence[Tensor | None]) -> Any:
    """Addresses of contiguous tensors."""
    return (_P * len(tensors))(*(None if each is None else each.data_ptr() for each in tensors))


class NativeMaths:
    """State maths of one scene in the form that the C++ code reads."""

    def __init__(self, maths: StateMaths, layers: LayerList) -> None:
        self.maths, self._lock = maths, threading.Lock()
        last = layers.layers[-1]
        self._kept: list[Any] = []
        self.struct = _Maths(
            size=maths.is_constant.size,
            varying_count=len(maths.varying),
            result_size=maths.result_size,
            result_count=len(maths.results),
            is_state=not maths.change,
            actions=maths.actions,
            parameters=maths.parameters,
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
        with self._lock:
            if not self.struct.adjoint.instructions:
                self.struct.adjoint = self._tape(self.maths.adjoint)

    def fits(self, states: np.ndarray) -> np.ndarray:
        """Which of flat states ``[count, N * C]`` have these constant channels, as ``gn_rollout`` finds."""
        difference = np.abs(states[:, self.maths.constant] - self.maths.values)
        return np.asarray((difference <= 1e-9 * (1 + np.abs(self.maths.values))).all(1))

    def _tape(self, tape: Tape) -> _Tape:
        ends = np.array(tape.phases, dtype=np.int32)
        tables = [(_P * len(part))(*(each.ctypes.data for each in part)) for part in (tape.inputs, tape.outputs)]
        self._kept += [tape, ends, tables]
        return _Tape(
            tape.instructions.ctypes.data,
            tape.constants.ctypes.data,
            ends.ctypes.data,
            tape.registers,
            *(ctypes.addressof(table) for table in tables),
        )


def forward_call(
    state: Tensor, actions: Tensor, many: bool, stored: Tensor | None = None, shape: Sequence[int] | None = None
) -> tuple[Call, Tensor]:
    """A call for contiguous inputs, which must live as long as the call, and its result.

    That is the next state for an action ``[*B, A]``; for ``many``, ``[*B, T, A]``, states ``[*B, T + 1, N, C]``; or of
    another ``shape``.
    """
    *batch, nodes, channels = state.shape
    size, threads = nodes * channels, native_threads()
    count, steps = state.numel() // size, actions.shape[-2] if many else 1
    if shape is None and many:
        shape = (*batch, steps + 1, nodes, channels)
    # A tensor like the state is made faster than one of a shape.
    out = torch.empty_like(state) if shape is None else torch.empty(shape, dtype=state.dtype, device="cpu")
    tile = min(TILE, -(-count // threads))  # such that there are tiles for all threads
    fields = (count, steps, tile, threads, _array(state), size, _array(actions), _array(out), many, _NOTHING, _NOTHING)
    return Call(*fields, None if stored is None else stored.data_ptr()), out


def adjoint_call(
    forward: Call, states: Tensor, actions: Tensor, gradient: Tensor, stored: Tensor | None
) -> tuple[Call, Tensor, Tensor]:
    """The call for the gradient of a ``forward`` one; gradients of state and actions.

    ``states`` are the start states, or of many steps all; all tensors must live as long as the call.
    """
    many, size = forward.with_start, states.shape[-2] * states.shape[-1]
    shape = (*states.shape[:-3], *states.shape[-2:]) if many else states.shape
    of_state = torch.empty(shape, dtype=states.dtype, device="cpu")
    of_actions = torch.empty_like(actions)
    call = Call.from_buffer_copy(forward)
    call.states, call.state_stride, call.actions = _array(states), size * (forward.steps * many + 1), _array(actions)
    call.out, call.grad_state, call.grad_actions = _array(gradient), _array(of_state), _array(of_actions)
    call.stored = None if stored is None else stored.data_ptr()
    return call, of_state, of_actions


_NOTHING = (None, 0)  # no array


def _array(tensor: Tensor) -> tuple[int, int]:
    return tensor.data_ptr(), DTYPES[tensor.dtype]


def rollout(network: NativeNetwork, maths: NativeMaths, call: Call) -> bool:
    """Run ``gn_rollout``; False if a start state has other constant channels."""
    return not network.library.gn_rollout(network.pointer, network.kind, maths.reference, ctypes.byref(call))


def rollout_adjoint(network: NativeNetwork, maths: NativeMaths, call: Call) -> None:
    """Run ``gn_rollout_adjoint``."""
    maths.add_adjoint()
    network.library.gn_rollout_adjoint(network.pointer, network.kind, maths.reference, ctypes.byref(call))


def trained_count(network: NativeNetwork, call: Call) -> int:
    """Numbers that a training call keeps for its adjoint."""
    return network.library.gn_stored(network.pointer, network.kind, ctypes.byref(call))
