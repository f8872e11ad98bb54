"""Run a step program with torch operations, on any device and in any dtype."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.dynamics.features.canonical_state import CanonicalState
from torchrl_gn.dynamics.features.feature import StepInputs
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.networks.graph import Graph, graph_concat


class EagerExecutor:
    """Executor that interprets a program operation by operation; differentiable in all of its tensors."""

    fixed_batch = False
    reason: str | None = None

    def __init__(self, program: StepProgram) -> None:
        pass  # runs any structure

    def pack(self, program: StepProgram) -> StepProgram:
        return program

    def step(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        return step(program, state, action, hidden)

    def rollout(
        self, program: StepProgram, state: Tensor, actions: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        return rollout(program, state, actions, hidden)

    def delta(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        """See :func:`delta`."""
        return delta(program, state, action, hidden)


def canonical_state(program: StepProgram, state: Tensor, action: Tensor) -> CanonicalState:
    """Return the canonical state of ``[*B, N, 13]``, with the change that known physics predict, in its frame."""
    canonical = program.canonicalizer(state, program.parameters)
    if program.unwrapping is not None:
        canonical = canonical._replace(unwrapped=program.unwrapping(canonical, program.parameters))
    if program.activations is not None or program.delays is not None:
        canonical = _with_actuators(program, canonical, state, action[..., : program.controls.present])
    if program.physics is None:
        return canonical
    after = program.physics(state, program.controls.commands(action))
    if after.shape != state.shape:
        raise ValueError(f"The physics must give next states {list(state.shape)}, not {list(after.shape)}.")
    change = program.layout.delta(state, after.to(state.dtype))
    if canonical.rotation is not None:
        back = quaternion.conjugate(canonical.rotation.quaternion)
        change = program.layout.rotate_delta(change, back, canonical.rotation.matrix.mT)
    return canonical._replace(change=change)


def _with_actuators(program: StepProgram, canonical: CanonicalState, state: Tensor, action: Tensor) -> CanonicalState:
    """Add activations and delayed controls during the step to a canonical state."""
    clipped = program.controls.clipped
    if program.delays is None:
        first = later = clipped(action)
    else:
        step = program.delays(state, action)
        first, later = clipped(step.first), clipped(step.later)
        canonical = canonical._replace(delays=step._replace(first=first, later=later))
    if program.activations is None:
        return canonical
    return canonical._replace(activations=program.activations(state, first, later))


def features(program: StepProgram, canonical: CanonicalState, action: Tensor) -> tuple[Tensor, Tensor]:
    """Return dynamic node ``[*B, N, F_n]`` and edge ``[*B, E, F_e]`` features, not normalised."""
    controls, action = program.controls, program.controls.clipped(action)
    acting, between = action, None
    if program.delays is not None and canonical.delays is not None:
        first, later, _ = canonical.delays
        acting, between = program.delays.mean(first, later), (controls.at_edges(first), controls.at_edges(later))
    present = action[..., : controls.present]
    inputs = StepInputs(canonical, controls.at_edges(acting), program.parameters, present, between)
    nodes = [feature(inputs) for feature in program.node_features]
    edges = [_of_all_edges(feature(inputs), program.edge_index.shape[1]) for feature in program.edge_features]
    nodes, edges = (torch.cat(parts, dim=-1) if len(parts) > 1 else parts[0] for parts in (nodes, edges))
    return nodes, edges


def _of_all_edges(features: Tensor, count: int) -> Tensor:
    """Pad edge features to ``[*B, count, F]``; edges without features get zeros."""
    missing = count - features.shape[-2]
    return pad(features, (0, 0, 0, missing)) if missing else features


def dynamic_graph(program: StepProgram, canonical: CanonicalState, action: Tensor) -> Graph:
    """Return the normalised dynamic graph ``[*B, ...]`` in the network's dtype."""
    nodes, edges = features(program, canonical, action)
    globals_ = nodes.new_zeros((*nodes.shape[:-2], 0), dtype=program.dtype)
    nodes, edges = program.nodes(nodes, program.dtype), program.edges(edges, program.dtype)
    return Graph(nodes, edges, globals_, program.edge_index)


def delta(
    program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
) -> tuple[Tensor, Graph | None]:
    """Return the predicted change ``[*B, N, 12]``, zero in fixed components, and the next hidden state.

    ``hidden`` defaults to the initial hidden state.
    """
    canonical = canonical_state(program, state, action)
    graph = dynamic_graph(program, canonical, action)
    if program.recurrent is not None:
        assert program.static is not None
        before = program.recurrent.start(graph) if hidden is None else hidden
        hidden = program.recurrent.update(graph, program.static, before)
        graph = graph_concat(graph, hidden)
    return change(program, state, canonical, program.core.predict(graph)), hidden


def summed(program: StepProgram, residual: Tensor) -> Tensor:
    """Sum relative residuals along the kinematic tree: from ``[*B, N, 24]`` to residuals ``[*B, N, 12]``.

    Without relative residuals ``residual`` is returned unchanged.
    """
    if program.parents is None:
        return residual
    residual, relative = residual.chunk(2, dim=-1)
    rows = list(relative.unbind(-2))
    for node, parent in program.parents:
        rows[node] = rows[node] + rows[parent]
    return residual + torch.stack(rows, dim=-2)


def change(program: StepProgram, state: Tensor, canonical: CanonicalState, predicted: Tensor) -> Tensor:
    """Return the change ``[*B, N, 12 + K]`` of a state from the network's output ``[*B, N, F_out]``."""
    residual = summed(program, program.output(predicted, state.dtype))
    if canonical.change is not None:
        residual = canonical.change + residual
    if canonical.rotation is not None:
        residual = program.layout.rotate_delta(residual, *canonical.rotation)
    if program.timestep is not None:
        residual = program.layout.integrate(state, residual, program.timestep)
    change = predicted = residual * program.movable
    if program.projection is not None:
        # Without a rotation the canonical state's matrices are the world's.
        matrices = canonical.matrices if canonical.rotation is None else program.canonicalizer.matrices(state)
        assert matrices is not None
        assert program.position_weight is not None
        change = program.projection(state, matrices, change, program.position_weight, program.parameters)
    known = [step.change for step in (canonical.activations, canonical.delays) if step is not None]
    known += [] if canonical.unwrapped is None else [canonical.unwrapped]
    if not known:
        return change
    carried = predicted[..., BODY_STATE.delta_size :] + torch.cat(known, dim=-1)
    return torch.cat((change[..., : BODY_STATE.delta_size], carried), dim=-1)


def step(
    program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
) -> tuple[Tensor, Graph | None]:
    """Return the next state ``[*B, N, 13]`` and hidden state."""
    change, hidden = delta(program, state, action, hidden)
    return program.layout.apply(state, change), hidden


def rollout(
    program: StepProgram, state: Tensor, actions: Tensor, hidden: Graph | None = None
) -> tuple[Tensor, Graph | None]:
    """Return states ``[*B, T + 1, N, 13]`` under actions ``[*B, T, A]``, and the last hidden state."""
    states = [state]
    for action in actions.unbind(-2):
        state, hidden = step(program, state, action, hidden)
        states.append(state)
    return torch.stack(states, dim=-3), hidden
