"""A forward model joined to one scene: the TensorDict module that predicts."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from torchrl_gn.dynamics.constraints.generalized_coordinates import make_projection
from torchrl_gn.dynamics.features.canonical_state import Canonicalizer, CanonicalState
from torchrl_gn.dynamics.parameters import ParameterReader
from torchrl_gn.dynamics.shapes import check_shapes
from torchrl_gn.dynamics.unseen_features import check_seen
from torchrl_gn.finite import require_finite
from torchrl_gn.maths import quaternion
from torchrl_gn.networks.graph import Graph, graph_concat
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.scenes.physical_parameters import PhysicalParameters, topology

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel
    from torchrl_gn.networks.ablated_core import UnfoldedCore
    from torchrl_gn.networks.folded_gn_core import FoldedCore
    from torchrl_gn.networks.mlp_core import FoldedMLP
    from torchrl_gn.scenes import ParameterNames, Scene


class Folded(NamedTuple):
    """What many predictions of the same bodies share.

    Attributes:
        core: the network with all that is constant folded; None where it is evaluated plainly.
        values: the numbers of the scene, or of every sample's.
    """

    core: FoldedCore | FoldedMLP | UnfoldedCore | None
    values: PhysicalParameters


class Predictor(TensorDictModuleBase):
    """Predict the next state of one scene with a forward model's shared weights.

    Reads ``state`` ``[*B, N, 13]`` and ``action`` ``[*B, A]``, writes
    ``("next", "state")`` ``[*B, N, 13]`` in the dtype of ``state``. The network
    sees recentred, normalised values in its own dtype, so float64 states keep
    their precision with a float32 network. Differentiable in states, actions and
    weights. Made by :meth:`ForwardModel.bind`.

    With a ``parameters_key`` every sample may be another variant of the scene (lengths, masses, ...):
    the module then also reads a TensorDict of the entries of
    :class:`~torchrl_gn.scenes.physical_parameters.PhysicalParameters`, as :meth:`parameters_of` gives them or an
    inference model writes them. Without one, samples that bring other values are refused. A model with
    ``parameters="none"`` or ``"inferred"`` never reads a sample's true values, nor does anything around
    its network: bodies are linked where an inference model has found their joint anchors, and without one not at all.

    Args:
        model: the shared weights.
        scene: the scene to predict.
        strict: raise, instead of warning, on features that training never saw vary.
        plain: evaluate the core as the paper writes it, by message passing, edge by edge. The same
            function, slowly: what everything faster is compared with.
        state_key: where to read the state.
        action_key: where to read the action.
        parameters_key: where to read each sample's physical parameters; None: they are the scene's.
        static_features: names of the static features that samples bring there; None: all that the scene has.

    Raises:
        ValueError: if the scene lacks features that the model reads, or is a variant whose parameters must be hidden
            from it, or with ``strict``.
    """

    model: ForwardModel
    movable: Tensor

    def __init__(
        self,
        model: ForwardModel,
        scene: Scene,
        *,
        strict: bool = False,
        plain: bool = False,
        state_key: NestedKey = "state",
        action_key: NestedKey = "action",
        parameters_key: NestedKey | None = None,
        static_features: ParameterNames | None = None,
    ) -> None:
        super().__init__()
        self.parameters_key = parameters_key
        self.in_keys: list[NestedKey] = [state_key, action_key]
        if parameters_key is not None:
            self.in_keys.append(parameters_key)
        self.out_keys: list[NestedKey] = [unravel_key(("next", state_key))]
        items = model.options["items"]
        if items is not None and tuple(items) != (scene.num_nodes, scene.num_edges):
            raise ValueError(
                f"The model is an MLP for graphs of {items[0]} nodes and {items[1]} edges; scene {scene.name!r} has"
                f" {scene.num_nodes} and {scene.num_edges}. Train another, or a graph network."
            )
        if model.parameter_source != "scene" and "parameters" in getattr(scene, "origin", ()):
            raise ValueError(
                f"The model must not see true parameters (static={model.static!r}), and {scene.name!r} is a variant,"
                " whose bodies it would link by their true lengths. Bind it to the standard scene."
            )
        self.model, self.scene, self.layout = model, scene, model.layout
        self.timestep, self.plain, self.strict = float(scene.timestep), plain, strict

        ends = torch.as_tensor(scene.senders), torch.as_tensor(scene.receivers)
        self.register_buffer("movable", torch.as_tensor(scene.movable, dtype=torch.bool), persistent=False)
        predicted = torch.as_tensor(scene.predicted).nonzero().flatten()
        self.incidence = Incidence(torch.stack(ends).long(), scene.num_nodes, predicted)
        self.frame = Canonicalizer(scene, model)
        # Of bodies that turn about one place there is nothing to link.
        pinned = bool((scene.movable[:, :3].any(1) & (scene.joint_anchors.root != np.arange(scene.num_nodes))).any())
        # Pins are where lengths say, which are hidden from a model of variants that does not read them.
        hidden = parameters_key is not None and model.parameter_source == "none"
        self.projection = make_projection(scene) if model.project and pinned and not hidden else None
        self.anchor_scale = scene.joint_anchors.anchor_scale
        self.statics = ParameterReader(
            model.values_of(scene),
            model.parameter_source,
            parameters_key,
            linked=self.projection is not None,
            scene=scene,
            reads=model.features,
            brought=static_features,
        )
        self.to(model.residual_normalizer.mean.device)
        check_seen(self, self.values, scene.name, stacklevel=4)

    @property
    def values(self) -> PhysicalParameters:
        """The scene's own numbers, without batch."""
        return self.statics.own

    def own_parameters(self) -> TensorDict:
        """What a sample of the scene itself has at the ``parameters_key``, without batch; zeros of an inferred graph."""
        return self.statics.entries()

    def parameters_of(self, scene: Scene) -> TensorDict:
        """Physical parameters of a variant of this scene, to give samples at the ``parameters_key``.

        Stack those of several variants for a batch.

        Raises:
            ValueError: if it is another scene (other bodies, joints, motors or control step), or as :meth:`bind
                <ForwardModel.bind>` with ``strict``; without, that warns.
        """
        here, there = topology(self.scene), topology(scene)
        differs = [what for what in here if here[what] != there[what]]
        if differs:
            raise ValueError(
                f"Scene {scene.name!r} is no variant of {self.scene.name!r}: {', '.join(differs)} differ."
                " Bind the model to it instead."
            )
        values = self.model.values_of(scene)
        check_seen(self, values, scene.name, stacklevel=3)
        return self.statics.of(scene, values)

    @property
    def network_dtype(self) -> torch.dtype:
        """Dtype that the network computes in."""
        # Not of parameters(): under TorchRL's losses weights may be plain tensors.
        return next(each.weight for each in self.model.core.modules() if isinstance(each, nn.Linear)).dtype

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the predicted next state into ``tensordict`` and return it."""
        state, action = (tensordict[key] for key in self.in_keys[:2])
        tensordict.set(self.out_keys[0], self.step(state, action, self.parameters_in(tensordict)))
        return tensordict

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """The physical parameters that samples bring; None where they are the scene's own.

        Of a model that does not read the true physical parameters nothing of the samples' own scenes gets here.

        Raises:
            KeyError: if the model reads them and they are missing.
            ValueError: if the model does not read them and they are not its scene's.
        """
        return self.statics.find(tensordict)

    def step(self, state: Tensor, action: Tensor, parameters: TensorDictBase | None = None) -> Tensor:
        """Next state.

        Args:
            state: ``[*B, N, 13]``.
            action: ``[*B, A]``.
            parameters: physical parameters of every sample, or without batch; by default the scene's.

        Returns:
            ``[*B, N, 13]``.

        Raises:
            ValueError: if a shape does not fit the scene.
        """
        check_shapes(self.scene, state, action, parameters)
        return self._advance(state, action, self.fold(parameters))[0]

    def rollout(
        self,
        state: Tensor,
        actions: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> Tensor:
        """States from a start state under a sequence of actions.

        Args:
            state: ``[*B, N, 13]`` start states.
            actions: ``[*B, T, A]``; ``actions[..., t, :]`` leads from state ``t`` to ``t + 1``.
            parameters: physical parameters of every rollout, or without batch; by default the scene's.
            hidden_state: what a recurrent model remembers of the states before the start; by default there were none.

        Returns:
            ``[*B, T + 1, N, 13]``; the first is the start state itself.

        Raises:
            ValueError: if a shape does not fit the scene.
        """
        return self.rollout_and_hidden_state(state, actions, parameters, hidden_state)[0]

    def rollout_and_hidden_state(
        self,
        state: Tensor,
        actions: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDictBase | None]:
        """As :meth:`rollout`, with what a recurrent model remembers at its end, to go on from; others remember None."""
        for action in actions.unbind(-2)[:1]:
            check_shapes(self.scene, state, action, parameters)
        states, folded = [state], self.fold(parameters)
        for action in actions.unbind(-2):
            state, hidden_state = self._advance(state, action, folded, hidden_state)
            states.append(state)
        return torch.stack(states, dim=-3), hidden_state

    def _advance(
        self, state: Tensor, action: Tensor, folded: Folded, hidden_state: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDictBase | None]:
        """Next state, and what a recurrent model remembers after it; shapes are not checked."""
        return self.layout.apply(state, self._delta(state, action, folded)), None

    def fold(self, parameters: TensorDictBase | None = None) -> Folded:
        """What predictions of the same bodies share, to pass to :meth:`delta` for many steps.

        Args:
            parameters: physical parameters of every sample, by default the scene's.
        """
        values = self.statics.read(parameters)
        core = None if self.plain else self.model.fold(self.static_graph(values), self.incidence)
        return Folded(core, values)

    def delta(self, state: Tensor, action: Tensor, folded: Folded | None = None) -> Tensor:
        """Predicted change of the state ``[*B, N, 12]``, exactly zero in fixed components."""
        check_shapes(self.scene, state, action)
        return self._delta(state, action, folded or self.fold())

    def delta_and_hidden_state(
        self, state: Tensor, action: Tensor, folded: Folded | None = None, hidden_state: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDictBase | None]:
        """As :meth:`delta`, with what a recurrent model remembers; this one remembers nothing."""
        return self.delta(state, action, folded), None

    def _delta(self, state: Tensor, action: Tensor, folded: Folded) -> Tensor:
        seen = self.frame.see(state, folded.values)
        return self._settled(state, self._residual(seen, action, folded), seen, folded.values)

    def _settled(self, state: Tensor, residual: Tensor, seen: CanonicalState, values: PhysicalParameters) -> Tensor:
        """Change of the state ``[*B, N, 12]`` from what the network predicts, in the world frame."""
        residual = residual.to(state.dtype)
        if seen.turn is not None:
            residual = self.layout.rotate_delta(residual, *seen.turn)
        if self.model.integrate:
            residual = self.layout.integrate(state, residual, self.timestep)
        delta = residual * self.movable
        if self.projection is not None:
            # Where nothing was turned the network's matrices are the world's.
            matrices = seen.matrices if seen.turn is None else self.frame.matrices(state)
            assert matrices is not None
            delta = self.projection(state, matrices, delta, self.model.delta_normalizer.std, values)
        return delta

    def _residual(self, seen: CanonicalState, action: Tensor, folded: Folded) -> Tensor:
        """What the network predicts ``[*B, N, 12]``, in the local frame."""
        dynamic = self._dynamic_graph(seen, action, folded.values)
        if folded.core is not None:
            return self.model(dynamic, folded.core)
        normalized = self.model.core(graph_concat(dynamic, self.static_graph(folded.values))).nodes
        return self.model.residual_normalizer.inverse(normalized)

    def dynamic_graph(self, state: Tensor, action: Tensor, values: PhysicalParameters | None = None) -> Graph:
        """Normalised dynamic graph ``[*B, ...]`` in the network's dtype."""
        check_shapes(self.scene, state, action)
        values = values or self.values
        return self._dynamic_graph(self.frame.see(state, values), action, values)

    def _dynamic_graph(self, seen: CanonicalState, action: Tensor, values: PhysicalParameters) -> Graph:
        dtype, model = self.network_dtype, self.model
        encoded, controls = self.frame.features(seen, action, values)
        globals_ = encoded.new_zeros((*encoded.shape[:-2], 0), dtype=dtype)
        nodes, edges = model.node_normalizer(encoded, dtype), model.edge_normalizer(controls, dtype)
        return Graph(nodes, edges, globals_, self.incidence.edge_index)

    def static_graph(self, values: PhysicalParameters | None = None, dtype: torch.dtype | None = None) -> Graph:
        """Normalised static graph, of the scene by default (no batch), in the network's dtype by default."""
        values, dtype = values or self.values, dtype or self.network_dtype
        if self.model.parameter_source == "inferred":  # comes from a network already
            nodes, edges, globals_ = (part.to(dtype) for part in values[:3])
            if self.model.project:
                usual = self.values
                off = torch.cat(
                    (values.parent_anchor - usual.parent_anchor, values.child_anchor - usual.child_anchor), dim=-1
                )
                off = (off / self.anchor_scale).to(dtype).expand(*nodes.shape[:-1], 6)
                nodes = torch.cat((nodes, off), dim=-1)
        else:
            normalizers = self.model.parameter_normalizers.items()
            nodes, edges, globals_ = (normalizer(getattr(values, part), dtype) for part, normalizer in normalizers)
        return Graph(nodes, edges, globals_, self.incidence.edge_index)

    def update_parameter_normalizers(self, parameters: TensorDictBase | None = None) -> None:
        """Take physical parameters, by default this scene's, into the model's statistics: once, before training.

        Inferred ones have none.

        Raises:
            ValueError: if one is not finite; no statistic is changed.
        """
        if parameters is not None:
            require_finite(parameters, "parameters")
        if self.model.parameter_source == "inferred":
            return  # comes from a network already
        values = self.statics.read(parameters)
        for part, normalizer in self.model.parameter_normalizers.items():
            normalizer.update(getattr(values, part))

    def update_dynamic_normalizers(
        self, state: Tensor, action: Tensor, next_state: Tensor, parameters: TensorDictBase | None = None
    ) -> None:
        """Take transitions into the model's statistics (paper, "One step of the training algorithm").

        Args:
            state: ``[*B, N, 13]``, with the input noise that training adds.
            action: ``[*B, A]``.
            next_state: ``[*B, N, 13]``, clean.
            parameters: physical parameters of every sample, by default the scene's.

        Raises:
            ValueError: if a shape does not fit or a number is not finite; no statistic is changed.
        """
        check_shapes(self.scene, state, action, parameters)
        for what, given in (
            ("state", state),
            ("action", action),
            ("next state", next_state),
            ("parameters", parameters),
        ):
            if given is not None:
                require_finite(given, what)
        values = self.statics.read(parameters)
        encoded, controls = self.frame.features(self.frame.see(state, values), action, values)
        self.model.node_normalizer.update(encoded)
        self.model.edge_normalizer.update(controls)
        self.model.delta_normalizer.update(self.layout.delta(state, next_state), self.movable)
        self.model.residual_normalizer.update(self.residual(state, next_state, values), self.movable)

    def residual(self, state: Tensor, next_state: Tensor, values: PhysicalParameters | None = None) -> Tensor:
        """What the network should have predicted of a transition ``[*B, N, 12]``, in the local frame, in SI units."""
        delta = self.layout.delta(state, next_state)
        residual = self.layout.residual(state, delta, self.timestep) if self.model.integrate else delta
        turn = self.frame.yaw_rotation(state, values or self.values)
        if turn is None:
            return residual
        return self.layout.rotate_delta(residual, quaternion.conjugate(turn.rotation), turn.matrix.mT)

    def extra_repr(self) -> str:
        return f"scene={self.scene.name!r}"
