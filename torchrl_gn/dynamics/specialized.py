"""Specialised predictors: snapshots of the weights, folded for one scene."""

from __future__ import annotations

import copy
import json
import warnings
from dataclasses import replace
from typing import cast, overload

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from torchrl_gn.dynamics.bound import BoundPredictor, UnseenParameterWarning, static_graph
from torchrl_gn.dynamics.ensemble import BoundEnsemble
from torchrl_gn.dynamics.executors import EXECUTORS, CudaExecutor, EagerExecutor, NativeExecutor
from torchrl_gn.dynamics.predictor import Predictor, check_shapes, check_steps, require_bound
from torchrl_gn.dynamics.program import Executor, InputScaling, PreparedStep, StepProgram, structure_key
from torchrl_gn.dynamics.snapshot import Snapshot
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.core import dtype_of
from torchrl_gn.networks.folded_gn_core import FoldedGNCore
from torchrl_gn.networks.graph import Graph, graph_concat
from torchrl_gn.networks.tensor_tree import copy_of, in_dtype
from torchrl_gn.processor import SlowDtypeWarning, product_speeds
from torchrl_gn.scenes import Articulation


class SpecializedPredictor(Predictor):
    """Predictor with everything constant in its scene folded away; made by :func:`specialize`.

    It is a snapshot: it keeps the weights that the given predictor had at that time, even if training continues.
    :meth:`refresh` takes the new weights, in place. The folded weights are its buffers, without other copies, so module
    operations (``to``, ``load_state_dict``, copies, pickles, shared memory, a collector's weight update,
    ``functional_call``) apply to the model. A modified core (dropout, hooks, adapters) is copied as it is, in its
    current mode: call ``eval()`` first.

    Differentiable in states and actions, never in weights. Native gradients are first-order only; fixed components get
    the identity gradient. Reads and writes the keys of the given predictor. ``print`` shows what was skipped, and the
    executor. ``torch.compile`` takes native steps and rollouts as operators.

    With a ``parameters_key``, it keeps a copy of the weights instead and folds it for the samples' parameters at each
    call; :meth:`prepared` folds once for many calls. No gradient flows to the parameters.
    """

    @without_autocast
    def __init__(
        self, predictor: BoundPredictor, *, executor: str = "native", dtype: torch.dtype | None = None
    ) -> None:
        state_key, action_key = predictor.in_keys[:2]
        keys = {"state_key": state_key, "action_key": action_key, "parameters_key": predictor.parameters_key}
        super().__init__(predictor.scene, predictor.layout, recurrent=predictor.recurrent, **keys)
        self.executor_name = executor
        self.snapshot: Snapshot | None = None
        self.source: BoundPredictor | None = None  # predictor whose core each call folds
        self._executors: dict[tuple, Executor] = {}  # by structure of the programs they run
        # Tensors made in inference mode could be neither overwritten nor differentiated outside it.
        with torch.inference_mode(False), torch.no_grad():
            self._products = dtype or predictor.dtype
            program = _folded(predictor, None, self._products)
            self._form = _form(predictor, program)
            self.executor = self._executors[structure_key(program)] = EXECUTORS[executor](program)
            if predictor.parameters_key is None:
                self.snapshot = Snapshot(self.executor.pack(program))
                self.reader = copy.deepcopy(predictor.parameter_reader)
            else:
                self.source = _frozen_copy(predictor)
            squares = predictor.training_squares()
            self._squares = tuple(squares)
            self.register_buffer("squares", torch.stack([*squares.values(), torch.zeros_like(program.reference[0, 0])]))
        self._skipped = _skipped(predictor, program)

    @property
    def dtype(self) -> torch.dtype:
        return self._products if self.snapshot is None else self.snapshot.dtype

    @property
    def fixed_batch(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.executor.fixed_batch

    @property
    def reason(self) -> str | None:
        """Reason why torch operations replace the executor's kernels; None without this fallback."""
        home = {NativeExecutor: "cpu", CudaExecutor: "cuda"}.get(type(self.executor))
        device = self.squares.device.type
        return self.executor.reason or (None if home in (None, device) else f"on {device}, it runs by torch operations")

    @without_autocast
    @torch.no_grad()
    def refresh(self, predictor: BoundPredictor) -> None:
        """Take the weights of a model bound to the same scene, in place, so that shared memory gets them too.

        Raises:
            ValueError: if the model differs in more than numbers: another scene, other options or physics, or, after
                its normalisers got more data, other features that vary.
        """
        with torch.inference_mode(False):
            program = _folded(predictor, None, self.dtype)
            if _form(predictor, program) != self._form:
                raise ValueError(
                    f"{type(self).__name__} of {self.scene.name!r} cannot take these weights: the model has other"
                    " options, scene or physics, or other features vary in its training. Specialise it anew."
                )
            if self.snapshot is not None:
                self.snapshot.load(self.executor.pack(program))
            else:
                assert self.source is not None
                self.source.model.load_state_dict(predictor.model.state_dict())
            self.squares[: len(self._squares)] = torch.stack(list(predictor.training_squares().values()))

    def step(
        self,
        state: Tensor,
        action: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDict | None]:
        if parameters is None and hidden_state is None and (after := self._native(state, action, False)) is not None:
            return after, None
        return super().step(state, action, parameters, hidden_state)

    def rollout(
        self,
        state: Tensor,
        actions: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
        *,
        prepared: PreparedStep | None = None,
    ) -> tuple[Tensor, TensorDict | None]:
        if parameters is None and hidden_state is None and (states := self._native(state, actions, True)) is not None:
            return states, None
        return super().rollout(state, actions, parameters, hidden_state, prepared=prepared)

    def _native(self, state: Tensor, actions: Tensor, many: bool) -> Tensor | None:
        """Return the native operator's result, or None if there is no operator.

        Skips building the program, which takes longer than a step of one state.
        """
        snapshot, executor = self._modules.get("snapshot"), self.executor
        if snapshot is None or type(executor) is not NativeExecutor or executor.reason is not None:
            return None
        packed = snapshot._buffers
        numbers = packed["core_weights"], packed["core_tables"], None, packed["core_numbers"]
        try:
            return executor.call(*numbers, state, actions, many)
        except ValueError:
            (check_steps if many else check_shapes)(self.scene, state, actions)  # raises an error that names the misfit
            raise

    def program(self, parameters: TensorDictBase | None = None) -> StepProgram:
        """Return the step as data, packed for its executor."""
        return self.prepared(parameters).program

    @without_autocast
    def prepared(self, parameters: TensorDictBase | None = None, *, size: int = 1) -> PreparedStep:
        if self.snapshot is not None:
            if parameters is not None:
                raise ValueError("Samples have parameters of their own: bind with parameters_key, then specialise.")
            return PreparedStep(self.executor, self.snapshot.program())
        assert self.source is not None
        with torch.no_grad():
            program = _folded(self.source, parameters, self._products)
            if torch.compiler.is_compiling():  # the compiler traces the fold
                return PreparedStep(EagerExecutor(program), program)
            key = structure_key(program)
            if (executor := self._executors.get(key)) is None:
                executor = self._executors[key] = EXECUTORS[self.executor_name](program)
            return PreparedStep(executor, executor.pack(program))

    @property
    def scene_parameters(self):
        """The scene's physical parameters, without batch."""
        return self._reader.own

    @property
    def _reader(self):
        return self.reader if self.source is None else self.source.parameter_reader

    @property
    def _edge_index(self) -> Tensor:
        return self.snapshot.get("edge_index") if self.snapshot is not None else self.source._edge_index  # pyright: ignore

    def own_parameters(self) -> TensorDict:
        return self._reader.entries()

    def parameters_of(self, scene: Articulation) -> TensorDict:
        if self.source is None:
            raise ValueError("The model is of one scene: bind with parameters_key, then specialise.")
        return self.source.parameters_of(scene, stacklevel=2)

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        return self._reader.find(tensordict)

    def initial_hidden_state(self) -> TensorDict | None:
        if not self.recurrent:
            return None
        program = self.program()
        assert program.recurrent is not None and program.static is not None
        return program.recurrent.start(program.static).tensordict()

    def recentered(self, states: Tensor) -> Tensor:
        if self.source is not None:
            return self.source.recentered(states)
        assert self.snapshot is not None
        return self.snapshot.get("canonicalizer").recentered(states)

    def training_squares(self) -> dict[str, Tensor]:
        return dict(zip(self._squares, self.squares, strict=False))

    def skipped(self) -> dict[str, tuple[float, float]]:
        """Return counts of one prediction (features, nodes, kFLOP) by name: in the reference model, and here."""
        return dict(self._skipped)

    def _apply(self, fn, recurse: bool = True):
        squares = self.squares
        super()._apply(fn, recurse)
        if self.squares.dtype != squares.dtype:
            self.squares = squares.to(self.squares.device)
        if self.source is not None:
            self._products = fn(torch.empty(0, dtype=self._products)).dtype
        return self

    def __str__(self) -> str:
        """Format :meth:`skipped` as a table."""
        name = str(self.dtype).removeprefix("torch.")
        how = self.executor_name if self.reason is None else f"{self.executor_name}, but here by torch: {self.reason}"
        lines = [f"Forward model of {self.scene.name}, specialised, {name}, {how}"]
        lines.append(f"  {'':26}{'plain':>10}{'here':>10}")
        for what, (plain, here) in self._skipped.items():
            lines.append(f"  {what:26}{plain:10,.0f}{here:10,.0f}")
        return "\n".join(lines)


@overload
def specialize(
    predictor: BoundPredictor, *, executor: str = "native", dtype: torch.dtype | None = None
) -> SpecializedPredictor: ...


@overload
def specialize(
    predictor: BoundEnsemble, *, executor: str = "native", dtype: torch.dtype | None = None
) -> BoundEnsemble: ...


def specialize(
    predictor: BoundPredictor | BoundEnsemble, *, executor: str = "native", dtype: torch.dtype | None = None
) -> SpecializedPredictor | BoundEnsemble:
    """Specialise a bound model: fold everything that is constant in its scene.

    The result makes the same predictions with fewer operations. Static features and biases become tables, adjacent
    linear layers are merged, and features, components, nodes and edges without effect are left out. A core without
    :meth:`~torchrl_gn.networks.Core.fold` is evaluated as it is. The result is a snapshot:
    :meth:`SpecializedPredictor.refresh` takes weights that training has changed. For an ensemble, each member is
    specialised.

    Args:
        predictor: a model bound to a scene, or an ensemble.
        executor: one of :data:`~torchrl_gn.dynamics.executors.EXECUTORS`. ``"native"`` runs steps, rollouts and their
            gradients in C++ that is built once, in a minute, and cached, or in CUDA on an NVIDIA GPU. Where it cannot
            (a recurrent core, float16, no compiler), it runs as ``"eager"``, and ``print`` shows the reason.
            ``"eager"`` runs torch operations anywhere. ``"compiled"``, for GPUs and models that native cannot run,
            compiles at the first call with every new shape: half a minute, minutes for a gradient.
        dtype: dtype of the products, by default the network's. ``torch.bfloat16`` is faster on processors that multiply
            it (see ``torchrl-gn doctor``); on others it is many times slower, with a
            :class:`~torchrl_gn.processor.SlowDtypeWarning`. States keep their dtype.

    Raises:
        FileNotFoundError: if ``"compiled"`` finds no C++ compiler for a CPU.
        RuntimeError: if ``"compiled"`` runs with torch before 2.13.
        TypeError: if the model is not bound, or is specialised already; or if ``"compiled"`` gets a core that is
            evaluated by message passing, or physics outside torch; or if ``dtype`` is no ``torch.dtype``.
        ValueError: if the executor is not known.
    """
    require_bound(predictor)
    if isinstance(predictor, BoundEnsemble):
        members = cast("list[BoundPredictor]", predictor.members)  # the calls below check each
        made = [specialize(each, executor=executor, dtype=dtype) for each in members]
        return BoundEnsemble(made, predictor.calibration)
    if not isinstance(predictor, BoundPredictor):
        raise TypeError(f"specialize() takes a bound model, not {type(predictor).__name__}: use model.bind(scene).")
    if executor not in EXECUTORS:
        raise ValueError(f"executor={executor!r} is not known; use one of {list(EXECUTORS)}.")
    if not (dtype is None or isinstance(dtype, torch.dtype)):
        raise TypeError(f"dtype={dtype!r} must be a torch.dtype, such as torch.bfloat16.")
    if dtype is not None and predictor.movable.device.type == "cpu" and not product_speeds().pays(dtype):
        warnings.warn(
            f"This processor multiplies {str(dtype).removeprefix('torch.')} {product_speeds().slowdown(dtype):.1f}"
            " times more slowly than float32: leave out dtype.",
            SlowDtypeWarning,
            stacklevel=2,
        )
    return SpecializedPredictor(predictor, executor=executor, dtype=dtype)


@without_autocast
def _folded(predictor: BoundPredictor, parameters: TensorDictBase | None, dtype: torch.dtype) -> StepProgram:
    """Build a snapshot of the step in a dtype, without features and components that never varied."""
    # In float64, so that folding loses nothing. A copy takes longer than folding: a frozen float64 core needs none.
    core = predictor.model.core
    if dtype_of(core) != torch.float64 or any(weight.requires_grad for weight in core.parameters()):
        core = copy_of(core).double().requires_grad_(False)
    moves = predictor.movable.any(0)
    rows = torch.cat([moves & ~each.constant for each in predictor.model.output_normalizers]).nonzero().flatten()
    program = predictor.program(parameters, reference=False, reduced=True, rows=rows, core=core)
    changed = {name: in_dtype(getattr(program, name), dtype) for name in ("core", "recurrent", "static")}
    return replace(program, dtype=dtype, **changed)


def _form(predictor: BoundPredictor, program: StepProgram) -> tuple:
    """Return a key that is equal for predictors whose numbers are interchangeable, in any dtype."""
    model = predictor.model
    try:
        options = json.dumps(model.description(), sort_keys=True, default=str)
    except ValueError:  # a feature has no name
        options = repr((model.features, model.core_name, sorted(model.core_options.items())))
    return structure_key(replace(program, dtype=torch.float64)), options, predictor.scene.fingerprint()


def _frozen_copy(predictor: BoundPredictor) -> BoundPredictor:
    """Return the predictor with a copy of the weights, in float64, so that folding loses nothing."""
    model = copy_of(predictor.model).requires_grad_(False)
    model.core.double()
    state_key, action_key = predictor.in_keys[:2]
    with warnings.catch_warnings():  # the given predictor has warned already
        warnings.simplefilter("ignore", UnseenParameterWarning)
        copied = BoundPredictor(
            model,
            predictor.scene,
            state_key=state_key,
            action_key=action_key,
            parameters_key=predictor.parameters_key,
            parameter_names=predictor.parameter_reader.brought,
        )
    copied.strict = predictor.strict  # applies to other variants
    return copied


def _skipped(predictor: BoundPredictor, program: StepProgram) -> dict[str, tuple[float, float]]:
    """Count features, nodes and kFLOP of one prediction, by name: in the reference model, and in a program."""
    core, size = predictor.model.core, predictor.model.dynamic_size
    nodes, edges = predictor.scene.num_nodes, predictor.incidence.num_edges
    static = static_graph(predictor, predictor.scene_parameters, dtype_of(core))
    kept_nodes, kept_edges = _width(program.nodes, size.nodes), _width(program.edges, size.edges)

    def graph(nodes_: int, edges_: int, dtype: torch.dtype) -> Graph:
        def empty(*shape: int) -> Tensor:
            return torch.zeros(1, *shape, dtype=dtype, device=predictor.movable.device)

        dynamic = Graph(empty(nodes, nodes_), empty(edges, edges_), empty(0), predictor.incidence.edge_index)
        return graph_concat(dynamic, dynamic.zeros(core.hidden_size)) if core.recurrent else dynamic

    with FlopCounterMode(display=False) as plain, torch.no_grad():
        core(graph_concat(graph(size.nodes, size.edges, dtype_of(core)), static))
    with FlopCounterMode(display=False) as quick, torch.no_grad():
        program.core.predict(graph(kept_nodes, kept_edges, program.dtype))
    rows = {
        "node features": (size.nodes + static.nodes.shape[-1], kept_nodes),
        "edge features": (size.edges + static.edges.shape[-1], kept_edges),
        "global features": (static.globals_.shape[-1], 0),
        "nodes predicted": (nodes, len(predictor.incidence.predicted)),
    }
    if program.output.runs is not None:
        moved = sum(where.stop - where.start for varies, where in program.output.runs if varies)
        rows["components predicted"] = (len(program.output.mean), moved)
    if isinstance(program.core, FoldedGNCore):
        rows["edges of the second block"] = (edges, program.core.gather.shape[0])
    return {**rows, "kFLOP": (plain.get_total_flops() / 1e3, quick.get_total_flops() / 1e3)}


def _width(inputs: InputScaling, full: int) -> int:
    return full if inputs.columns is None else len(inputs.columns)
