"""Run a step program in compiled C++: whole rollouts, and their gradients, in one call."""

from __future__ import annotations

import contextlib
import functools
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils._python_dispatch import _disable_current_modes

from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.native.build import NoCompilerError
from torchrl_gn.dynamics.executors.native.operators import load_operators
from torchrl_gn.dynamics.executors.native.preparation import LARGE, preparation
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs, batch_of
from torchrl_gn.dynamics.executors.native.state_maths import StateMaths, may_be_constant
from torchrl_gn.dynamics.executors.native.structure import structure
from torchrl_gn.dynamics.executors.native.trace import UntraceableError
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.networks.core import ListedCore, UnfoldedCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.networks.packed_layers import LayerShapes, PackedLayers, pack_pairs, pack_sample_tables
from torchrl_gn.networks.tensor_tree import in_dtype
from torchrl_gn.processor import native_threads

_NUMBERS = (torch.float32, torch.float64)  # of states, actions, weights
_FEW = 0.05  # a smaller share of constant components, in bodies that move, hardly shortens a tape
_TENSORS = (Tensor, torch.nn.Parameter)
_TILE = 24  # samples that C++ computes together, kTile in call.h
_SECOND = 1.5e10  # multiplications of a thread in about a second


class NativeExecutor:
    """Executor in C++ on a CPU; it falls back to torch operations, and ``reason`` says why.

    State maths runs in float64, the network in the program's dtype (bfloat16 only if the CPU multiplies it).
    Differentiable once, in state, action and weights; fixed components of the state get the identity gradient. Results
    depend neither on the batch nor on the number of threads, except by rounding with per-sample parameters, which torch
    folds. Thread-safe.

    The state maths is traced twice: for states whose fixed components equal the scene's reference pose, and for all
    others. In large scenes where hardly any body has fixed components, it is traced once for all states.

    Args:
        program: any of the programs to run.
        change: whether to run :meth:`delta` natively, instead of :meth:`step` and :meth:`rollout`.
    """

    fixed_batch = False

    def __init__(self, program: StepProgram, *, change: bool = False) -> None:
        layers, self.reason = list_layers(program)
        if layers is None:
            return
        self.change = change
        self.shapes = LayerShapes(layers)
        self.parameters = ParameterInputs.of(program)
        self.channels = program.layout.delta_size if change else program.layout.size
        self.numbers = len(program.reference) * program.layout.size  # numbers of a state
        work = sum(layer.count * layer.weight.numel() for layer in layers.layers)
        self.longest = int(_SECOND / (work + 1))  # steps of single samples, per thread in about a second
        try:
            with preparation(len(program.reference)):
                self._load()
                if program.dtype == torch.bfloat16 and not load_operators().has_bfloat16():
                    raise NoCompilerError("This processor multiplies no bfloat16.")
                self.structure = self._trace(program, layers)
        except (NoCompilerError, UntraceableError) as error:
            self.reason = str(error)

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_operator": None}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        if self.reason is None:
            try:
                self._load()
            except NoCompilerError as error:
                self.reason = str(error)

    def _load(self) -> None:
        self._operator = load_operators().rollout.default._op  # not wrapped in a Python frame

    def pack(self, program: StepProgram) -> StepProgram:
        """Return the program with its core as :class:`PackedLayers`; unchanged if torch must run it."""
        if self.reason is not None:
            return program
        core = program.core
        assert isinstance(core, ListedCore)
        layers, operators = core.layers(), load_operators()
        assert layers is not None
        sums = torch.float64 if program.dtype == torch.float64 else torch.float32
        weights = [layer.weight for layer in layers.layers]
        if program.dtype == torch.bfloat16:
            packed = pack_pairs(weights)
        else:  # if a module was cast to another dtype than float32 or float64, torch multiplies
            plain = torch.cat([weight.reshape(-1) for weight in weights]).to(sums)
            packed = operators.pack(plain.cpu(), self.shapes.weights, True).to(plain.device, program.dtype)
        tables = [
            layer.table.reshape(-1) for layer in layers.layers if layer.table is not None and layer.table.ndim == 2
        ]
        rows = torch.cat([*tables, packed.new_empty(0, dtype=sums)]).to(sums)
        core = PackedLayers(
            self.shapes,
            core.predicted,
            packed,
            operators.pack(rows.cpu(), self.shapes.tables, False).to(rows.device),
            self.parameters.numbers(program),
            pack_sample_tables(layers, sums),
        )
        return replace(program, core=core)

    def step(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        if (after := self._run(program, state, action, False)) is not None:
            return after, None
        return eager.step(program, state, action, hidden)

    def rollout(
        self, program: StepProgram, state: Tensor, actions: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        if (states := self._run(program, state, actions, True)) is not None:
            return states, None
        return eager.rollout(program, state, actions, hidden)

    def delta(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        """Return the predicted change ``[*B, N, 12]``; see :func:`~torchrl_gn.dynamics.executors.eager.delta`."""
        if (change := self._run(program, state, action, False)) is not None:
            return change, None
        return eager.delta(program, state, action, hidden)

    def _run(self, program: StepProgram, state: Tensor, actions: Tensor, many: bool) -> Tensor | None:
        core = program.core
        if self.reason is not None or not isinstance(core, PackedLayers):
            return None
        return self.call(core.weights, core.tables, core.sample_tables, core.numbers, state, actions, many)

    def call(
        self,
        weights: Tensor,
        tables: Tensor,
        sample_tables: Tensor | None,
        numbers: Tensor,
        state: Tensor,
        actions: Tensor,
        many: bool,
    ) -> Tensor | None:
        """Run the operator for actions ``[*B, A]``, or ``[*B, T, A]`` if ``many``; return None if torch must compute.

        The first four arguments are those of :class:`PackedLayers`. ValueError if shapes do not fit.
        """
        # The operator checks the rest: Python before a step of one state takes a tenth of the step's time.
        if type(state) not in _TENSORS or type(actions) not in _TENSORS:
            return None
        compiling = torch.compiler.is_compiling()
        if not compiling and (
            torch._C._are_functorch_transforms_active()
            or forward_ad._current_level >= 0
            or torch._C._len_torch_dispatch_stack()  # a mode that must see every operation
            or torch._C._get_tracing_state() is not None  # of torch.jit.trace
        ):
            return None
        packed = self.structure, weights, tables, sample_tables, numbers, self.channels
        try:
            if compiling:  # 0 stands for torch's number of threads, which the graph must not fix
                return torch.ops.torchrl_gn.rollout.default(state, actions, *packed, many, 0)
            steps, threads = actions.shape[-2] if many and actions.ndim > 1 else 1, native_threads()
            if steps * state.numel() > self.longest * self.numbers:
                return self._in_parts(state, actions, packed, many, threads)
            return self._operator(state, actions, *packed, many, threads)
        except NotImplementedError:  # other dtypes and devices, no sample, states without traced state maths
            return None

    def _in_parts(self, state: Tensor, actions: Tensor, packed: tuple, many: bool, threads: int) -> Tensor:
        """Run the operator in parts of about a second, because Python handles Ctrl-C only between them."""
        _, weights, tables, sample_tables, numbers, _ = packed
        batch, steps = actions.shape[: -2 if many else -1], actions.shape[-2] if many else 1
        size = _TILE * (threads or torch.get_num_threads()) * max(1, self.longest // (_TILE * steps))
        # Split time only for float64 states, which pass from call to call unrounded, and without gradients, whose sums
        # would have another order.
        learns = torch.is_grad_enabled() and (state.requires_grad or actions.requires_grad)
        span = steps if learns or state.dtype != torch.float64 else max(1, self.longest // _TILE)
        # The number of threads sets the size of parts, but weight gradients, sums over samples, must not depend on it.
        whole = sample_tables is not None or len(numbers) > 1 or weights.requires_grad or tables.requires_grad
        if whole or not batch or state.shape[:-2] != batch:
            return self._operator(state, actions, *packed, many, threads)
        parts = []
        for start, given in zip(
            state.flatten(0, -3).split(size), actions.flatten(0, len(batch) - 1).split(size), strict=True
        ):
            part = self._operator(start, given[:, :span] if many else given, *packed, many, threads)
            if part.requires_grad:
                part.register_hook(lambda gradient: None)  # runs Python between the gradients of parts
            spans = [part]
            for later in given[:, span:].split(span, 1) if many and span < steps else ():
                spans.append(self._operator(spans[-1][:, -1], later, *packed, many, threads)[:, 1:])
            parts.append(torch.cat(spans, 1) if len(spans) > 1 else part)
        return (torch.cat(parts) if len(parts) > 1 else parts[0]).unflatten(0, batch)

    def _trace(self, program: StepProgram, layers: LayerList) -> Tensor:
        """Trace the structure and compare its steps with torch's.

        Raises:
            UntraceableError: if the steps differ, or an operation has no scalar form.
        """
        reference = program.reference.detach().double().numpy()
        # A device context slows every operation, by a tenth: enter it only if another device is the default.
        with (
            _disable_current_modes(),
            contextlib.nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"),
            torch.no_grad(),
        ):
            # Channels that a step changes are not constant. Finding them by one numerical step saves a trace.
            constant = may_be_constant(program, reference)
            batch, moved = batch_of(program.parameters), _example(program, torch.from_numpy(constant), False)
            after = eager.step(program, moved.expand(*batch, -1, -1), _action(program).expand(*batch, -1))[0]
            constant &= (
                (np.abs(after.numpy() - reference) <= 1e-9 * (1 + np.abs(reference)))
                .reshape(-1, *constant.shape)
                .all(0)
            )
            special, general = self._both_maths(program, layers, reference, constant)
            words = structure(layers, special, general)
            self._compare(program, words, special.is_constant, general is not None)
        return words

    def _both_maths(
        self, program: StepProgram, layers: LayerList, reference: np.ndarray, constant: np.ndarray
    ) -> tuple[StateMaths, StateMaths | None]:
        """Return the state maths of usual and of other states; in large scenes, one for all if it is hardly longer."""
        usual = functools.partial(self._state_maths, program, layers, reference, constant)
        of_all_numbers = functools.partial(self._state_maths, program, layers, reference, np.zeros_like(constant))
        varies = ~constant.all(1, keepdims=True)  # [N, 1] bodies that move
        if len(reference) < LARGE or not varies.any() or constant.mean(where=varies) > _FEW:
            special, general = usual(), None
            with contextlib.suppress(UntraceableError):  # torch computes the states that need it
                general = of_all_numbers()
            return special, general
        try:
            return of_all_numbers(), None
        except UntraceableError:
            return usual(), None

    def _state_maths(
        self, program: StepProgram, layers: LayerList, state: np.ndarray, constant: np.ndarray
    ) -> StateMaths:
        """Return the state maths for states that equal ``state`` in the channels ``constant`` ``[N, C]``."""
        core, last = program.core, layers.layers[-1]
        assert isinstance(core, ListedCore)
        predicted = torch.arange(layers.nodes[0], device="cpu")[core.predicted].numpy()
        width = last.count * len(last.weight) // max(len(predicted), 1)
        state = np.where(constant, state, 0.0)
        maths = StateMaths(program, state, constant, predicted, width, self.parameters, self.change)
        _ = maths.forward, maths.adjoint  # assemble here, where callers handle tapes that are too long
        return maths

    def _compare(self, program: StepProgram, words: Tensor, constant: np.ndarray, general: bool) -> None:
        """Raise UntraceableError if steps in float64 differ from torch's, for states of each state maths."""
        core = program.core
        assert isinstance(core, ListedCore)
        program = replace(program, core=in_dtype(core, torch.float64), dtype=torch.float64)
        layers, batch = self.pack(program).core, batch_of(program.parameters)
        assert isinstance(layers, PackedLayers)
        for everywhere in (False, True)[: 1 + general]:
            state = _example(program, torch.from_numpy(constant), everywhere).expand(*batch, -1, -1)
            action = _action(program).expand(*batch, -1)
            reference = eager.delta(program, state, action)[0]
            inputs = words, layers.weights, layers.tables, layers.sample_tables, layers.numbers
            prediction = torch.ops.torchrl_gn.rollout(state, action, *inputs, self.channels, False, 1)
            if not self.change:
                reference, prediction = program.layout.apply(state, reference) - state, prediction - state
            sizes, errors = (each.flatten(-2).norm(dim=-1).flatten() for each in (reference, prediction - reference))
            wrong = sizes.isfinite() & ~(errors <= 1e-6 * sizes + 1e-12 * (1 + state.norm()))
            if wrong.any():
                worst = float((errors / sizes.clamp(min=1e-300))[wrong].max())
                raise UntraceableError(f"The native step differs from torch's by {worst:.1e} of the change.")


def list_layers(program: StepProgram) -> tuple[LayerList | None, str | None]:
    """Return the network as a list of layers, or the reason why it cannot be one."""
    core = program.core
    if program.recurrent is not None:
        return None, "a recurrent model runs by torch operations"
    if program.physics is not None and program.physics.outside:
        return None, "its physics run outside, so it runs by torch operations"
    if program.movable.device.type != "cpu":
        return None, f"on {program.movable.device.type}, it runs by torch operations"
    if program.dtype not in (*_NUMBERS, torch.bfloat16):
        return None, f"{str(program.dtype).removeprefix('torch.')} products run by torch operations"
    if not isinstance(core, ListedCore):
        if isinstance(core, UnfoldedCore) and core.reason is not None:
            return None, f"its core runs by message passing: {core.reason}"
        return None, "a core without fold() and layers() runs by torch operations"
    if not batch_of(program.parameters).numel():
        return None, "there is no sample"
    if (layers := core.layers()) is None:
        return None, "a core with dynamic globals runs by torch operations"
    return layers, None


def _action(program: StepProgram) -> Tensor:
    """Return an action ``[A]`` within its bounds."""
    low, high = (bound.clamp(-1, 1) for bound in (program.controls.action_low, program.controls.action_high))
    return 0.3 * low + 0.7 * high


def _example(program: StepProgram, constant: Tensor, everywhere: bool) -> Tensor:
    """Return a state ``[N, C]`` off the reference pose, in all components or in those that are not ``constant``."""
    generator = torch.Generator().manual_seed(0)
    reference, layout = program.reference.double(), program.layout
    change = 0.1 * torch.randn(len(reference), layout.delta_size, dtype=torch.float64, generator=generator)
    moved = layout.apply(reference, change if everywhere else change * program.movable)
    return moved if everywhere else torch.where(constant, reference, moved)
