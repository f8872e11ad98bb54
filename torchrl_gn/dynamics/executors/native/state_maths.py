"""A step's state maths as tapes: from state and action to network inputs, from network outputs to the next state."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.native.expressions import Expressions, Scalar, gradient
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs
from torchrl_gn.dynamics.executors.native.tape import Tape, assemble
from torchrl_gn.dynamics.executors.native.trace import Array, trace
from torchrl_gn.dynamics.program import StepProgram, numbers_of, with_numbers


class StateMaths:
    """Tapes of a program for states that equal ``state`` in the channels ``constant``, both before and after a step.

    Args:
        program: the step.
        state: ``[N, C]`` a state.
        constant: ``[N, C]`` channels to treat as constant, except those that the step changes.
        predicted: ``[P]`` nodes that the network predicts.
        width: components ``F_out`` of each predicted node.
        parameters: physical parameters that are inputs, beside the model's numbers.
        change: whether the result is the change ``[N, 12]`` instead of the next state.

    Raises:
        UntraceableError: if a feature uses an operation without scalar form, or a tape needs too many registers.
    """

    def __init__(
        self,
        program: StepProgram,
        state: np.ndarray,
        constant: np.ndarray,
        predicted: np.ndarray,
        width: int,
        parameters: ParameterInputs,
        change: bool = False,
    ) -> None:
        while True:
            graph = Expressions()
            groups, inputs, (after, delta) = _forward(program, graph, state, constant, predicted, width, parameters)
            stays = np.frompyfunc(lambda a, b: not isinstance(a, Scalar) and abs(a - b) <= 1e-12 * (1 + abs(b)), 2, 1)
            changed = constant & ~np.asarray(stays(after, state), dtype=bool)
            if not changed.any():
                break
            constant = constant & ~changed
        self.is_constant, self.state = constant, state
        self.actions, self.numbers = len(groups[1]), len(groups[3])
        flat = constant.ravel()
        self.varying = np.flatnonzero(~flat).astype(np.int32)  # [L] channels of the flat state [N * C] that change
        self.constant = np.flatnonzero(flat).astype(np.int32)  # [N * C - L] the others
        self.values = state.ravel()[flat].astype(np.float64)  # [N * C - L] their values
        self._graph, self._inputs, self.change = graph, inputs, change
        # [R] channels of the flat result to compute: the varying ones of a state, the non-zero ones of a change.
        self.results, self.result_size = self.varying, state.size
        self._after: list[Any] = after[~constant].tolist()
        if change:
            changes = np.array([isinstance(each, Scalar) or each != 0 for each in delta.ravel()], dtype=bool)
            self.results, self.result_size = np.flatnonzero(changes).astype(np.int32), delta.size
            self._after = delta.ravel()[changes].tolist()
        # Groups of inputs: varying channels, action, the network's output, numbers.
        self._groups = groups

    @functools.cached_property
    def forward(self) -> Tape:
        """Tape of network inputs from varying channels and action (phase 0), then of the result (phase 1)."""
        return assemble(self._graph, self._groups, [self._inputs, self._after])

    def separate(self, name: str) -> Tape:
        """Return one of four tapes that share no registers, for engines that run the network between them.

        ``"inputs"`` and ``"result"`` are the two phases of ``forward``; ``"inputs_adjoint"`` and ``"result_adjoint"``
        are the vector-Jacobian product of each.
        """
        graph, groups, (varying, actions, outputs, _) = self._graph, self._groups, self._groups
        if name == "inputs":
            return assemble(graph, groups, [self._inputs])
        if name == "result":
            return assemble(graph, groups, [self._after])
        after_gradient, inputs_gradient = graph.inputs(4, len(self._after)), graph.inputs(5, len(self._inputs))
        if name == "inputs_adjoint":
            gradients = gradient(graph, self._inputs, inputs_gradient, [*varying, *actions])
        else:
            gradients = gradient(graph, self._after, after_gradient, [*outputs, *varying, *actions])
        return assemble(graph, [*groups, after_gradient, inputs_gradient], [gradients])

    @functools.cached_property
    def adjoint(self) -> Tape:
        """Tape of the vector-Jacobian product of :attr:`forward`.

        Phase 0 computes the gradient of the network's output from the gradient of the result. Phase 1 computes the
        gradients of state and action from the gradients of the network's inputs and the result.
        """
        graph, (varying, actions, outputs, _) = self._graph, self._groups
        after_gradient, inputs_gradient = graph.inputs(4, len(self._after)), graph.inputs(5, len(self._inputs))
        last = gradient(graph, self._after, after_gradient, [*outputs, *varying, *actions])
        first = gradient(graph, self._inputs, inputs_gradient, [*varying, *actions])
        both = [a + b for a, b in zip(last[len(outputs) :], first, strict=True)]
        results = [last[: len(outputs)], both]
        return assemble(graph, [*self._groups, after_gradient, inputs_gradient], results)


def may_be_constant(program: StepProgram, state: np.ndarray) -> np.ndarray:
    """Return the mask ``[N, C]`` of a state's channels that may be constant.

    Such a channel cannot move, or is a zero of an orientation, which stays zero if the body turns about one axis.
    """
    movable, constant = program.movable.numpy(force=True), np.ones_like(state, dtype=bool)
    for component in program.layout.components:
        moves = movable[:, program.layout.delta_slices[component.name]]
        at = program.layout.slices[component.name]
        if component.kind == "add":
            constant[:, at] = ~moves
        else:
            constant[:, at] = ~moves.any(1, keepdims=True) | (state[:, at] == 0)
    return constant


def _forward(
    program: StepProgram,
    graph: Expressions,
    state: np.ndarray,
    constant: np.ndarray,
    predicted: np.ndarray,
    width: int,
    parameters: ParameterInputs,
) -> tuple[list[list[Scalar]], list[Any], list[Array]]:
    """Trace a step; return groups of inputs, the network's inputs, and the next state and change."""
    symbols = np.empty(state.shape, dtype=object)
    symbols[...] = state.astype(float).astype(object)
    varying = np.flatnonzero(~constant.ravel())
    symbols.ravel()[varying] = graph.inputs(0, len(varying))
    actions = np.array(graph.inputs(1, program.controls.action_low.numel()), dtype=object)
    outputs = np.array(graph.inputs(2, len(predicted) * width), dtype=object)
    full = np.full((len(state), width), 0.0, dtype=object)
    full[predicted] = outputs.reshape(len(predicted), width)
    shapes = [each.shape for each in numbers_of(program)]
    offsets = np.cumsum([0, *(shape.numel() for shape in shapes)])
    read = graph.inputs(3, int(offsets[-1]) + len(parameters))
    numbers = [
        np.array(read[start:end], dtype=object).reshape(shape)
        for start, end, shape in zip(offsets, offsets[1:], shapes, strict=False)
    ]
    arrays = parameters.arrays(read[offsets[-1] :])

    def own(symbolic: tuple[Tensor, ...]) -> StepProgram:
        values = iter(symbolic)
        changed = with_numbers(program, itertools.islice(values, len(numbers)))
        return replace(changed, parameters=parameters.complete(values))

    def before(state: Tensor, action: Tensor, *symbolic: Tensor) -> tuple[Tensor, ...]:
        traced = own(symbolic)
        nodes, edges = eager.features(traced, eager.canonical_state(traced, state, action), action)
        return traced.nodes(nodes, torch.float64), traced.edges(edges, torch.float64)

    def after(state: Tensor, action: Tensor, predicted: Tensor, *symbolic: Tensor) -> tuple[Tensor, ...]:
        traced = own(symbolic)
        change = eager.change(traced, state, eager.canonical_state(traced, state, action), predicted)
        return program.layout.apply(state, change), change

    inputs = [each for part in trace(before, symbols, actions, *numbers, *arrays) for each in part.ravel().tolist()]
    groups = [symbols[~constant].tolist(), actions.tolist(), outputs.tolist(), read]
    return groups, inputs, trace(after, symbols, actions, full, *numbers, *arrays)
