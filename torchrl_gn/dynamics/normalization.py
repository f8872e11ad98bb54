"""Normalised graphs of a predictor's scene, and the statistics that normalise them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import hardshrink, pad

from torchrl_gn.dynamics.checks import check_shapes
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.program import InputScaling, OutputScaling, StepProgram
from torchrl_gn.finite import require_finite
from torchrl_gn.maths import quaternion
from torchrl_gn.networks.core import FoldedCore, ReducibleCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

if TYPE_CHECKING:
    from torchrl_gn.dynamics.predictor import Predictor

# Standard deviations below this are rounding noise of the simulator (metres, m/s, quaternion entries ...).
DYNAMIC_FLOOR = 1e-9


def static_graph(predictor: Predictor, parameters: PhysicalParameters, dtype: torch.dtype | None = None) -> Graph:
    """Normalised static graph of physical parameters, in the network's dtype by default."""
    model, dtype = predictor.model, dtype or predictor.dtype
    if model.parameter_source == "inferred":  # comes from a network already
        nodes, edges, globals_ = (part.to(dtype) for part in parameters[:3])
        if model.project:
            own = predictor.scene_parameters
            change = (parameters.parent_anchor - own.parent_anchor, parameters.child_anchor - own.child_anchor)
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


def dynamic_graph(predictor: Predictor, state: Tensor, action: Tensor) -> Graph:
    """Normalised dynamic graph ``[*B, ...]`` of states and actions, in the network's dtype."""
    check_shapes(predictor.scene, state, action)
    program = predictor.program(reference=True)
    return eager.dynamic_graph(program, eager.canonical_state(program, state, action), action)


def residual(program: StepProgram, state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    """Target of the network for transitions: change ``[*B, N, 12]`` in the yaw frame, less what is known of it.

    That is what the rates explain, or what physics predict.
    """
    layout, canonical = program.layout, eager.canonical_state(program, state, action)
    change = layout.delta(state, next_state)
    if program.timestep is not None:
        change = layout.residual(state, change, program.timestep)
    if (rotation := canonical.rotation) is not None:
        change = layout.rotate_delta(change, quaternion.conjugate(rotation.quaternion), rotation.matrix.mT)
    # What differs by rounding alone is to be corrected by exactly nothing.
    return change if canonical.change is None else hardshrink(change - canonical.change, DYNAMIC_FLOOR)


def in_range(predictor: Predictor, states: Tensor, limit: float) -> Tensor:
    """Which states ``[*B, N, 13]`` are finite and in the range of the model's training, ``[*B]``.

    In range: every body's distance from its scene's centre, and its speeds, are below ``limit`` times the root mean
    square of training.
    """
    normalizer, layout = predictor.model.node_normalizer, predictor.layout
    good = states.isfinite().flatten(-2).all(-1)
    states = predictor.canonicalizer.recentered(states)
    second_moment = normalizer.mean.square() + normalizer.std.square()
    columns = predictor.model.state_columns()
    for component in layout.components:
        if component.kind == "add" and component.name in columns:
            square = second_moment[columns[component.name]].sum()
            # Without statistics, as before training, there is nothing to compare with.
            largest = torch.where(square > 0, limit**2 * square, torch.inf)
            good &= (states[..., layout.slices[component.name]].square().sum(-1) <= largest).all(-1)
    return good


def update_parameter_normalizers(predictor: Predictor, parameters: TensorDictBase | None = None) -> None:
    """Take physical parameters, by default the scene's, into the model's statistics: once, before training.

    An inferred graph has no statistics. ValueError, and no change, if one is not finite.
    """
    if parameters is not None:
        require_finite(parameters, "parameters")
    if predictor.model.parameter_source == "inferred":
        return
    values = predictor.parameter_reader.read(parameters)
    for part, normalizer in predictor.model.parameter_normalizers.items():
        normalizer.update(getattr(values, part))


def update_dynamic_normalizers(
    predictor: Predictor, state: Tensor, action: Tensor, next_state: Tensor, parameters: TensorDictBase | None = None
) -> None:
    """Take transitions into the model's statistics (paper, "One step of the training algorithm").

    ``state`` ``[*B, N, 13]`` has the input noise that training adds, ``next_state`` none; ``parameters`` are by default
    the scene's. ValueError, and no change, if a shape does not fit or a number is not finite.
    """
    check_shapes(predictor.scene, state, action, parameters)
    given = {"state": state, "action": action, "next state": next_state, "parameters": parameters}
    for what, value in given.items():
        if value is not None:
            require_finite(value, what)
    model, movable, program = predictor.model, predictor.movable, predictor.program(parameters, reference=True)
    nodes, edges = eager.features(program, eager.canonical_state(program, state, action), action)
    for part, given in (("nodes", nodes), ("edges", edges)):
        if given.shape[-1] != (size := getattr(model.dynamic_size, part)):
            raise ValueError(f"Features of {part} give {given.shape[-1]} numbers, but their size() says {size}.")
    model.node_normalizer.update(nodes)
    model.edge_normalizer.update(edges)
    model.delta_normalizer.update(predictor.layout.delta(state, next_state), movable)
    model.residual_normalizer.update(residual(program, state, action, next_state), movable)


def scaled(
    predictor: Predictor, core: FoldedCore, rows: Tensor | None
) -> tuple[FoldedCore, InputScaling, InputScaling, OutputScaling]:
    """A folded core with the scaling of its nodes, edges and output.

    With ``rows``, the components to predict, the core takes the scaling in and drops features that never vary, if
    it can.
    """
    model = predictor.model
    node, edge, residual = model.node_normalizer, model.edge_normalizer, model.residual_normalizer
    # A hidden state is updated from all features.
    if rows is None or predictor.recurrent or not isinstance(core, ReducibleCore):
        return core, InputScaling.of(node), InputScaling.of(edge), OutputScaling.of(residual)
    nodes, edges = InputScaling.folded(node), InputScaling.folded(edge)
    assert nodes.columns is not None and edges.columns is not None
    core = core.reduced(
        (nodes.columns, node.inverse_std[nodes.columns]),
        (edges.columns, edge.inverse_std[edges.columns]),
        (rows, residual.std[rows]),
        residual.mean[rows],
    )
    return core, nodes, edges, OutputScaling.folded(residual, rows)
