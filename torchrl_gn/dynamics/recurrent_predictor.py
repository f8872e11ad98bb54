"""A recurrent forward model joined to one scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor

from torchrl_gn.dynamics.predictor import Folded, Predictor
from torchrl_gn.dynamics.shapes import check_shapes
from torchrl_gn.networks.graph import Graph, graph_concat
from torchrl_gn.networks.recurrent_core import RecurrentCore

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel
    from torchrl_gn.scenes import Scene


class RecurrentPredictor(Predictor):
    """Predict the next state from the present one and from what was seen before it (paper, "Forward models").

    As :class:`Predictor`, with a hidden state: it also reads ``hidden_state``, a TensorDict ``[*B]`` of ``nodes``
    ``[*B, N, 20]``, ``edges`` ``[*B, E, 20]`` and ``globals_`` ``[*B, 20]``, and writes ``("next", "hidden state")``.
    Where there is none yet it remembers nothing. ``ModelEnv`` carries it from step to step.

    For systems whose state says not all, such as motors with lag or joints with hysteresis. Made by
    :meth:`ForwardModel.bind` of a model with ``core="recurrent"``.
    """

    def __init__(self, model: ForwardModel, scene: Scene, **options) -> None:
        super().__init__(model, scene, **options)
        self.in_keys.append("hidden_state")
        self.out_keys.append(("next", "hidden_state"))

    @property
    def core(self) -> RecurrentCore:
        """The recurrent core."""
        assert isinstance(self.model.core, RecurrentCore)
        return self.model.core

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the predicted next state and the hidden state into ``tensordict`` and return it."""
        state, action = (tensordict[key] for key in self.in_keys[:2])
        parameters = self.parameters_in(tensordict)
        check_shapes(self.scene, state, action, parameters)
        next_state, hidden_state = self._advance(
            state, action, self.fold(parameters), tensordict.get("hidden_state", None)
        )
        tensordict.set(self.out_keys[0], next_state)
        return tensordict.set(self.out_keys[1], hidden_state)

    def initial_hidden_state(self) -> TensorDict:
        """Memory of nothing, without batch."""
        return self.core.start(self.static_graph()).tensordict()

    def delta_and_hidden_state(
        self, state: Tensor, action: Tensor, folded: Folded | None = None, hidden_state: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDict]:
        """Predicted change of the state ``[*B, N, 12]``, and what is remembered after it.

        Args:
            state: ``[*B, N, 13]``.
            action: ``[*B, A]``.
            folded: what :meth:`fold` gave.
            hidden_state: of the states before; by default there were none.

        Raises:
            ValueError: if a shape does not fit the scene.
        """
        check_shapes(self.scene, state, action)
        folded = folded or self.fold()
        seen = self.frame.see(state, folded.values)
        dynamic, parameters = self._dynamic_graph(seen, action, folded.values), self.static_graph(folded.values)
        before = self.core.start(dynamic) if hidden_state is None else _graph(hidden_state, self.incidence.edge_index)
        after = self.core.remember(dynamic, parameters, before)
        dynamic = graph_concat(dynamic, after)
        if folded.core is not None:
            residual = self.model(dynamic, folded.core)
        else:
            normalized = self.model.core(graph_concat(dynamic, parameters)).nodes
            residual = self.model.residual_normalizer.inverse(normalized)
        return self._settled(state, residual, seen, folded.values), after.tensordict()

    def _delta(self, state: Tensor, action: Tensor, folded: Folded) -> Tensor:
        return self.delta_and_hidden_state(state, action, folded)[0]

    def _advance(
        self, state: Tensor, action: Tensor, folded: Folded, hidden_state: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDict]:
        delta, hidden_state = self.delta_and_hidden_state(state, action, folded, hidden_state)
        return self.layout.apply(state, delta), hidden_state

    def observe(
        self, states: Tensor, actions: Tensor, parameters: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDict]:
        """Feed a sequence of true states.

        Args:
            states: ``[*B, T, N, 13]``.
            actions: ``[*B, T, A]``, each applied in the state of its step.
            parameters: physical parameters of every sample, by default the scene's.

        Returns:
            Predictions ``[*B, T, N, 13]`` of the state after each of them, and the hidden state after the last.

        Raises:
            ValueError: if there is no state, or a shape does not fit the scene.
        """
        if states.shape[-3] == 0:
            raise ValueError("There is no state to remember.")
        check_shapes(self.scene, states[..., 0, :, :], actions[..., 0, :], parameters)
        folded, hidden_state, predictions = self.fold(parameters), None, []
        for state, action in zip(states.unbind(-3), actions.unbind(-2), strict=True):
            predicted, hidden_state = self._advance(state, action, folded, hidden_state)
            predictions.append(predicted)
        assert hidden_state is not None
        return torch.stack(predictions, dim=-3), hidden_state


def _graph(hidden_state: TensorDictBase, edge_index: Tensor) -> Graph:
    return Graph(hidden_state["nodes"], hidden_state["edges"], hidden_state["globals_"], edge_index)
