"""Inference model: estimates a system's physical parameters from its motion (implicit system identification)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.dynamics import BoundPredictor, ForwardModel
from torchrl_gn.dynamics.bound import dynamic_graph, residual
from torchrl_gn.dynamics.constraints import AnchorEstimator
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.gn_block import GNBlock
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat, graph_split
from torchrl_gn.scenes import Scene, require_bodies


class Context(NamedTuple):
    """Recurrent state of the inference after some observations."""

    hidden: Graph  # hidden graph of the network
    estimate: Graph  # static graph estimated so far
    count: int  # number of observations
    anchors: Tensor | None  # [*B, N, 7, 7] normal equations of the anchor offsets; None without constraint projection


class Estimate(NamedTuple):
    """Estimate from observations of a system.

    The inferred static graph has ``nodes`` ``[*B, N, 10]``, ``edges`` ``[*B, E, 10]`` and ``globals_`` ``[*B, 10]``;
    with constraint projection also the anchor offsets ``parent_anchor`` and ``child_anchor`` ``[*B, N, 3]``.
    """

    parameters: TensorDict  # [*B], the inferred static graph
    context: Context  # to continue from with more observations


class InferenceModel(nn.Module):
    """Recurrent graph network over dynamic graphs (paper, "Inference models", SM "Forward prediction with System ID").

    Holds weights only and knows no scene. Each observation is a transition: the dynamic graph of a state and an action,
    with the change that followed as further node features (paper: states and actions alone). The hidden graph passes
    through a tanh, so that it stays bounded for any number of observations.

    Args:
        inferred: numbers of node, edge and global features of the inferred static graph.
        hidden_state: numbers of node, edge and global features of the hidden graph.
        readout: estimate from several observations: the ``"mean"`` of the network's outputs after each, or the output
            after the ``"last"`` (paper).
    """

    def __init__(
        self,
        observed: GraphSize,
        *,
        inferred: Sequence[int] = (10, 10, 10),
        hidden_state: Sequence[int] = (20, 20, 20),
        edge_hidden: Sequence[int] = (64, 64),
        node_hidden: Sequence[int] = (64, 64),
        global_hidden: Sequence[int] = (64, 64),
        activation: str = "silu",
        readout: Literal["mean", "last"] = "mean",
    ) -> None:
        super().__init__()
        if readout not in ("mean", "last"):
            raise ValueError(f"readout must be 'mean' or 'last', got {readout!r}.")
        self.readout = readout
        self.inferred_size, self.hidden_size = GraphSize(*inferred), GraphSize(*hidden_state)
        sizes: dict[str, Any] = {"edge_hidden": list(edge_hidden), "node_hidden": list(node_hidden)}
        sizes["global_hidden"] = list(global_hidden)
        self.options = {"inferred": list(inferred), "hidden_state": list(hidden_state), **sizes}
        self.options |= {"activation": activation, "readout": readout}
        size = self.inferred_size + self.hidden_size
        self.block = GNBlock(observed + self.hidden_size, size, activation=activation, **sizes)

    def start(self, observed: Graph) -> Graph:
        """Return the initial hidden graph, zeros, for the batch of an observation ``[*B, ...]``."""
        return observed.zeros(self.hidden_size)

    @without_autocast
    def forward(self, observed: Graph, hidden: Graph) -> tuple[Graph, Graph]:
        """Return the output for one observation, and the hidden graph for the next."""
        size = self.inferred_size
        output, rest = graph_split(self.block(graph_concat(observed, hidden)), (size.nodes, size.edges, size.globals_))
        return output, Graph(*[part.tanh() for part in rest.features], edge_index=rest.edge_index)


class BoundInferenceModel(TensorDictModuleBase):
    """Inference model bound to one scene; infers the static graph of its systems from observed transitions.

    Reads a sequence at ``identification``, laid out like TorchRL's trajectories: ``state`` ``[*B, T, N, 13]``,
    ``action`` ``[*B, T, A]`` and ``("next", "state")``. Writes a TensorDict ``[*B]`` of the inferred graph at
    ``parameters``, where a forward model with ``parameters="inferred"`` reads it. Identify a system once, save the
    entry, and use it for any number of rollouts. True physical parameters are not read.

    If the forward model projects onto joint constraints, the anchor offsets are estimated by least squares
    (:class:`~torchrl_gn.dynamics.constraints.AnchorEstimator`).
    """

    def __init__(
        self,
        model: InferenceModel,
        predictor: BoundPredictor,
        *,
        observed_key: NestedKey = "identification",
        parameters_key: NestedKey = "parameters",
    ) -> None:
        super().__init__()
        key = (observed_key,) if isinstance(observed_key, str) else tuple(observed_key)
        self.model, self.predictor = model, predictor
        self.anchors = None
        if predictor.projection is not None:
            self.anchors = AnchorEstimator(require_bodies(predictor.scene, "An inference model")).to(
                predictor.movable.device
            )
        self.in_keys: list[NestedKey] = [(*key, "state"), (*key, "action"), (*key, "next", "state")]
        self.out_keys: list[NestedKey] = [parameters_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the estimate from the observed sequence into ``tensordict``; KeyError if it has no such sequence."""
        state, action, next_state = (tensordict.get(key, None) for key in self.in_keys)
        if state is None or action is None or next_state is None:
            raise KeyError(f"The inference model reads {self.in_keys}, the input has {list(tensordict.keys(True))}.")
        return tensordict.set(self.out_keys[0], self.infer(state, action, next_state).parameters)

    def infer(self, state: Tensor, action: Tensor, next_state: Tensor, context: Context | None = None) -> Estimate:
        """Estimate the static graph from a sequence of transitions.

        Args:
            state: ``[*B, T, N, 13]``, like ``next_state``.
            action: ``[*B, T, A]``, each applied in the state of its step.
            context: context of earlier observations of the same systems; default: none.

        Raises:
            ValueError: if there is no transition, or a shape does not fit the scene.
        """
        *_, last = self._contexts(state, action, next_state, context)
        return self._estimate(last)

    def identify(self, states: Tensor, actions: Tensor) -> TensorDict:
        """Infer the graph from whole trajectories: states ``[*B, T + 1, N, 13]``, actions ``[*B, T, A]``."""
        return self.infer(states[..., :-1, :, :], actions, states[..., 1:, :, :]).parameters

    def infer_each(
        self, state: Tensor, action: Tensor, next_state: Tensor, context: Context | None = None
    ) -> Iterator[Estimate]:
        """Yield the estimate after each transition; see :meth:`infer`."""
        for each in self._contexts(state, action, next_state, context):
            yield self._estimate(each)

    def _contexts(
        self, state: Tensor, action: Tensor, next_state: Tensor, context: Context | None
    ) -> Iterator[Context]:
        if state.shape[-3] == 0 or next_state.shape != state.shape:
            raise ValueError(
                "The inference model needs at least one transition, states and next states of equal shape; got"
                f" {list(state.shape)} and {list(next_state.shape)}."
            )
        # Compute features of all steps at once: only the graph network is recurrent.
        predictor = self.predictor
        dynamic = dynamic_graph(predictor, state, action)
        change = predictor.model.residual_normalizer(
            residual(predictor.program(), state, action, next_state), predictor.dtype
        )
        nodes = torch.cat((dynamic.nodes, change * predictor.movable), dim=-1)
        anchors = self._anchor_sums(state, next_state, context)
        for step in range(state.shape[-3]):
            edges, globals_ = dynamic.edges[..., step, :, :], dynamic.globals_[..., step, :]
            now = Graph(nodes[..., step, :, :], edges, globals_, dynamic.edge_index)
            output, hidden = self.model(now, self.model.start(now) if context is None else context.hidden)
            count = 1 if context is None else context.count + 1
            if context is not None and self.model.readout == "mean":
                parts = zip(context.estimate.features, output.features, strict=True)
                output = Graph(*[torch.lerp(mean, new, 1 / count) for mean, new in parts], edge_index=output.edge_index)
            context = Context(hidden, output, count, None if anchors is None else anchors[..., step, :, :, :])
            yield context

    @without_autocast
    def _anchor_sums(self, state: Tensor, next_state: Tensor, context: Context | None) -> Tensor | None:
        """Return normal equations of the anchor offsets after each transition, ``[*B, T, N, 7, 7]``."""
        if self.anchors is None:
            return None
        # Use both states of every transition, because transitions need not be consecutive.
        sums = self.anchors.sums(torch.stack((state, next_state), dim=-3)).cumsum(-4)
        return sums if context is None or context.anchors is None else sums + context.anchors.unsqueeze(-4)

    @without_autocast
    def _estimate(self, context: Context) -> Estimate:
        parameters = context.estimate.tensordict()
        if self.anchors is not None and context.anchors is not None:
            parent_anchor, child_anchor = self.anchors.solve(context.anchors)
            parameters.update({"parent_anchor": parent_anchor, "child_anchor": child_anchor})
        return Estimate(parameters, context)


class IdentifyingModel(nn.Module):
    """A forward model and the inference model that estimates its physical parameters, trained together.

    The forward model must have ``parameters="inferred"``; ``options`` are those of :class:`InferenceModel`.
    """

    def __init__(self, forward_model: ForwardModel, **options) -> None:
        super().__init__()
        source = forward_model.parameter_source
        if source != "inferred":
            raise ValueError(f"The forward model reads parameters={source!r}; build it with 'inferred'.")
        self.forward_model, size = forward_model, forward_model.inferred_size
        options["inferred"] = (size.nodes, size.edges, size.globals_)
        observed = forward_model.dynamic_size + GraphSize(forward_model.layout.delta_size, 0, 0)
        self.inference = InferenceModel(observed, **options)

    def bind(self, scene: Scene, **options) -> tuple[BoundPredictor, BoundInferenceModel]:
        """Bind both models to a scene; neither reads its physical parameters. See :meth:`ForwardModel.bind`.

        The inference model writes the entry ``"parameters"``, which the forward model reads.
        """
        predictor = self.forward_model.bind(scene, parameters_key="parameters", **options)
        return predictor, BoundInferenceModel(self.inference, predictor)

    def description(self) -> dict:
        """Return plain, JSON-able values from which :meth:`from_description` rebuilds the model."""
        return {"forward_model": self.forward_model.description(), "inference": self.inference.options}

    @classmethod
    def from_description(cls, description: dict) -> IdentifyingModel:
        """Build the model of a :meth:`description`, with fresh weights."""
        return cls(ForwardModel.from_description(description["forward_model"]), **description["inference"])
