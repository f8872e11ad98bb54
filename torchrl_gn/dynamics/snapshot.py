"""A step program as a module: its tensors are the module's buffers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.physics import Physics
from torchrl_gn.dynamics.program import StepProgram, numbers_of, with_numbers
from torchrl_gn.networks.core import Core, dtype_of
from torchrl_gn.networks.packed_layers import PackedLayers, pack_pairs
from torchrl_gn.networks.tensor_tree import copy_of, leaves, rebuild, skeleton

# Parts that training changes. The rest of a program belongs to the scene and is not part of a state_dict.
_NETWORK = ("core", "recurrent", "static")  # in the network's dtype
_NUMBERS = ("nodes_mean", "nodes_scale", "edges_mean", "edges_scale", "output_mean", "output_std", "position_weight")


class Snapshot(nn.Module):
    """Module that holds a packed program, with its tensors as buffers and its modules as submodules.

    These are the program's only copies. Operations on buffers (``to``, ``load_state_dict``, ``share_memory``, copies,
    stacks, weights that a collector sends) therefore change the program that :meth:`program` returns next. A cast
    changes the network's dtype; state maths keeps float64.
    """

    def __init__(self, program: StepProgram) -> None:
        super().__init__()
        numbers = [number.shape for number in numbers_of(program)]
        self._shapes = numbers if isinstance(program.core, PackedLayers) else None  # of numbers that the core holds too
        program = self._without_copies(program)
        self._skeleton, self._names = skeleton(program), [name for name, _ in leaves(program)]
        for name, leaf in leaves(program):
            if isinstance(leaf, Tensor):
                self.register_buffer(name, leaf.detach().clone(), persistent=_is_trained(name))
            else:
                self.add_module(name, copy_of(leaf).requires_grad_(False))

    def program(self) -> StepProgram:
        """Return the program with the buffers' current values."""
        numbers: Iterator[Any] = (self.get(name) for name in self._names)
        program: StepProgram = rebuild(self._skeleton, numbers)
        if self._shapes is not None:
            assert isinstance(program.core, PackedLayers)
            row, sizes = program.core.numbers[0], [shape.numel() for shape in self._shapes]
            views = row.split([*sizes, row.numel() - sum(sizes)])
            program = with_numbers(
                program, (view.view(shape) for view, shape in zip(views, self._shapes, strict=False))
            )
        return replace(program, dtype=self.dtype)

    def get(self, name: str) -> Any:
        """Return a buffer or submodule."""
        return self._buffers[name] if name in self._buffers else self._modules[name]

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the network."""
        for name in self._names:
            leaf = self.get(name) if name.startswith("core") and name != "core_numbers" else None
            if isinstance(leaf, Core):
                return dtype_of(leaf)
            if isinstance(leaf, Tensor) and leaf.is_floating_point():
                return leaf.dtype
        raise TypeError("The core has no tensors.")

    @torch.no_grad()
    def load(self, program: StepProgram) -> None:
        """Copy the numbers of a program of the same structure, in place."""
        for name, leaf in leaves(self._without_copies(program)):
            current = self.get(name)
            if isinstance(current, Tensor) and _is_trained(name):
                current.copy_(leaf)  # pyright: ignore[reportArgumentType]
            elif isinstance(current, (Core, Physics)) and current is not leaf:
                current.load_state_dict(leaf.state_dict())  # pyright: ignore[reportAttributeAccessIssue]

    def _without_copies(self, program: StepProgram) -> StepProgram:
        """Return the program without the numbers that its packed core holds too."""
        if self._shapes is None:
            return program
        return with_numbers(program, (number.new_empty(0) for number in numbers_of(program)))

    def _apply(self, fn, recurse: bool = True):
        before = self.program()
        buffers = {name: buffer for name, buffer in self._buffers.items() if buffer is not None}
        super()._apply(fn, recurse)
        for name, buffer in buffers.items():
            now = self._buffers[name]
            in_network = name.startswith(_NETWORK) and name not in ("core_numbers",)
            if now is not None and now.dtype != buffer.dtype and not in_network:
                self._buffers[name] = buffer.to(now.device)
        if isinstance(before.core, PackedLayers) and self.dtype != before.dtype:
            self._repack(before.core)
        return self

    def _repack(self, core: PackedLayers) -> None:
        """Repack the weights for a new dtype: bfloat16 is packed differently from all others."""
        dtype, device = self.dtype, self.get("core_weights").device
        if dtype == torch.bfloat16:
            self._buffers["core_weights"] = pack_pairs(list(core.plain_weights())).to(device)
            self._buffers["core_tables"] = core.tables.to(device, torch.float32)
        elif core.weights.dtype == torch.bfloat16:
            plain = torch.cat([weight.reshape(-1) for weight in core.plain_weights()]).float()
            packed = torch.ops.torchrl_gn.pack(plain.cpu(), core.shapes.weights, True)
            self._buffers["core_weights"] = packed.to(device, dtype)


def _is_trained(name: str) -> bool:
    return name.startswith(_NETWORK) or name in _NUMBERS
