"""A predictor from a snapshot of its weights, without what the scene does not need."""

from __future__ import annotations

import copy
import itertools
import threading
import warnings
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.utils.flop_counter import FlopCounterMode

from torchrl_gn.dynamics import operators
from torchrl_gn.dynamics.checks import UnseenParameterWarning, require_bound
from torchrl_gn.dynamics.executors import EXECUTORS, EagerExecutor
from torchrl_gn.dynamics.executors.native.binding import load_binding, make_plan
from torchrl_gn.dynamics.normalization import scaled, static_graph
from torchrl_gn.dynamics.physics import Physics
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.dynamics.program import Executor, InputScaling, StepProgram
from torchrl_gn.dynamics.watched import Watched, is_same, version_of
from torchrl_gn.networks.core import dtype_of
from torchrl_gn.networks.folded_gn_core import FoldedGNCore
from torchrl_gn.networks.graph import Graph, graph_concat
from torchrl_gn.networks.snapshot import snapshot
from torchrl_gn.processor import SlowDtypeWarning, product_speeds
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

_TAKING = threading.Lock()  # one thread takes a snapshot, others wait for it


class _Snapshot(NamedTuple):
    """What runs the step, and what it was made of."""

    executor: Executor
    weights: Watched
    casts: int  # of the model, before them
    given: dict[str, tuple[Tensor, int]]  # parameters of samples, and how often each was changed


class SpecializedPredictor(Predictor):
    """Predictor with everything constant in its scene folded away; made by :func:`specialize`.

    Predicts what the given predictor predicts, from a *snapshot* of its weights and normalisers, made again when one of
    them has changed (an optimiser step, ``load_state_dict``, ``to``). A change through ``.data``, which PyTorch does
    not count, goes unseen: call :meth:`refresh`. Differentiable in states and actions, never in weights. Native
    gradients are of first order; that in a component of the state that cannot move is that of copying it. Reads and
    writes the same keys. ``print`` shows what was skipped and what runs it. ``torch.compile`` takes steps and rollouts
    as operators.

    Samples with parameters of their own (``parameters_key``) are folded once, and again for others: give a rollout's
    steps the same tensors. No gradient flows to them.
    """

    def __init__(self, predictor: Predictor, *, executor: str = "native", dtype: torch.dtype | None = None) -> None:
        state_key, action_key = predictor.in_keys[:2]
        with warnings.catch_warnings():  # the predictor has warned
            warnings.simplefilter("ignore", UnseenParameterWarning)
            super().__init__(
                predictor.model,
                predictor.scene,
                state_key=state_key,
                action_key=action_key,
                parameters_key=predictor.parameters_key,
                parameter_names=predictor.parameter_reader.brought,
            )
        self.strict, self.executor_name = predictor.strict, executor
        self._dtype = dtype
        self._taken: _Snapshot | None = None
        self._plan: Any = None  # of a single step, if it can be called without ctypes
        self.number = operators.register(self)
        # Refuse now what the executor cannot run, not at the first step.
        if not getattr(EXECUTORS[executor], "runs_all", True):
            self.executor()

    def __getstate__(self) -> dict:
        # A copy folds and compiles for itself.
        return {**super().__getstate__(), "_taken": None, "_plan": None}

    def __setstate__(self, state: dict) -> None:
        super().__setstate__(state)
        self.number = operators.register(self)

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the products."""
        return self._dtype or dtype_of(self.model.core)

    @property
    def fixed_batch(self) -> bool:
        return getattr(EXECUTORS[self.executor_name], "fixed_batch", False)

    def refresh(self) -> None:
        """Take a new snapshot of the weights at the next step."""
        if self._taken is not None:
            self._taken = self._taken._replace(weights=Watched([]))
        self._plan = None

    def step(
        self,
        state: Tensor,
        action: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDict | None]:
        if parameters is not None or hidden_state is not None or torch.compiler.is_compiling():
            return super().step(state, action, parameters, hidden_state)
        if self._plan is not None and (after := load_binding().step(self._plan, state, action)) is not None:
            return after, None
        out = super().step(state, action)
        taken = self._taken
        if self._plan is None and taken is not None and not taken.given:
            self._plan = make_plan(taken.executor, self.scene, taken.weights, taken.casts, vars(self.model))
        return out

    def executor(self, parameters: TensorDictBase | None = None) -> Executor:
        """What runs the step, from a snapshot of the weights as they are now.

        Within ``torch.compile`` steps and rollouts are operators; with parameters of samples, or a hidden state, they
        fold in the compiled code, which then follows the weights.
        """
        if torch.compiler.is_compiling():
            if parameters is None and not self.recurrent:
                return operators.OperatorExecutor(self)  # pyright: ignore[reportReturnType]
            with torch.no_grad():
                return EagerExecutor(super().program(parameters))
        taken = self._taken  # once: another thread may take a snapshot for other weights or parameters
        if taken is None or not self._is_current(taken, parameters):
            with _TAKING:
                taken = self._taken
                if taken is None or not self._is_current(taken, parameters):
                    self._taken = taken = self._take(parameters)
        return taken.executor

    def _take(self, parameters: TensorDictBase | None) -> _Snapshot:
        """A snapshot of the weights as they are now."""
        modules = list(self.model.modules())
        owners: list[dict[str, Any]] = [module._parameters for module in modules]
        owners += [module._buffers for module in modules]
        weights = itertools.chain.from_iterable(owner.values() for owner in owners)
        if any(one is not None and is_functorch_wrapped_tensor(one) for one in weights):
            raise TypeError(
                "A specialised model has a snapshot of its weights, which torch.func cannot exchange: stack or"
                " differentiate the bound model."
            )
        watched, casts = Watched(owners), self.model.casts  # before they are read: another thread may change them
        # Tensors made in inference mode could be neither overwritten nor differentiated outside.
        with torch.inference_mode(False), torch.no_grad():
            program = self.program(parameters)
            if self._taken is None:
                executor = EXECUTORS[self.executor_name](program)
            else:
                executor = self._taken.executor.update(program)
        self._plan = None
        # Views that share the storage keep it alive: no other tensor can come to lie at its address.
        given = {} if parameters is None else {str(name): value for name, value in parameters.items()}
        kept = {name: (value.detach(), version_of(value)) for name, value in given.items()}
        return _Snapshot(executor, watched, casts, kept)

    def _is_current(self, taken: _Snapshot, parameters: TensorDictBase | None) -> bool:
        model = self._modules["model"]  # not self.model: torch looks that up in a microsecond
        if not taken.weights.unchanged() or model.casts != taken.casts:  # pyright: ignore[reportOptionalMemberAccess]
            return False
        if parameters is None:
            return not taken.given
        given = dict(parameters.items())
        return given.keys() == taken.given.keys() and all(
            is_same(given[str(name)], *kept) for name, kept in taken.given.items()
        )

    def program(
        self, parameters: TensorDictBase | None = None, *, reference: bool = False, reduced: bool = True
    ) -> StepProgram:
        """Snapshot of the step, without features and components that never vary; whole as the ``reference``."""
        if reference:
            return super().program(parameters, reference=True)
        values = PhysicalParameters(*(value.detach().clone() for value in self.parameter_reader.read(parameters)))
        # In float64, so that folding loses nothing.
        core = copy.deepcopy(self.model.core).double()
        folded = core.fold(self.incidence, static_graph(self, values, torch.float64))
        rows = (self.movable.any(0) & ~self.model.residual_normalizer.constant).nonzero().flatten()
        folded, nodes, edges, output = scaled(self, folded, rows if reduced else None)
        return StepProgram(
            **self.constants(),
            parameters=values,
            nodes=_copied(nodes),
            edges=_copied(edges),
            recurrent=snapshot(core, self.dtype) if core.recurrent else None,
            static=static_graph(self, values, self.dtype) if core.recurrent else None,
            core=snapshot(folded, self.dtype),
            output=_copied(output),
            change_std=self.model.delta_normalizer.std.clone(),
            dtype=self.dtype,
            physics=_frozen(self.model.physics),
        )

    def skipped(self) -> dict[str, tuple[float, float]]:
        """What one prediction handles in the reference model, and here."""
        program, core, size = self.executor().program, self.model.core, self.model.dynamic_size
        nodes, edges = self.scene.num_nodes, self.incidence.num_edges
        static = static_graph(self, self.scene_parameters, dtype_of(core))
        kept_nodes, kept_edges = _width(program.nodes, size.nodes), _width(program.edges, size.edges)

        def graph(nodes_: int, edges_: int, dtype: torch.dtype) -> Graph:
            def empty(*shape: int) -> Tensor:
                return torch.zeros(1, *shape, dtype=dtype, device=self.movable.device)

            dynamic = Graph(empty(nodes, nodes_), empty(edges, edges_), empty(0), self.incidence.edge_index)
            return graph_concat(dynamic, dynamic.zeros(core.hidden_size)) if core.recurrent else dynamic

        with FlopCounterMode(display=False) as plain, torch.no_grad():
            core(graph_concat(graph(size.nodes, size.edges, dtype_of(core)), static))
        with FlopCounterMode(display=False) as quick, torch.no_grad():
            program.core.predict(graph(kept_nodes, kept_edges, self.dtype))
        rows = {
            "node features": (size.nodes + static.nodes.shape[-1], kept_nodes),
            "edge features": (size.edges + static.edges.shape[-1], kept_edges),
            "global features": (static.globals_.shape[-1], 0),
            "nodes predicted": (nodes, len(self.incidence.predicted)),
        }
        if program.output.runs is not None:
            moved = sum(where.stop - where.start for varies, where in program.output.runs if varies)
            rows["components predicted"] = (self.layout.delta_size, moved)
        if isinstance(program.core, FoldedGNCore):
            rows["edges of the second block"] = (edges, program.core.gather.shape[0])
        return {**rows, "kFLOP": (plain.get_total_flops() / 1e3, quick.get_total_flops() / 1e3)}

    def __str__(self) -> str:
        """Table of what was skipped."""
        name = str(self.dtype).removeprefix("torch.")
        reason = getattr(self.executor(), "reason", None)
        how = self.executor_name if reason is None else f"{self.executor_name}, but here by torch: {reason}"
        lines = [f"Forward model of {self.scene.name}, specialised, {name}, {how}"]
        lines.append(f"  {'':26}{'plain':>10}{'here':>10}")
        for what, (plain, here) in self.skipped().items():
            lines.append(f"  {what:26}{plain:10,.0f}{here:10,.0f}")
        return "\n".join(lines)


def specialize(
    predictor: Predictor, *, executor: str = "native", dtype: torch.dtype | None = None
) -> SpecializedPredictor:
    """Fold everything that a scene does not need out of its forward model.

    The result predicts the same with fewer operations: static features and biases become tables, adjacent linear layers
    are merged, features, components, nodes and edges that do not matter are left out. A core without
    :meth:`~torchrl_gn.networks.Core.fold` is evaluated as it is.

    Args:
        executor: one of :data:`~torchrl_gn.dynamics.executors.EXECUTORS`. ``"native"`` runs steps, rollouts and their
            gradients in C++ that is built once, 20 s, and kept; where it cannot (a GPU, a recurrent core, float16, no
            compiler), as ``"eager"``, and ``print`` says why. ``"eager"`` runs torch operations anywhere.
            ``"compiled"``, for GPUs and what native cannot run, compiles at the first call with every new shape: half a
            minute, minutes for a gradient.
        dtype: dtype of the products, by default the network's. ``torch.bfloat16`` is faster where the processor
            multiplies it (``torchrl-gn doctor`` tells) and many times slower elsewhere, which warns
            (:class:`~torchrl_gn.processor.SlowDtypeWarning`). States keep their dtype.

    Raises:
        FileNotFoundError: to compile for a CPU without a C++ compiler.
        RuntimeError: to compile with a torch before 2.13.
        TypeError: to compile a core that is evaluated by message passing.
        ValueError: if the executor is not known.
    """
    require_bound(predictor)
    if executor not in EXECUTORS:
        raise ValueError(f"executor={executor!r} is not known; use one of {list(EXECUTORS)}.")
    if dtype is not None and predictor.movable.device.type == "cpu" and not product_speeds().pays(dtype):
        warnings.warn(
            f"This processor multiplies {str(dtype).removeprefix('torch.')} {product_speeds().slowdown(dtype):.1f}"
            " times more slowly than float32: leave out dtype.",
            SlowDtypeWarning,
            stacklevel=2,
        )
    return SpecializedPredictor(predictor, executor=executor, dtype=dtype)


def _width(inputs: InputScaling, full: int) -> int:
    return full if inputs.columns is None else len(inputs.columns)


def _frozen(physics: Physics | None) -> Physics | None:
    """The physics, or a copy of those that are trained."""
    if physics is None or not physics.trained:
        return physics
    return copy.deepcopy(physics).requires_grad_(False)


def _copied(scaling: Any) -> Any:
    """The same named tuple with copies of its tensors."""
    return type(scaling)(*(part.detach().clone() if isinstance(part, Tensor) else part for part in scaling))
