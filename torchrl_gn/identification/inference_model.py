"""Inference model: what a system is like, found from how it moves (implicit system identification)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.dynamics.constraints.anchor_estimation import AnchorEstimator
from torchrl_gn.dynamics.model import ForwardModel
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.networks.gn_block import GNBlock
from torchrl_gn.networks.graph import Graph, GraphSize, graph_concat, graph_split
from torchrl_gn.scenes import Scene

SMALLEST_WEIGHT = 1e-3  # of an observation; all of them together are divided by


class Memory(NamedTuple):
    """What is kept of observations, to go on with more.

    Attributes:
        hidden: hidden graph of the network.
        told: what is inferred so far: the mean of what each observation told, or what the last one did.
        weight: the sum of the weights of what was told.
        pins: ``[*B, N, 7, 7]`` what was seen of where bodies are joined together; None where they are not linked.
    """

    hidden: Graph
    told: Graph
    weight: Graph
    pins: Tensor | None


class Inferred(NamedTuple):
    """What observations of a system tell.

    Attributes:
        parameters: TensorDict ``[*B]`` of the inferred static graph: ``nodes`` ``[*B, N, 10]``, ``edges`` ``[*B, E, 10]``
            and ``globals_`` ``[*B, 10]``; where the forward model links bodies also where they are joined together:
            ``parent_anchor`` and ``arm`` ``[*B, N, 3]``.
        hidden_state: what to go on with when there are more observations.
    """

    parameters: TensorDict
    hidden_state: Memory


class InferenceModel(nn.Module):
    """Recurrent graph network over dynamic graphs (paper, "Inference models", SM "Forward prediction with System ID").

    Holds weights only and knows no scene. Each observation is a transition: the dynamic graph of a state and an action,
    with what came of it on its nodes; the paper's model sees states and actions and has to remember the last one
    to see any change. Its hidden graph passes through a tanh, so that it stays bounded for any number of observations;
    the paper says nothing of how.

    Args:
        observed: features of a normalised observation.
        inferred: features of the inferred static graph.
        hidden_state: features of the hidden graph.
        edge_hidden: hidden sizes of the edge MLP.
        node_hidden: hidden sizes of the node MLP.
        global_hidden: hidden sizes of the global MLP.
        activation: between the layers.
        readout: what is inferred of several observations: the ``"mean"`` of what the network says after each, that mean
            ``"weighted"`` by how much it says that each feature tells, or what it says after the ``"last"`` (paper).

    Raises:
        ValueError: if ``readout`` or the activation is not known.
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
        readout: Literal["mean", "weighted", "last"] = "mean",
    ) -> None:
        super().__init__()
        if readout not in ("mean", "weighted", "last"):
            raise ValueError(f"readout must be 'mean', 'weighted' or 'last', got {readout!r}.")
        self.readout = readout
        self.inferred_size, self.memory_size = GraphSize(*inferred), GraphSize(*hidden_state)
        self.options = {
            "inferred": list(inferred),
            "hidden_state": list(hidden_state),
            "edge_hidden": list(edge_hidden),
            "node_hidden": list(node_hidden),
            "global_hidden": list(global_hidden),
            "activation": activation,
            "readout": readout,
        }
        self.block = GNBlock(
            observed + self.memory_size,
            (self.inferred_size + self.inferred_size if readout == "weighted" else self.inferred_size)
            + self.memory_size,
            edge_hidden=edge_hidden,
            node_hidden=node_hidden,
            global_hidden=global_hidden,
            activation=activation,
        )

    def start(self, observed: Graph) -> Graph:
        """Hidden graph before any observation, for a batch like that of an observation ``[*B, ...]``."""
        return observed.zeros(self.memory_size)

    def forward(self, observed: Graph, hidden_state: Graph) -> tuple[Graph, Graph, Graph]:
        """One observation: what it tells of the static graph, how much that weighs, hidden graph for the next."""
        size = self.inferred_size
        sizes = (size.nodes, size.edges, size.globals_)
        told, rest = graph_split(self.block(graph_concat(observed, hidden_state)), sizes)
        if self.readout == "weighted":
            weight, rest = graph_split(rest, sizes)
            weight = _combine(lambda value: value.sigmoid() + SMALLEST_WEIGHT, weight)
        else:
            weight = _combine(torch.ones_like, told)
        return told, weight, _combine(torch.tanh, rest)


class BoundInferenceModel(TensorDictModuleBase):
    """Infer the static graph of one scene's systems from observed transitions.

    Reads a sequence at ``identification``, laid out as TorchRL's trajectories are: ``state`` ``[*B, T, N, 13]``,
    ``action`` ``[*B, T, A]`` and ``("next", "state")``. Writes a TensorDict ``[*B]`` of the inferred graph at
    ``parameters``, where a forward model with ``parameters="inferred"`` reads it. It is one entry a system: identify once, save
    it, and use it for any number of rollouts from any state. True physical parameters are not read, only what moves.

    Where the forward model links bodies, the joint anchors are found beside the network, by least squares
    (:class:`~torchrl_gn.dynamics.constraints.anchor_estimation.AnchorEstimator`).

    Args:
        model: the weights.
        bound: the forward model of the scene, whose features and normalisers it shares.
        observed_key: where the observed sequence is.
        parameters_key: where to write the inferred graph.
    """

    def __init__(
        self,
        model: InferenceModel,
        bound: Predictor,
        *,
        observed_key: NestedKey = "identification",
        parameters_key: NestedKey = "parameters",
    ) -> None:
        super().__init__()
        key = (observed_key,) if isinstance(observed_key, str) else tuple(observed_key)
        self.model, self.bound = model, bound
        self.pins = AnchorEstimator(bound.scene).to(bound.movable.device) if bound.projection is not None else None
        self.in_keys: list[NestedKey] = [(*key, "state"), (*key, "action"), (*key, "next", "state")]
        self.out_keys: list[NestedKey] = [parameters_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the observed sequence tells into ``tensordict`` and return it.

        Raises:
            KeyError: if there is no observed sequence.
        """
        state, action, next_state = (tensordict.get(key, None) for key in self.in_keys)
        if state is None or action is None or next_state is None:
            raise KeyError(f"The inference model reads {self.in_keys}; there is {list(tensordict.keys(True))}.")
        return tensordict.set(self.out_keys[0], self.infer(state, action, next_state).parameters)

    def infer(self, state: Tensor, action: Tensor, next_state: Tensor, hidden_state: Memory | None = None) -> Inferred:
        """What a sequence of transitions tells.

        Args:
            state: ``[*B, T, N, 13]``.
            action: ``[*B, T, A]``, each applied in the state of its step.
            next_state: ``[*B, T, N, 13]``, what came of it.
            hidden_state: of earlier observations of the same systems; default: none were made.

        Returns:
            What is known after the last observation.

        Raises:
            ValueError: if there is no observation, or a shape does not fit the scene.
        """
        *_, last = self._observe(state, action, next_state, hidden_state)
        return self._known(last)

    def identify(self, states: Tensor, actions: Tensor) -> TensorDict:
        """The inferred graph of whole trajectories.

        Args:
            states: ``[*B, T + 1, N, 13]``.
            actions: ``[*B, T, A]``; each leads from a state to the next.
        """
        return self.infer(states[..., :-1, :, :], actions, states[..., 1:, :, :]).parameters

    def observe(
        self, state: Tensor, action: Tensor, next_state: Tensor, hidden_state: Memory | None = None
    ) -> Iterator[Inferred]:
        """As :meth:`infer`, yielding what is known after each observation."""
        for known in self._observe(state, action, next_state, hidden_state):
            yield self._known(known)

    def _observe(
        self, state: Tensor, action: Tensor, next_state: Tensor, hidden_state: Memory | None
    ) -> Iterator[Memory]:
        if state.shape[-3] == 0 or next_state.shape != state.shape:
            raise ValueError(
                "The inference model needs at least one transition, states and next states of equal shape; got"
                f" {list(state.shape)} and {list(next_state.shape)}."
            )
        # Features of all steps at once: only the graph network is recurrent.
        bound = self.bound
        dynamic = bound.dynamic_graph(state, action)
        change = bound.model.residual_normalizer(bound.residual(state, next_state), bound.network_dtype)
        nodes = torch.cat((dynamic.nodes, change * bound.movable), dim=-1)
        pins = self._pins(state, next_state, hidden_state)
        for step in range(state.shape[-3]):
            now = Graph(
                nodes[..., step, :, :],
                dynamic.edges[..., step, :, :],
                dynamic.globals_[..., step, :],
                dynamic.edge_index,
            )
            told, weight, hidden = self.model(
                now, self.model.start(now) if hidden_state is None else hidden_state.hidden
            )
            if hidden_state is not None and self.model.readout != "last":
                total = _combine(torch.add, hidden_state.weight, weight)
                share = _combine(torch.div, weight, total)
                told, weight = _combine(torch.lerp, hidden_state.told, told, share), total
            hidden_state = Memory(hidden, told, weight, None if pins is None else pins[..., step, :, :, :])
            yield hidden_state

    def _pins(self, state: Tensor, next_state: Tensor, hidden_state: Memory | None) -> Tensor | None:
        """What was seen of the joint anchors after each observation, ``[*B, T, N, 7, 7]``."""
        if self.pins is None:
            return None
        # Both ends of every transition: they need not follow each other.
        sums = self.pins.sums(torch.stack((state, next_state), dim=-3)).cumsum(-4)
        return sums if hidden_state is None or hidden_state.pins is None else sums + hidden_state.pins.unsqueeze(-4)

    def _known(self, hidden_state: Memory) -> Inferred:
        """What is known, as the forward model reads it."""
        parameters = hidden_state.told.tensordict()
        if self.pins is not None and hidden_state.pins is not None:
            parent_anchor, child_anchor = self.pins.solve(hidden_state.pins)
            parameters.update({"parent_anchor": parent_anchor, "child_anchor": child_anchor})
        return Inferred(parameters, hidden_state)


def _combine(function: Callable[..., Tensor], first: Graph, *others: Graph) -> Graph:
    """A function of the features of graphs of one topology."""
    return Graph(
        function(first.nodes, *(graph.nodes for graph in others)),
        function(first.edges, *(graph.edges for graph in others)),
        function(first.globals_, *(graph.globals_ for graph in others)),
        first.edge_index,
    )


class IdentifyingModel(nn.Module):
    """A forward model and the inference model that tells it what its systems are like, trained together.

    Args:
        forward_model: with ``parameters="inferred"``.
        **options: of :class:`InferenceModel`.

    Raises:
        ValueError: if the forward model does not read an inferred graph.
    """

    def __init__(self, forward_model: ForwardModel, **options) -> None:
        super().__init__()
        if forward_model.parameter_source != "inferred":
            raise ValueError(f"The forward model reads static={forward_model.static!r}; build it with 'inferred'.")
        self.forward_model, size = forward_model, forward_model.inferred_size
        options["inferred"] = (size.nodes, size.edges, size.globals_)
        observed = forward_model.dynamic_size + GraphSize(forward_model.layout.delta_size, 0, 0)
        self.inference = InferenceModel(observed, **options)

    def bind(self, scene: Scene, **options) -> tuple[Predictor, BoundInferenceModel]:
        """Both models joined to a scene, the forward model reading at ``"parameters"`` what the other writes there.

        Args:
            scene: the scene, whose own physical parameters neither reads.
            **options: of :meth:`ForwardModel.bind`.
        """
        bound = self.forward_model.bind(scene, parameters_key="parameters", **options)
        return bound, BoundInferenceModel(self.inference, bound)

    def description(self) -> dict:
        """Everything needed to build this model again, as plain JSON-able values."""
        return {"forward_model": self.forward_model.description(), "inference": self.inference.options}

    @classmethod
    def from_description(cls, description: dict) -> IdentifyingModel:
        """Build the model that :meth:`description` described, with fresh weights."""
        return cls(ForwardModel.from_description(description["forward_model"]), **description["inference"])
