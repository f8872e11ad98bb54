"""A recurrent forward model joined to one scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor

from torchrl_gn.modules.bound_forward_model import BoundForwardModel, Folded
from torchrl_gn.modules.graph import Graph, graph_concat
from torchrl_gn.modules.recurrent_core import RecurrentCore

if TYPE_CHECKING:
    from torchrl_gn.modules.forward_model import ForwardModel
    from torchrl_gn.scenes import Scene


class BoundRecurrentModel(BoundForwardModel):
    """Predict the next state from the present one and from what was seen before it (paper, "Forward models").

    As :class:`BoundForwardModel`, with a memory: it also reads ``memory``, a TensorDict ``[*B]`` of ``nodes``
    ``[*B, N, 20]``, ``edges`` ``[*B, E, 20]`` and ``globals_`` ``[*B, 20]``, and writes ``("next", "memory")``.
    Where there is none yet it remembers nothing. ``ModelEnv`` carries it from step to step.

    For systems whose state says not all, such as motors with lag or joints with hysteresis. Made by
    :meth:`ForwardModel.bind` of a model with ``core="recurrent"``.
    """

    def __init__(self, model: ForwardModel, scene: Scene, **options) -> None:
        super().__init__(model, scene, **options)
        self.in_keys.append("memory")
        self.out_keys.append(("next", "memory"))

    @property
    def core(self) -> RecurrentCore:
        """The recurrent core."""
        assert isinstance(self.model.core, RecurrentCore)
        return self.model.core

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the predicted next state and the memory into ``tensordict`` and return it."""
        state, action = (tensordict[key] for key in self.in_keys[:2])
        folded = self.fold(self.static_in(tensordict))
        self._check_shapes(state, action)
        memory = tensordict.get("memory", None)
        delta, memory = self.delta_and_memory(state, action, folded, memory)
        tensordict.set(self.out_keys[0], self.layout.apply(state, delta))
        return tensordict.set(self.out_keys[1], memory)

    def own_memory(self) -> TensorDict:
        """Memory of nothing, without batch."""
        return self.core.start(self.static_graph()).tensordict()

    def delta_and_memory(
        self, state: Tensor, action: Tensor, folded: Folded | None = None, memory: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDict]:
        """Predicted change of the state ``[*B, N, 12]``, and what is remembered after it.

        Args:
            state: ``[*B, N, 13]``.
            action: ``[*B, A]``.
            folded: what :meth:`fold` gave.
            memory: of the states before; by default there were none.
        """
        folded = folded or self.fold()
        seen = self.frame.see(state, folded.values)
        dynamic, static = self._dynamic_graph(seen, action, folded.values), self.static_graph(folded.values)
        before = self.core.start(dynamic) if memory is None else _graph(memory, self.edge_index)
        after = self.core.remember(dynamic, static, before)
        dynamic = graph_concat(dynamic, after)
        if folded.core is not None:
            residual = self.model(dynamic, folded.core)
        else:
            normalized = self.model.core(graph_concat(dynamic, static)).nodes
            residual = self.model.residual_normalizer.inverse(normalized)
        return self._settled(state, residual, seen, folded.values), after.tensordict()

    def _delta(self, state: Tensor, action: Tensor, folded: Folded) -> Tensor:
        return self.delta_and_memory(state, action, folded)[0]

    def observe(
        self, states: Tensor, actions: Tensor, static: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDict]:
        """Feed a sequence of true states.

        Args:
            states: ``[*B, T, N, 13]``.
            actions: ``[*B, T, A]``, each applied in the state of its step.
            static: static values of every sample, by default the scene's.

        Returns:
            Predictions ``[*B, T, N, 13]`` of the state after each of them, and the memory after the last.

        Raises:
            ValueError: if there is no state.
        """
        if states.shape[-3] == 0:
            raise ValueError("There is no state to remember.")
        folded, memory, predictions = self.fold(static), None, []
        for state, action in zip(states.unbind(-3), actions.unbind(-2), strict=True):
            delta, memory = self.delta_and_memory(state, action, folded, memory)
            predictions.append(self.layout.apply(state, delta))
        assert memory is not None
        return torch.stack(predictions, dim=-3), memory

    def rollout(
        self,
        state: Tensor,
        actions: Tensor,
        static: TensorDictBase | None = None,
        memory: TensorDictBase | None = None,
    ) -> Tensor:
        """States from a start state under a sequence of actions, remembering what comes on the way.

        Args:
            state: ``[*B, N, 13]`` start states.
            actions: ``[*B, T, A]``.
            static: static values of every rollout, or without batch; by default the scene's.
            memory: of the states before the start, as :meth:`observe` gives it.

        Returns:
            ``[*B, T + 1, N, 13]``; the first is the start state itself.
        """
        return self.rollout_and_memory(state, actions, static, memory)[0]

    def rollout_and_memory(
        self,
        state: Tensor,
        actions: Tensor,
        static: TensorDictBase | None = None,
        memory: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDictBase | None]:
        """As :meth:`rollout`, with the memory at its end, to go on from."""
        for action in actions.unbind(-2)[:1]:
            self._check_shapes(state, action, static)
        states, folded = [state], self.fold(static)
        for action in actions.unbind(-2):
            delta, memory = self.delta_and_memory(states[-1], action, folded, memory)
            states.append(self.layout.apply(states[-1], delta))
        return torch.stack(states, dim=-3), memory


def _graph(memory: TensorDictBase, edge_index: Tensor) -> Graph:
    return Graph(memory["nodes"], memory["edges"], memory["globals_"], edge_index)
