"""The state maths of a program, traced when states need it and compared with torch's."""

from __future__ import annotations

import contextlib
import functools
import threading
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.native import library
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs, Samples, batch_of
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths, may_be_constant
from torchrl_gn.dynamics.executors.native.trace import UntraceableError
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.core import ListedCore
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.networks.snapshot import snapshot

_MOST_SPECIAL = 2


class MixedStatesError(Exception):
    """Samples need different state maths: ``groups`` has the number of each sample's, ``[count]``."""

    def __init__(self, groups: np.ndarray) -> None:
        super().__init__()
        self.groups = torch.from_numpy(groups)


class TracedProgram:
    """Native state maths of a program: special ones for states with the same constant channels, and a general one.

    A special one is traced for the first state that fits no other, up to ``_MOST_SPECIAL``. A sample is computed by the
    first that fits, whatever the other samples are. ``parameters`` says which physical parameters are inputs.
    """

    def __init__(
        self, program: StepProgram, layers: LayerList, parameters: ParameterInputs, change: bool = False
    ) -> None:
        self.program, self.layers, self.parameters, self.change = program, layers, parameters, change
        self.reason: str | None = None  # why torch operations must run it
        self.special: list[library.NativeMaths] = []
        self.general: library.NativeMaths | None = None
        self._tried_general = False
        self._example: tuple[Tensor, Tensor] | None = None  # a finite state and action
        self._lock = threading.Lock()

    def run(
        self, network: library.NativeNetwork, call: library.Call, state: Tensor, actions: Tensor
    ) -> library.NativeMaths:
        """Run a call of the library, for contiguous states and actions; return the state maths that all samples fit.

        Raises:
            MixedStatesError: if there is none.
            UntraceableError: if torch operations must run it.
        """
        if not self.special or not library.rollout(network, self.special[0], call):
            with self._lock:
                groups = self._groups(state, actions.reshape(call.batch, call.steps, actions.shape[-1])[:, 0])
            if (groups != groups[0]).any():
                raise MixedStatesError(groups)
            maths = [*self.special, self.general][groups[0]]
            if maths is None or not library.rollout(network, maths, call):
                raise UntraceableError("The states do not fit.")
            return maths
        return self.special[0]

    def _groups(self, states: Tensor, actions: Tensor) -> np.ndarray:
        """Number of the state maths of each sample, ``[count]``, for its first action; -1: the general one."""
        flat, actions = states.detach().reshape(len(actions), -1).double().numpy(), actions.detach().double()
        finite = np.isfinite(flat).all(1) & actions.isfinite().all(1).numpy()
        groups, left = np.full(len(flat), -1), np.ones(len(flat), dtype=bool)
        for index in range(_MOST_SPECIAL):
            if index == len(self.special):
                if not (left & finite).any():
                    break
                sample = int((left & finite).argmax())
                state = flat[sample].reshape(states.shape[-2:])
                self._example = torch.from_numpy(state), actions[sample]
                try:
                    self.special.append(self._traced(state, may_be_constant(self.program, state)))
                except UntraceableError as error:
                    self.reason = str(error)
                    raise
            fits = left & self.special[index].fits(flat)
            groups[fits], left = index, left & ~fits
        if left.any() and not self._tried_general and self._example is not None:
            state, self._tried_general = self._example[0].numpy(), True
            with contextlib.suppress(UntraceableError):  # torch runs states that need it
                self.general = self._traced(state, np.zeros_like(state, dtype=bool))
        return groups

    def _traced(self, state: np.ndarray, constant: np.ndarray) -> library.NativeMaths:
        """State maths that agree with torch's on the example; else UntraceableError."""
        with torch.device("cpu"), torch.no_grad():
            maths = trace_states(self.program, self.layers, state, constant, self.parameters, self.change)
            native = library.NativeMaths(maths, self.layers)
            self._compare(native)
        return native

    def _compare(self, maths: library.NativeMaths) -> None:
        """UntraceableError unless the example's next state is that of torch, both in float64."""
        assert self._example is not None
        program, network, samples = self._in_float64
        batch = batch_of(program.parameters)  # the example with the parameters of every sample
        state, action = (each.expand(*batch, *each.shape).clone() for each in self._example)
        change = (
            eager.delta(program, state, action)[0]
            if self.change
            else eager.step(program, state, action, None)[0] - state
        )
        call, found = library.forward_call(state, action, False, shape=change.shape)
        samples.bring(call)
        if not library.rollout(network, maths, call):
            raise UntraceableError("The state maths do not fit the state that they were traced for.")
        found = found if self.change else found - state
        sizes, errors = (each.flatten(-2).norm(dim=-1).flatten() for each in (change, found - change))
        bound = 1e-6 * sizes + 1e-12 * (1 + float(self._example[0].norm()))
        wrong = sizes.isfinite() & ~(errors <= bound)
        if wrong.any():
            worst = float((errors / sizes.clamp(min=1e-300))[wrong].max())
            raise UntraceableError(f"The native step differs from torch's by {worst:.1e} of the change.")

    @functools.cached_property
    def _in_float64(self) -> tuple[StepProgram, library.NativeNetwork, Samples]:
        core = snapshot(self.program.core, torch.float64)
        layers, parameters = core.layers(), self.parameters.read(self.program.parameters)
        network, samples = library.NativeNetwork(layers, torch.float64), Samples.of(layers, parameters, torch.float64)
        return replace(self.program, core=core, dtype=torch.float64), network, samples


def trace_states(
    program: StepProgram,
    layers: LayerList,
    state: np.ndarray,
    constant: np.ndarray,
    parameters: ParameterInputs,
    change: bool = False,
) -> StateMaths:
    """State maths of a program for states whose channels ``constant`` ``[N, C]`` are those of ``state``.

    Raises:
        UntraceableError: if they have no scalar form.
    """
    core, last = program.core, layers.layers[-1]
    assert isinstance(core, ListedCore)
    predicted = torch.arange(layers.nodes[0], device="cpu")[core.predicted].numpy()
    width = last.count * len(last.weight) // max(len(predicted), 1)
    return StateMaths(program, np.where(constant, state, 0.0), constant, predicted, width, parameters, change)
