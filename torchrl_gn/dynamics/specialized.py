"""A forward model folded for one scene: the same function, without what the scene doesn't need."""

from __future__ import annotations

import copy
import warnings
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from torchrl_gn.dynamics.executors.compiled import CompiledStep, check_compiler, check_torch
from torchrl_gn.dynamics.features.canonical_state import CanonicalState
from torchrl_gn.dynamics.predictor import Folded, Predictor
from torchrl_gn.dynamics.unseen_features import UnseenFeatureWarning
from torchrl_gn.networks.ablated_core import AblatedCore
from torchrl_gn.networks.folded_gn_core import FoldedCore, copy_into, snapshot
from torchrl_gn.networks.graph import Graph, graph_concat
from torchrl_gn.networks.mlp_core import FoldedMLP
from torchrl_gn.networks.recurrent_core import RecurrentCore
from torchrl_gn.processor import SlowDtypeWarning, product_speeds
from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class _Source:
    """A tensor that a snapshot was made from, and whether it is still the same."""

    def __init__(self, owner: dict[str, Any], name: str) -> None:
        self.owner, self.name, self.tensor = owner, name, owner[name]
        # Sharing the storage keeps it alive: nothing new can come to lie at its address.
        self.kept = None if self.tensor is None else self.tensor.detach()
        self.address = 0 if self.kept is None else self.kept.data_ptr()
        # PyTorch counts no changes of what was made in inference mode: it is never the same.
        self.version = None if self.kept is None or self.kept.is_inference() else self.kept._version

    def unchanged(self) -> bool:
        now = self.owner.get(self.name)
        if now is not self.tensor or now is None:
            return now is self.tensor
        return self.same(now)

    def same(self, now: Tensor) -> bool:
        """Whether a tensor, perhaps another view, shows the same numbers."""
        kept = self.kept
        return (
            kept is not None
            and not now.is_inference()
            and now.data_ptr() == self.address
            and now._version == self.version
            and (now.shape, now.stride(), now.dtype) == (kept.shape, kept.stride(), kept.dtype)
        )


class SpecializedPredictor(Predictor):
    """Forward model of one scene with everything constant folded away; made by :func:`specialize`.

    Predicts what the bound model predicts, from a *snapshot* of its weights, normalisers
    and the scene's static features. The snapshot looks after itself: when any of them was
    changed, moved or cast since (an optimiser step, ``load_state_dict``, ``to``), the next
    prediction folds again, so a stale one is never used. (Only a change through ``.data``, which
    PyTorch does not count, goes unseen.) Differentiable in states and actions, never in
    weights. Reads and writes the same keys as the bound model and stands in for it in
    environments, planners and rollouts. ``print`` shows what was skipped.

    Where samples bring physical parameters of their own (``parameters_key``), what depends on them is folded
    once for them, and again when others come: give a rollout's steps the same tensors.
    No gradient flows to them.
    """

    def __init__(self, bound: Predictor, *, dtype: torch.dtype | None = None, compile: bool = False) -> None:
        state_key, action_key = bound.in_keys[:2]
        with warnings.catch_warnings():  # the bound model has warned
            warnings.simplefilter("ignore", UnseenFeatureWarning)
            super().__init__(
                bound.model,
                bound.scene,
                state_key=state_key,
                action_key=action_key,
                parameters_key=bound.parameters_key,
                static_features=bound.statics.brought,
            )
        self.strict = bound.strict
        if compile:
            check_torch()
        if compile and bound.movable.device.type == "cpu":
            check_compiler()
        self._dtype, self.compile_steps = dtype, compile
        self._folded: Folded | None = None
        self._runs: list[tuple[bool, slice]] = []
        self._folds = 0
        self._sources: list[_Source] = []
        self._given: dict[str, _Source] = {}
        self._compiled: CompiledStep | None = None

    def __getstate__(self) -> dict:
        # A copy folds and compiles for itself.
        return {**super().__getstate__(), "_folded": None, "_sources": [], "_given": {}, "_compiled": None}

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the products."""
        return self._dtype or self.network_dtype

    def fold(self, parameters: TensorDictBase | None = None) -> Folded:
        """The snapshot, made again if anything it came from has changed."""
        if self._folded is None or not self._same(parameters) or not all(s.unchanged() for s in self._sources):
            runs = self._runs
            # What is made in inference mode could be neither overwritten nor differentiated outside.
            with torch.inference_mode(False), torch.no_grad():
                folded = self._fold(
                    PhysicalParameters(*(value.detach().clone() for value in self.statics.read(parameters)))
                )
                # A compiled step keeps the tensors, but has the runs in its code.
                if self._folded is None or self._runs != runs or not copy_into(self._folded, folded):
                    self._folded, self._compiled = folded, None
            self._folds += 1
            owners = [module._parameters for module in self.model.modules()]
            owners += [module._buffers for module in (*self.model.modules(), self, self.statics)]
            self._sources = [_Source(owner, name) for owner in owners for name in owner]
            given = {} if parameters is None else {str(name): value for name, value in parameters.items()}
            self._given = {name: _Source(given, name) for name in given}
        return self._folded

    def _same(self, parameters: TensorDictBase | None) -> bool:
        """Whether physical parameters are those of the snapshot."""
        given = {} if parameters is None else dict(parameters.items())
        return given.keys() == self._given.keys() and all(self._given[name].same(given[name]) for name in given)

    def _advance(
        self, state: Tensor, action: Tensor, folded: Folded, memory: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDictBase | None]:
        if not self.compile_steps:
            return super()._advance(state, action, folded)
        if self._compiled is None:
            plain = super()._advance
            self._compiled = CompiledStep(lambda state, action: plain(state, action, folded)[0], lambda: self._folds)
        return self._compiled(state, action), None

    def _fold(self, values: PhysicalParameters) -> Folded:
        model = self.model
        nodes, edges, residual = model.node_normalizer, model.edge_normalizer, model.residual_normalizer
        self.node_columns = (~nodes.constant).nonzero().flatten()
        self.edge_columns = (~edges.constant).nonzero().flatten()
        self.rows = (self.movable.any(0) & ~residual.constant).nonzero().flatten()
        self._runs = _runs(self.rows.tolist(), self.layout.delta_size)
        # In float64, so that folding loses nothing.
        core = copy.deepcopy(model.core).double()
        parameters = self.static_graph(values, torch.float64)
        full = core.fold(model.dynamic_size, self.incidence, parameters)
        assert isinstance(full, (FoldedCore, FoldedMLP))  # specialize() refuses others
        small = full.reduced(
            (self.node_columns, nodes.inverse_std[self.node_columns]),
            (self.edge_columns, edges.inverse_std[self.edge_columns]),
            (self.rows, residual.std[self.rows]),
            residual.mean[self.rows],
        )
        return Folded(snapshot(small, self.dtype), values)

    def _residual(self, seen: CanonicalState, action: Tensor, folded: Folded) -> Tensor:
        core = folded.core
        assert isinstance(core, (FoldedCore, FoldedMLP))
        encoded, controls = self.frame.features(seen, action, folded.values)
        nodes = _centered(encoded, self.model.node_normalizer.mean, self.node_columns)
        edges = _centered(controls, self.model.edge_normalizer.mean, self.edge_columns)
        dtype = core.out[0].dtype
        globals_ = nodes.new_zeros((*nodes.shape[:-2], 0), dtype=dtype)
        dynamic = Graph(nodes.to(dtype), edges.to(dtype), globals_, self.incidence.edge_index)
        predicted = core.predict(dynamic).to(seen.state.dtype)
        # Channels that never varied are predicted as what they were.
        constant = self.model.residual_normalizer.mean.to(predicted.dtype).expand(*predicted.shape[:-1], -1)
        return torch.cat([(predicted if varies else constant)[..., where] for varies, where in self._runs], dim=-1)

    def skipped(self) -> dict[str, tuple[float, float]]:
        """What a prediction of one state handles in the plain model, and here."""
        core, size, folded = self.model.core, self.model.dynamic_size, self.fold().core
        assert folded is not None
        nodes, edges = self.scene.num_nodes, self.scene.num_edges
        parameters = self.static_graph()

        def graph(nodes_: int, edges_: int, dtype: torch.dtype) -> Graph:
            def empty(*shape: int) -> Tensor:
                return torch.zeros(1, *shape, dtype=dtype, device=self.movable.device)

            return Graph(empty(nodes, nodes_), empty(edges, edges_), empty(0), self.incidence.edge_index)

        with FlopCounterMode(display=False) as plain, torch.no_grad():
            core(graph_concat(graph(size.nodes, size.edges, self.network_dtype), parameters))
        with FlopCounterMode(display=False) as quick, torch.no_grad():
            folded.predict(graph(len(self.node_columns), len(self.edge_columns), self.dtype))
        first = self.model.dynamic_size + self.model.static_size
        second = (
            {"edges of the second block": (edges, folded.gather.shape[0])} if isinstance(folded, FoldedCore) else {}
        )
        return {
            "node features": (first.nodes, len(self.node_columns)),
            "edge features": (first.edges, len(self.edge_columns)),
            "global features": (first.globals_, 0),
            "nodes predicted": (nodes, len(self.incidence.predicted)),
            "channels predicted": (self.layout.delta_size, len(self.rows)),
            **second,
            "kFLOP": (plain.get_total_flops() / 1e3, quick.get_total_flops() / 1e3),
        }

    def __str__(self) -> str:
        """Table of what was skipped."""
        name = str(self.dtype).removeprefix("torch.")
        lines = [f"Forward model of {self.scene.name}, specialised, {name}", f"  {'':26}{'plain':>10}{'here':>10}"]
        for what, (plain, here) in self.skipped().items():
            lines.append(f"  {what:26}{plain:10,.0f}{here:10,.0f}")
        return "\n".join(lines)


def specialize(bound: Predictor, *, dtype: torch.dtype | None = None, compile: bool = False) -> SpecializedPredictor:
    """Fold everything that a scene doesn't need out of its forward model.

    The result predicts the same function with fewer operations: static features and
    biases become tables, layers that are linear in a row are merged, inputs that never
    varied and channels, nodes and edges that don't matter are left out
    (:mod:`~torchrl_gn.networks.folded_gn_core`).

    Args:
        bound: the forward model of the scene.
        dtype: dtype of the products, by default the network's. ``torch.bfloat16`` is faster where the processor
            has instructions for it (``torchrl-gn doctor`` tells) and many times slower elsewhere, which warns
            (:class:`~torchrl_gn.processor.SlowDtypeWarning`). States keep their dtype.
        compile: compile ``step`` and ``rollout`` with ``torch.compile``, at their first call with
            every new shape: half a minute then, minutes for a gradient, and much faster steps of small batches.

    Returns:
        A module with the same keys that shares the weights and folds them again when they change.

    Raises:
        FileNotFoundError: to compile for a CPU without a C++ compiler.
        RuntimeError: to compile with a torch before 2.13.
        TypeError: for a recurrent core, or one of the ablation study.
    """
    if isinstance(bound.model.core, (AblatedCore, RecurrentCore)):
        kind = "the ablation study" if isinstance(bound.model.core, AblatedCore) else "recurrent models"
        raise TypeError(f"The cores of {kind} cannot be specialised; use the bound model.")
    if dtype is not None and bound.movable.device.type == "cpu" and not product_speeds().pays(dtype):
        warnings.warn(
            f"This processor multiplies {str(dtype).removeprefix('torch.')} {product_speeds().slowdown(dtype):.1f}"
            " times more slowly than float32: leave out dtype.",
            SlowDtypeWarning,
            stacklevel=2,
        )
    return SpecializedPredictor(bound, dtype=dtype, compile=compile)


def _runs(rows: list[int], size: int) -> list[tuple[bool, slice]]:
    """Where to take a full row of ``size`` from: from kept ``rows`` lying side by side, or from their constants."""
    runs: list[tuple[bool, slice]] = []
    for column in range(size):
        kept = column in rows
        place = rows.index(column) if kept else column
        if runs and runs[-1][0] == kept and runs[-1][1].stop == place:
            runs[-1] = (kept, slice(runs[-1][1].start, place + 1))
        else:
            runs.append((kept, slice(place, place + 1)))
    return runs


def _centered(features: Tensor, mean: Tensor, columns: Tensor) -> Tensor:
    """Kept columns less their mean: large numbers cancel before they are rounded."""
    return features[..., columns] - mean[columns].to(features.dtype)
