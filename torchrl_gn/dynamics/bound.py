"""A forward model bound to one scene, which predicts with the model's current weights."""

from __future__ import annotations

import itertools
import warnings
from typing import TYPE_CHECKING, cast

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import hardshrink, pad

from torchrl_gn.dynamics.activation_laws import ActivationLaws
from torchrl_gn.dynamics.constraints import make_projection, position_weight
from torchrl_gn.dynamics.delayed_controls import DelayedControls
from torchrl_gn.dynamics.executors import CudaExecutor, EagerExecutor, NativeExecutor, eager, native_executor
from torchrl_gn.dynamics.features.controls import ControlInputs
from torchrl_gn.dynamics.features.feature import graph_edges
from torchrl_gn.dynamics.parameters import ParameterReader
from torchrl_gn.dynamics.predictor import Predictor, check_shapes
from torchrl_gn.dynamics.program import InputScaling, OutputScaling, PreparedStep, StepProgram, structure_key
from torchrl_gn.dynamics.unwrapping import Unwrapping
from torchrl_gn.finite import require_finite
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.normalizer import unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.networks.core import Core, FoldedCore, ReducibleCore, UnfoldedCore, dtype_of
from torchrl_gn.networks.graph import Graph
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.networks.linear import needs_plain_operations
from torchrl_gn.scenes.articulation import require_bodies
from torchrl_gn.scenes.physical_parameters import PhysicalParameters, require_variant
from torchrl_gn.scenes.scene import Scene

if TYPE_CHECKING:
    from torchrl_gn.dynamics.model import ForwardModel
    from torchrl_gn.maths.state_layout import StateLayout
    from torchrl_gn.scenes import Articulation, ParameterNames

# Standard deviations below this are rounding noise of the simulator (metres, m/s, quaternion entries ...).
DYNAMIC_FLOOR = 1e-9
# Number of steps times samples from which C++ pays off: folding and packing cost as much as some hundreds of steps;
# tracing, once, costs more.
_PAYS = 512


class UnseenParameterWarning(UserWarning):
    """Warning that a physical parameter or a motion of a scene never varied in the model's training."""


class BoundPredictor(Predictor):
    """Predictor of one scene with a forward model's shared weights; made by :meth:`ForwardModel.bind`.

    The predictor is live: each call (once per rollout) folds the current weights for the scene, so every prediction
    uses the latest weights. Differentiable in states, actions and weights. Long rollouts and large batches run in C++.

    See :meth:`ForwardModel.bind` for the options.

    Raises:
        ValueError: if the scene lacks parameters that the model reads, if its graph or states do not have the size that
            the model reads, or if it is a variant whose parameters must be hidden from the model. With ``strict``, an
            :class:`UnseenParameterWarning` is raised as ValueError.
    """

    model: ForwardModel
    movable: Tensor
    reference_state: Tensor  # [N, C]

    def __init__(
        self,
        model: ForwardModel,
        scene: Articulation,
        *,
        strict: bool = False,
        reference: bool = False,
        state_key: NestedKey = "state",
        action_key: NestedKey = "action",
        parameters_key: NestedKey | None = None,
        parameter_names: ParameterNames | None = None,
    ) -> None:
        keys = {"state_key": state_key, "action_key": action_key, "parameters_key": parameters_key}
        super().__init__(scene, model.layout, recurrent=model.core.recurrent, **keys)
        _check_scene(model, scene, varies=parameters_key is not None)
        self.model, self.strict, self.reference = model, strict, reference
        self._executors: dict[tuple, NativeExecutor | CudaExecutor] = {}  # by structure of the programs they run

        has_bodies = isinstance(scene, Scene)
        self.delays = delays = DelayedControls(scene) if has_bodies and scene.delays.size else None
        switch = None if delays is None else delays.switch
        self.unwrapping = Unwrapping(scene) if has_bodies and scene.unwrapped.size else None
        self.activations = ActivationLaws(scene, switch) if has_bodies and scene.activations.size else None
        self.register_buffer("movable", torch.as_tensor(_learned(scene)), persistent=False)
        self.register_buffer("reference_state", reference_state(scene, model.layout), persistent=False)
        predicted = torch.as_tensor(scene.predicted).nonzero().flatten()
        # Computed once: every prediction reads them.
        self.parents = moving_parents(scene) if model.parent_relative else None
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
        # Anchors reveal lengths, which must stay hidden from a model of variants that reads no parameters.
        hidden = parameters_key is not None and model.parameter_source == "none"
        projects = model.project and constrained and not hidden
        self.projection = make_projection(scene) if has_bodies and projects else None
        self.parameter_reader = ParameterReader(
            model, scene, parameters_key, project=self.projection is not None, brought=parameter_names
        )
        self.to(model.residual_normalizer.mean.device)
        _warn_of_unseen(self, self.scene_parameters, scene.name, stacklevel=4)

    @property
    def scene_parameters(self) -> PhysicalParameters:
        """The scene's physical parameters, without batch."""
        return self.parameter_reader.own

    @property
    def dtype(self) -> torch.dtype:
        return dtype_of(self.model.core)

    @property
    def _edge_index(self) -> Tensor:
        return self.incidence.edge_index

    def own_parameters(self) -> TensorDict:
        return self.parameter_reader.entries()

    def _apply(self, fn, recurse: bool = True):
        reference = self.reference_state
        super()._apply(fn, recurse)
        if self.reference_state.dtype != reference.dtype:  # constants of the scene keep their dtype
            self.reference_state = reference.to(self.reference_state.device)
        return self

    def parameters_of(self, scene: Articulation, *, stacklevel: int = 1) -> TensorDict:
        require_variant(*(require_bodies(each, "parameters_of") for each in (self.scene, scene)))
        values = self.model.parameters_of(scene)
        _warn_of_unseen(self, values, scene.name, stacklevel=2 + stacklevel)
        return self.parameter_reader.of(scene, values)

    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        return self.parameter_reader.find(tensordict)

    def initial_hidden_state(self) -> TensorDict | None:
        if not self.recurrent:
            return None
        return self.model.core.start(static_graph(self, self.scene_parameters)).tensordict()

    def recentered(self, states: Tensor) -> Tensor:
        return self.canonicalizer.recentered(states)

    def training_squares(self) -> dict[str, Tensor]:
        normalizer = self.model.node_normalizer
        second_moment, columns = normalizer.mean.square() + normalizer.std.square(), self.model.state_columns()
        adding = (each.name for each in self.layout.components if each.kind == "add" and each.name in columns)
        return {name: second_moment[columns[name]].sum() for name in adding}

    @without_autocast
    def program(
        self,
        parameters: TensorDictBase | None = None,
        *,
        reference: bool | None = None,
        reduced: bool = False,
        rows: Tensor | None = None,
        core: Core | None = None,
        dtype: torch.dtype | None = None,
    ) -> StepProgram:
        """Build the step with the current weights, differentiable in them.

        Args:
            parameters: physical parameters of each sample; default: the scene's.
            reference: do not fold the core; default: as bound.
            reduced: drop features that never varied in training, and fold scales into the network's layers.
            rows: output components to predict; the others keep their mean. Default: all, so that non-finite weights
                give a non-finite loss.
            core: another core with the same weights.
            dtype: dtype of the network; default: the core's.
        """
        model, values = self.model, self.parameter_reader.read(parameters)
        core = model.core if core is None else core
        static = static_graph(self, values, dtype_of(core))
        unfolded = self.reference if reference is None else reference
        folded = UnfoldedCore(core, static) if unfolded else core.fold(self.incidence, static)
        if reduced and rows is None:
            rows = torch.arange(sum(each.size for each in model.output_normalizers), device=self.movable.device)
        folded, nodes, edges, output = _scaled(self, folded, rows if reduced else None)
        return StepProgram(
            layout=self.layout,
            # Known physics integrate the rates themselves.
            timestep=float(self.scene.timestep) if model.integrate and model.physics is None else None,
            movable=self.movable,
            edge_index=self.incidence.edge_index,
            reference=self.reference_state,
            standard=self.scene_parameters,
            parameters=values,
            canonicalizer=self.canonicalizer,
            controls=self.controls,
            activations=self.activations,
            delays=self.delays,
            unwrapping=self.unwrapping,
            node_features=cast(nn.ModuleList, self.features["nodes"]),
            edge_features=cast(nn.ModuleList, self.features["edges"]),
            projection=self.projection,
            nodes=nodes,
            edges=edges,
            recurrent=core if self.recurrent else None,
            static=static if self.recurrent else None,
            core=folded,
            output=output,
            parents=self.parents,
            position_weight=None if self.projection is None else position_weight(model.delta_normalizer.std),
            dtype=dtype or dtype_of(core),
            physics=model.physics,
        )

    def prepared(self, parameters: TensorDictBase | None = None, *, size: int = 1) -> PreparedStep:
        if not self._may_run_natively(parameters) or size < _PAYS:
            program = self.program(parameters)
            return PreparedStep(EagerExecutor(program), program)
        return self._prepared_natively(parameters, change=False)

    def prepared_for_training(self, parameters: TensorDictBase | None = None) -> PreparedStep:
        """Prepare the step for :meth:`PreparedStep.delta`, differentiable in states, actions and weights."""
        if not self._may_run_natively(parameters):
            program = self.program(parameters)
            return PreparedStep(EagerExecutor(program), program)
        return self._prepared_natively(parameters, change=True)

    def _may_run_natively(self, parameters: TensorDictBase | None) -> bool:
        # Traced code cannot ask which features vary; kernels have no gradient in parameters of physics or samples.
        if (
            needs_plain_operations()
            or self.reference
            or (self.model.physics is not None and self.model.physics.trained)
        ):
            return False
        known = self.movable.is_cpu or self.movable.is_cuda
        return known and (parameters is None or not torch.is_grad_enabled())

    @without_autocast
    def _prepared_natively(self, parameters: TensorDictBase | None, *, change: bool) -> PreparedStep:
        # On a GPU, asking which features vary would synchronise with the device.
        program = self.program(parameters, reduced=not self.movable.is_cuda)
        key = (change, program.movable.device, *structure_key(program))
        if (executor := self._executors.get(key)) is None:
            with torch.inference_mode(False):  # a kept executor must also serve autograd
                known = self.program(parameters, reduced=not self.movable.is_cuda)
                executor = self._executors[key] = native_executor(known, change=change, live=True)
        return PreparedStep(executor, executor.pack(program))


def _learned(scene: Articulation) -> np.ndarray:
    """Return ``[N, 12 + K]`` bool, components that the network predicts: movable ones without a known law."""
    learned = scene.movable.copy()
    if isinstance(scene, Scene):
        first = BODY_STATE.delta_size
        known = scene.activations.mask(len(learned), scene.activations.known)
        learned[:, first : first + known.shape[1]] &= ~known
        learned[:, first + known.shape[1] :] = False  # past controls and unwrapped angles
    return learned


def reference_state(scene: Articulation, layout: StateLayout) -> Tensor:
    """Return a scene's reference pose at rest, ``[N, C]`` float64; for a kinematic tree, all angles are zero."""
    if not isinstance(scene, Scene):
        return torch.eye(layout.size, dtype=torch.float64)[0].repeat(scene.num_nodes, 1)
    return torch.from_numpy(scene.reference_state)


def static_graph(predictor: BoundPredictor, parameters: PhysicalParameters, dtype: torch.dtype | None = None) -> Graph:
    """Build the normalised static graph of physical parameters, in the network's dtype by default."""
    model, dtype = predictor.model, dtype or predictor.dtype
    if model.parameter_source == "inferred":  # output of a network, needs no normalisation
        nodes, edges, globals_ = (part.to(dtype) for part in parameters[:3])
        if model.project:
            scene_parameters = predictor.scene_parameters
            change = (
                parameters.parent_anchor - scene_parameters.parent_anchor,
                parameters.child_anchor - scene_parameters.child_anchor,
            )
            offsets = (torch.cat(change, dim=-1) / predictor.scene.joint_anchors.anchor_scale).to(dtype)
            nodes = torch.cat((nodes, offsets.expand(*nodes.shape[:-1], 6)), dim=-1)
    else:
        normalizers = model.parameter_normalizers.items()
        nodes, edges, globals_ = (normalizer(getattr(parameters, part), dtype) for part, normalizer in normalizers)
        if model.marks_edges:
            edges = pad(edges, (0, 1, 0, predictor.incidence.num_edges - edges.shape[-2]))
            added = torch.arange(edges.shape[-2], device=edges.device) >= predictor.scene.num_edges
            edges = torch.cat((edges[..., :-1], added.to(dtype).unsqueeze(-1).expand_as(edges[..., -1:])), dim=-1)
    return Graph(nodes, edges, globals_, predictor.incidence.edge_index)


@without_autocast
def dynamic_graph(predictor: BoundPredictor, state: Tensor, action: Tensor) -> Graph:
    """Build the normalised dynamic graph ``[*B, ...]`` of states and actions, in the network's dtype."""
    check_shapes(predictor.scene, state, action)
    program = predictor.program(reference=True)
    return eager.dynamic_graph(program, eager.canonical_state(program, state, action), action)


@without_autocast
def residual(program: StepProgram, state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Compute the network's target for transitions: the residual change ``[*B, N, 12]`` in the yaw frame.

    The residual excludes the change that the rates explain, or that known physics predict.
    """
    layout, canonical = program.layout, eager.canonical_state(program, state, action)
    change = layout.delta(state, next_state)
    if program.timestep is not None:
        change = layout.residual(state, change, program.timestep)
    if (rotation := canonical.rotation) is not None:
        change = layout.rotate_delta(change, quaternion.conjugate(rotation.quaternion), rotation.matrix.mT)
    # Differences by rounding alone become exactly 0.
    return change if canonical.change is None else hardshrink(change - canonical.change, DYNAMIC_FLOOR)


def relative_to_parents(program: StepProgram, residual: Tensor) -> Tensor:
    """Subtract the parents' residual changes from residual changes ``[*B, N, 12]``; roots keep theirs."""
    assert program.parents is not None
    rows = list(residual.unbind(-2))
    for node, parent in program.parents:
        rows[node] = residual[..., node, :] - residual[..., parent, :]
    return torch.stack(rows, dim=-2)


def moving_parents(scene: Articulation) -> tuple[tuple[int, int], ...]:
    """List nodes that hinges or balls connect to a moving parent as pairs (node, parent), roots first.

    Trees with a free joint give no pairs: relative changes did not reduce a Go1's errors over 1 and 20 steps, and
    increased them over 100.
    """
    if not isinstance(scene, Scene):
        return ()
    model, anchors = scene.model, scene.joint_anchors
    floats = {scene.pairs[joint].second for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))}
    return tuple(
        (node, above)
        for node, (above, root) in enumerate(zip(anchors.parent.tolist(), anchors.root.tolist(), strict=True))
        if node != above and scene.predicted[above] and root not in floats
    )


def update_parameter_normalizers(predictor: BoundPredictor, parameters: TensorDictBase | None = None) -> None:
    """Add physical parameters, by default the scene's, to the model's statistics; call it once, before training.

    An inferred graph has no statistics. Raises ValueError, and changes nothing, if a parameter is not finite.
    """
    if parameters is not None:
        require_finite(parameters, "parameters")
    if predictor.model.parameter_source == "inferred":
        return
    values = predictor.parameter_reader.read(parameters)
    with unchanged_on_error(predictor.model):
        for part, normalizer in predictor.model.parameter_normalizers.items():
            normalizer.update(getattr(values, part))


@without_autocast
def update_dynamic_normalizers(
    predictor: BoundPredictor,
    state: Tensor,
    action: Tensor,
    next_state: Tensor,
    parameters: TensorDictBase | None = None,
) -> None:
    """Add transitions to the model's statistics (paper, "One step of the training algorithm").

    Args:
        predictor: the bound model.
        state: ``[*B, N, 13]``, with the input noise that training adds.
        action: ``[*B, A]``.
        next_state: ``[*B, N, 13]``, without noise.
        parameters: physical parameters of each sample; default: the scene's.

    Raises:
        ValueError: if a shape does not fit or a number is not finite; the statistics then stay as they are.
    """
    check_shapes(predictor.scene, state, action, parameters)
    entries = {"state": state, "action": action, "next state": next_state, "parameters": parameters}
    for what, value in entries.items():
        if value is not None:
            require_finite(value, what)
    model, movable, program = predictor.model, predictor.movable, predictor.program(parameters, reference=True)
    nodes, edges = eager.features(program, eager.canonical_state(program, state, action), action)
    for part, values in (("nodes", nodes), ("edges", edges)):
        if values.shape[-1] != (size := getattr(model.dynamic_size, part)):
            raise ValueError(f"Features of {part} have {values.shape[-1]} numbers, but their size() says {size}.")
    with unchanged_on_error(model):
        model.node_normalizer.update(nodes)
        model.edge_normalizer.update(edges)
        model.delta_normalizer.update(predictor.layout.delta(state, next_state), movable)
        change = residual(program, state, action, next_state)
        model.residual_normalizer.update(change, movable)
        if model.relative_normalizer is not None:
            model.relative_normalizer.update(relative_to_parents(program, change), movable)


def _scaled(
    predictor: BoundPredictor, core: FoldedCore, rows: Tensor | None
) -> tuple[FoldedCore, InputScaling, InputScaling, OutputScaling]:
    """Return a folded core with the scaling of its nodes, edges and output.

    With ``rows``, the components to predict, a reducible core absorbs the scaling and drops features that never varied.
    """
    model = predictor.model
    node, edge, output = model.node_normalizer, model.edge_normalizer, OutputScaling.of(model.output_normalizers)
    # The update of a hidden state reads all features.
    if rows is None or predictor.recurrent or not isinstance(core, ReducibleCore):
        return core, InputScaling.of(node), InputScaling.of(edge), output
    nodes, edges = InputScaling.folded(node), InputScaling.folded(edge)
    assert nodes.columns is not None and edges.columns is not None and output.std is not None
    core = core.reduced(
        (nodes.columns, node.inverse_std[nodes.columns]),
        (edges.columns, edge.inverse_std[edges.columns]),
        (rows, output.std[rows]),
        output.mean[rows],
    )
    return core, nodes, edges, output.folded(rows)


def _check_scene(model: ForwardModel, scene: Articulation, *, varies: bool) -> None:
    """Raise ValueError if the model cannot read a scene's graph or states, or must not see its parameters.

    ``varies``: each sample may be another variant of the scene.
    """
    counts, size = model.core.counts, (scene.num_nodes, graph_edges(scene, model.features).shape[1])
    if counts is not None and counts != size:
        raise ValueError(
            f"The model reads graphs of {counts[0]} nodes and {counts[1]} edges alone; scene {scene.name!r} has"
            f" {size[0]} and {size[1]}. Train another, or a graph network."
        )
    if model.layout != scene.layout:
        raise ValueError(
            f"A node's state is {model.layout.names} in the model, but in scene {scene.name!r}"
            f" {scene.layout.names}: build the model with ForwardModel.for_scene."
        )
    if varies and model.marks_edges:
        raise ValueError(
            "PairContacts has the geoms of one scene, but each sample may be another variant: pass features= without it"
            " (recipes: model.features.contact_pairs=false)."
        )
    if model.parameter_source != "scene" and "parameters" in getattr(scene, "origin", ()):
        raise ValueError(
            f"The model must not see true parameters (parameters={model.parameter_source!r}), and {scene.name!r} is a"
            " variant, whose joint anchors would show its lengths. Bind the model to the standard scene."
        )


def _warn_of_unseen(predictor: BoundPredictor, values: PhysicalParameters, name: str, *, stacklevel: int) -> None:
    """Warn of a scene's parameters and motions that never varied in training; with ``strict``, raise ValueError."""
    model, unseen = predictor.model, []
    if predictor.movable.is_meta:  # meta tensors hold no numbers to compare with
        return
    for part, normalizer in model.parameter_normalizers.items() if model.parameter_source == "scene" else ():
        mean = normalizer.mean
        features = getattr(values, part).to(mean.device)
        if features.shape[-1] == 0 or not bool((normalizer.count > 0).all()):
            continue
        # 1e-6: the same scene compiled on another machine may differ in the last digits.
        differs = ((features - mean).abs() > 1e-6 * mean.abs().clamp(min=1e-12)).reshape(-1, features.shape[-1]).any(0)
        for index in (normalizer.constant & differs).nonzero().flatten().tolist():
            unseen.append(getattr(model.parameter_names, part)[index])
    residual, messages = model.residual_normalizer, []
    if unseen:
        messages.append(
            f"Scene {name!r} has values that the model never saw, in features that never varied in its"
            f" training: {', '.join(unseen)}. They are ignored and predictions may be wrong."
        )
    if model.physics is None and bool((residual.count > 0).any()):
        fixed = (predictor.movable & residual.constant).any(0).tolist()
        if same := list(itertools.compress(_change_names(model.layout), fixed)):
            messages.append(
                f"Bodies of scene {name!r} can move in ways that were always the same in the model's training and are"
                f" predicted so: {', '.join(same)}."
            )
    if messages and predictor.strict:
        raise ValueError(" ".join(messages))
    if messages:
        warnings.warn(" ".join(messages), UnseenParameterWarning, stacklevel=stacklevel)


def _change_names(layout: StateLayout) -> list[str]:
    """List the names of a state change's channels."""
    axes = {1: ("",), 3: (" x", " y", " z")}
    return [
        f"change of {component.name.replace('_', ' ')}{axis}"
        for component in layout.components
        for axis in axes.get(component.delta_size, [f" {index}" for index in range(component.delta_size)])
    ]
