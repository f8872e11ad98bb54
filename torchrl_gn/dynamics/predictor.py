"""A forward model joined to one scene: the TensorDict module that predicts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from torchrl_gn.dynamics.checks import check_scene, check_shapes, warn_of_unseen
from torchrl_gn.dynamics.constraints import make_projection
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.eager import EagerExecutor
from torchrl_gn.dynamics.executors.native import NativeDelta
from torchrl_gn.dynamics.features.controls import ControlInputs
from torchrl_gn.dynamics.features.feature import graph_edges
from torchrl_gn.dynamics.normalization import in_range, scaled, static_graph
from torchrl_gn.dynamics.parameters import ParameterReader
from torchrl_gn.dynamics.program import Executor, StepProgram
from torchrl_gn.finite import is_traced
from torchrl_gn.networks.core import UnfoldedCore, dtype_of
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.scenes.physical_parameters import PhysicalParameters, topology

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel
    from torchrl_gn.scenes import ParameterNames, Scene


class Predictor(TensorDictModuleBase):
    """Predict the next state of one scene with a forward model's shared weights; made by :meth:`ForwardModel.bind`.

    Reads ``state`` ``[*B, N, 13]`` and ``action`` ``[*B, A]``, writes ``("next", "state")`` in the dtype of ``state``;
    the network sees recentred, normalised values in its own dtype. Differentiable in states, actions and weights.

    With a ``parameters_key`` each sample may be another variant of the scene: reads a TensorDict of the entries of
    :class:`~torchrl_gn.scenes.PhysicalParameters` there, from :meth:`parameters_of` or an inference model. Without one,
    samples with other parameters are refused. A model with ``parameters="none"`` or ``"inferred"`` never reads true
    parameters. A recurrent model also reads ``hidden_state``, a TensorDict ``[*B]`` of ``nodes``, ``edges`` and
    ``globals_``, by default the initial one, and writes ``("next", "hidden_state")``.

    Options are those of :meth:`ForwardModel.bind`.

    Raises:
        ValueError: if the scene lacks parameters that the model reads, its graph has another size than the core reads,
            or it is a variant whose parameters must be hidden from the model; or with ``strict``.
    """

    model: ForwardModel
    movable: Tensor

    def __init__(
        self,
        model: ForwardModel,
        scene: Scene,
        *,
        strict: bool = False,
        reference: bool = False,
        state_key: NestedKey = "state",
        action_key: NestedKey = "action",
        parameters_key: NestedKey | None = None,
        parameter_names: ParameterNames | None = None,
    ) -> None:
        super().__init__()
        self.parameters_key = parameters_key
        hidden_keys = ["hidden_state"] if model.core.recurrent else []
        parameters_keys = [] if parameters_key is None else [parameters_key]
        self.in_keys: list[NestedKey] = [state_key, action_key, *parameters_keys, *hidden_keys]
        self.out_keys: list[NestedKey] = [unravel_key(("next", key)) for key in (state_key, *hidden_keys)]
        check_scene(model, scene, varies=parameters_key is not None)
        self.model, self.scene, self.layout = model, scene, model.layout
        self.strict, self.reference = strict, reference
        self.trainer: NativeDelta | None = None  # last training_executor() in C++

        self.register_buffer("movable", torch.as_tensor(scene.movable, dtype=torch.bool), persistent=False)
        predicted = torch.as_tensor(scene.predicted).nonzero().flatten()
        self.incidence = Incidence(graph_edges(scene, model.features), scene.num_nodes, predicted)
        self.canonicalizer = model.canonicalizer.bind(scene, model.layout)
        self.controls = ControlInputs(scene)
        self.features = nn.ModuleDict({"nodes": nn.ModuleList(), "edges": nn.ModuleList()})
        for feature in model.features:
            bound = feature.bind(scene, model.layout, self.canonicalizer)
            self.features[feature.part].append(bound)  # pyright: ignore[reportCallIssue, reportAttributeAccessIssue]
        # Bodies that rotate about one fixed point have nothing to project.
        joined = scene.joint_anchors.root != np.arange(scene.num_nodes)
        constrained = bool((scene.movable[:, :3].any(1) & joined).any())
        # Anchors follow from lengths, which are hidden from a model of variants that does not read them.
        hidden = parameters_key is not None and model.parameter_source == "none"
        self.projection = make_projection(scene) if model.project and constrained and not hidden else None
        self.parameter_reader = ParameterReader(
            model, scene, parameters_key, project=self.projection is not None, brought=parameter_names
        )
        self.to(model.residual_normalizer.mean.device)
        warn_of_unseen(self, self.scene_parameters, scene.name, stacklevel=4)

    @property
    def scene_parameters(self) -> PhysicalParameters:
        """The scene's physical parameters, without batch."""
        return self.parameter_reader.own

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the network."""
        return dtype_of(self.model.core)

    @property
    def recurrent(self) -> bool:
        """Whether a hidden state runs through the steps."""
        return self.model.core.recurrent

    @property
    def fixed_batch(self) -> bool:
        """Whether another batch size costs a compilation."""
        return False

    def own_parameters(self) -> TensorDict:
        """Entry of the scene itself at the ``parameters_key``, without batch; zeros of an inferred graph."""
        return self.parameter_reader.entries()

    def parameters_of(self, scene: Scene) -> TensorDict:
        """Physical parameters of a variant of this scene, for the ``parameters_key``; stack several for a batch.

        ValueError if it is another scene (other bodies, joints, motors or control step); ``strict`` holds here too.
        """
        here, there = topology(self.scene), topology(scene)
        differs = [what for what in here if here[what] != there[what]]
        if differs:
            raise ValueError(
                f"Scene {scene.name!r} is no variant of {self.scene.name!r}: {', '.join(differs)} differ."
                " Bind the model to it instead."
            )
        values = self.model.parameters_of(scene)
        warn_of_unseen(self, values, scene.name, stacklevel=3)
        return self.parameter_reader.of(scene, values)

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Physical parameters that samples bring; None where they are the scene's own or the model reads none.

        Raises:
            KeyError: if the model reads them and they are missing.
            ValueError: if the model does not read them and they are not its scene's.
        """
        return self.parameter_reader.find(tensordict)

    def hidden_state_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Hidden state that samples bring to a recurrent model; None: the initial one."""
        return tensordict.get("hidden_state", None) if self.recurrent else None

    def in_range(self, states: Tensor, limit: float) -> Tensor:
        """Which states ``[*B, N, 13]`` are finite and within ``limit`` times training's range, ``[*B]``."""
        return in_range(self, states, limit)

    def initial_hidden_state(self) -> TensorDict | None:
        """Initial hidden state of a recurrent model, without batch; None of others."""
        if not self.recurrent:
            return None
        return self.model.core.start(static_graph(self, self.scene_parameters)).tensordict()

    @dispatch()
    def forward(self, tensordict: TensorDictBase, *_: Tensor, **__: Tensor) -> TensorDictBase:
        """Write the predicted next state into ``tensordict``, or return it for entries that come one by one."""
        state, action = (tensordict[key] for key in self.in_keys[:2])
        after, hidden = self.step(state, action, self.parameters_in(tensordict), self.hidden_state_in(tensordict))
        tensordict.set(self.out_keys[0], after)
        return tensordict if hidden is None else tensordict.set(self.out_keys[1], hidden)

    def program(
        self, parameters: TensorDictBase | None = None, *, reference: bool = False, reduced: bool = False
    ) -> StepProgram:
        """The step as it is now, differentiable in the weights.

        The ``reference`` does not fold the core; ``reduced`` leaves out features that never vary.
        """
        model, values = self.model, self.parameter_reader.read(parameters)
        static, unfolded = static_graph(self, values), self.reference or reference
        core = UnfoldedCore(model.core, static) if unfolded else model.core.fold(self.incidence, static)
        # All components: a loss of weights that are not finite is not finite.
        rows = torch.arange(model.residual_normalizer.size, device=self.movable.device) if reduced else None
        core, nodes, edges, output = scaled(self, core, rows)
        return StepProgram(
            **self.constants(),
            parameters=values,
            nodes=nodes,
            edges=edges,
            recurrent=model.core if self.recurrent else None,
            static=static if self.recurrent else None,
            core=core,
            output=output,
            change_std=model.delta_normalizer.std,
            dtype=self.dtype,
            physics=model.physics,
        )

    def constants(self) -> dict:
        """Those parts of a program that follow from the scene alone."""
        return {
            "layout": self.layout,
            # Physics know how rates integrate.
            "timestep": float(self.scene.timestep) if self.model.integrate and self.model.physics is None else None,
            "movable": self.movable,
            "edge_index": self.incidence.edge_index,
            "canonicalizer": self.canonicalizer,
            "controls": self.controls,
            "node_features": self.features["nodes"],
            "edge_features": self.features["edges"],
            "projection": self.projection,
        }

    def executor(self, parameters: TensorDictBase | None = None) -> Executor:
        """What runs the step, for one or many steps of the same samples."""
        return EagerExecutor(self.program(parameters))

    def training_executor(self, parameters: TensorDictBase | None = None) -> EagerExecutor | NativeDelta:
        """What predicts changes by its ``delta``, differentiable in states, actions and weights."""
        # What is traced cannot ask which features vary; C++ has no gradient in parameters of physics.
        if is_traced() or (self.model.physics is not None and self.model.physics.trained):
            return EagerExecutor(self.program(parameters))
        program = self.program(parameters, reduced=True)
        if self.trainer is None:
            self.trainer = NativeDelta(program)
        else:
            self.trainer = self.trainer.update(program)
        return self.trainer

    def step(
        self,
        state: Tensor,
        action: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDict | None]:
        """Next state ``[*B, N, 13]``, and the next hidden state, None of a feed-forward model.

        Args:
            state: ``[*B, N, 13]``.
            action: ``[*B, A]``; ValueError if a shape does not fit the scene.
            parameters: physical parameters of each sample, or without batch; default: the scene's.
            hidden_state: ``[*B]`` hidden state of a recurrent model; default: the initial one.
        """
        check_shapes(self.scene, state, action, parameters)
        after, hidden = self.executor(parameters).step(state, action, self._graph(hidden_state))
        return after, None if hidden is None else hidden.tensordict()

    def rollout(
        self,
        state: Tensor,
        actions: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDict | None]:
        """States ``[*B, T + 1, N, 13]`` from a start state under actions ``[*B, T, A]``, and the last hidden state.

        ``actions[..., t, :]`` leads from state ``t`` to ``t + 1``; the first state is the start. See :meth:`step`.
        """
        for action in actions[..., :1, :].unbind(-2):
            check_shapes(self.scene, state, action, parameters)
        states, hidden = self.executor(parameters).rollout(state, actions, self._graph(hidden_state))
        return states, None if hidden is None else hidden.tensordict()

    def teacher_forced(
        self, states: Tensor, actions: Tensor, parameters: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDict | None]:
        """States ``[*B, T, N, 13]`` after each of the true ``states``, and the hidden state that ran through them."""
        if states.shape[-3] == 0:
            raise ValueError("There is no state to predict from.")
        check_shapes(self.scene, states[..., 0, :, :], actions[..., 0, :], parameters)
        if not self.recurrent:
            if parameters is not None and parameters.ndim:
                parameters = parameters.unsqueeze(-1).expand(actions.shape[:-1])
            return self.step(states, actions, parameters)
        hidden, predictions, executor = None, [], self.executor(parameters)
        for state, action in zip(states.unbind(-3), actions.unbind(-2), strict=True):
            predicted, hidden = executor.step(state, action, hidden)
            predictions.append(predicted)
        assert hidden is not None
        return torch.stack(predictions, dim=-3), hidden.tensordict()

    def delta(self, state: Tensor, action: Tensor, parameters: TensorDictBase | None = None) -> Tensor:
        """Predicted change ``[*B, N, 12]``, zero in fixed components; from a recurrent model's initial hidden state."""
        check_shapes(self.scene, state, action, parameters)
        return eager.delta(self.executor(parameters).program, state, action)[0]

    def _graph(self, hidden_state: TensorDictBase | None) -> Graph | None:
        if hidden_state is None:
            return None
        nodes, edges, globals_ = (hidden_state[part] for part in ("nodes", "edges", "globals_"))
        return Graph(nodes, edges, globals_, self.incidence.edge_index)

    def __getstate__(self) -> dict:
        return {**super().__getstate__(), "trainer": None}  # a copy packs for itself

    def extra_repr(self) -> str:
        return f"scene={self.scene.name!r}"
