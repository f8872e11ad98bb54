"""The description of one scene's prediction step, and what every executor is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, cast

import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.activation_laws import ActivationLaws
from torchrl_gn.dynamics.constraints import MaximalProjection
from torchrl_gn.dynamics.delayed_controls import DelayedControls
from torchrl_gn.dynamics.features.canonical_state import BoundCanonicalizer
from torchrl_gn.dynamics.features.controls import ControlInputs
from torchrl_gn.dynamics.physics import Physics
from torchrl_gn.dynamics.unwrapping import Unwrapping
from torchrl_gn.maths.normalizer import Normalizer
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.networks.core import Core, FoldedCore
from torchrl_gn.networks.graph import Graph
from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class InputScaling(NamedTuple):
    """How a part of the graph enters the network: columns, less mean, times scale."""

    columns: Tensor | None  # [F'] columns that are read; None: all
    mean: Tensor  # [F'] float64
    scale: Tensor | None  # [F'] float64; None: folded into the core

    @classmethod
    def of(cls, normalizer: Normalizer) -> InputScaling:
        """All columns, scaled as a normaliser scales them."""
        return cls(None, normalizer.mean, normalizer.inverse_std)

    @classmethod
    def folded(cls, normalizer: Normalizer) -> InputScaling:
        """Columns that varied in training; their scale goes into the core."""
        columns = (~normalizer.constant).nonzero().flatten()
        return cls(columns, normalizer.mean[columns], None)

    def __call__(self, features: Tensor, dtype: torch.dtype) -> Tensor:
        """Scaled features ``[..., F']`` in the network's dtype."""
        # The mean is subtracted first: large numbers cancel before they are rounded.
        kept = features if self.columns is None else features[..., self.columns]
        centered = kept - self.mean.to(features.dtype)
        return (centered if self.scale is None else centered * self.scale.to(features.dtype)).to(dtype)


class OutputScaling(NamedTuple):
    """How the network's output becomes residual changes in SI units, 12 of each body and 12 relative to its parent."""

    # Columns of the changes, in order: slices of the output, or of the mean for components that never varied; None:
    # the output has all components, to be scaled.
    runs: tuple[tuple[bool, slice], ...] | None
    mean: Tensor  # [12] float64; [24] with relative changes
    std: Tensor | None  # the same; None: folded into the core

    @classmethod
    def of(cls, normalizers: Sequence[Normalizer]) -> OutputScaling:
        """All components, scaled back as the normalisers scale them; of those behind the first by their std alone."""
        means = [normalizers[0].mean, *(torch.zeros_like(each.mean) for each in normalizers[1:])]
        return cls(None, torch.cat(means), torch.cat([each.std for each in normalizers]))

    def folded(self, rows: Tensor) -> OutputScaling:
        """Components ``rows`` from the output, in SI units; the others keep their mean."""
        return OutputScaling(_runs(rows.tolist(), len(self.mean)), self.mean, None)

    def __call__(self, predicted: Tensor, dtype: torch.dtype) -> Tensor:
        """Residuals ``[*B, N, 12]``, or ``[*B, N, 24]`` with relative ones behind, in ``dtype``."""
        if self.runs is None:
            assert self.std is not None
            if predicted.shape[-1] != len(self.std):
                raise ValueError(f"The core must give {len(self.std)} features per node, not {predicted.shape[-1]}.")
            return (predicted * self.std.to(predicted.dtype) + self.mean.to(predicted.dtype)).to(dtype)
        predicted = predicted.to(dtype)
        constant = self.mean.to(dtype).expand(*predicted.shape[:-1], -1)
        return torch.cat([(predicted if varies else constant)[..., where] for varies, where in self.runs], dim=-1)


@dataclass(frozen=True)
class StepProgram:
    """One scene's prediction step: state maths, folded network, constraint projection.

    Made by :meth:`Predictor.program`: a value, whose tensors executors (:mod:`~torchrl_gn.dynamics.executors`) take as
    arguments at every call. Constants of the scene are tensors and modules with buffers.
    """

    layout: StateLayout  # channels of the state
    timestep: float | None  # control step, seconds, to integrate the rates; None: they are not
    movable: Tensor  # [N, 12 + K] components that the network predicts
    edge_index: Tensor  # [2, E]
    reference: Tensor  # [N, C] float64, the scene's reference pose, at rest
    standard: PhysicalParameters  # physical parameters of the scene
    parameters: PhysicalParameters  # the same, or of each sample
    canonicalizer: BoundCanonicalizer  # to the canonical state and back
    controls: ControlInputs  # actions to edges
    activations: ActivationLaws | None  # of actuators that have some; None without
    delays: DelayedControls | None  # of actuators that act late; None without
    unwrapping: Unwrapping | None  # of joints whose whole turns matter; None without
    node_features: nn.ModuleList  # modules from StepInputs to node features
    edge_features: nn.ModuleList  # modules to edge features
    nodes: InputScaling  # scaling of the node features
    edges: InputScaling  # scaling of the edge features
    recurrent: Core | None  # core whose hidden state is updated; None of a feed-forward model
    static: Graph | None  # normalised static graph, which the hidden state reads
    core: FoldedCore  # the folded network
    output: OutputScaling  # scaling of its output
    # Nodes with their parents, roots first, along which relative changes add up; None: the output has none.
    parents: tuple[tuple[int, int], ...] | None
    projection: MaximalProjection | None  # onto the joint constraints; None without
    position_weight: Tensor | None  # [] float64, of the projection: a squared metre against a squared radian
    dtype: torch.dtype  # of the network
    physics: Physics | None = None  # whose prediction the network corrects; None without


def numbers_of(program: StepProgram) -> list[Tensor]:
    """The model's numbers that the state maths reads: means and scales of network inputs and outputs, and a weight.

    Training changes them; all else that the state maths reads is the scene's.
    """
    parts = [*program.nodes[1:], *program.edges[1:], *(program.output[1:] if program.output.runs is None else ())]
    return [part for part in (*parts, program.position_weight) if part is not None]


def with_numbers(program: StepProgram, numbers: Iterable[Tensor]) -> StepProgram:
    """The program with other :func:`numbers_of`, in their order."""
    given = iter(numbers)

    def changed(scaling: Any) -> Any:
        return scaling._replace(
            **{name: next(given) for name in scaling._fields[1:] if getattr(scaling, name) is not None}
        )

    return replace(
        program,
        nodes=changed(program.nodes),
        edges=changed(program.edges),
        output=changed(program.output) if program.output.runs is None else program.output,
        position_weight=None if program.position_weight is None else next(given),
    )


def structure_key(program: StepProgram) -> tuple:
    """What tells the structures of one scene's programs apart: programs of equal keys differ in numbers alone."""
    tensors = [program.nodes.columns, program.edges.columns]
    # Components that never varied keep their mean.
    tensors += [program.output.mean[where] for varies, where in program.output.runs or () if not varies]
    if program.physics is not None:
        tensors += [*program.physics.parameters(), *program.physics.buffers()]
    numbers = tuple(None if each is None else each.detach().cpu().numpy().tobytes() for each in tensors)
    brings = any(given is not own for given, own in zip(program.parameters, program.standard, strict=True))
    masks = tuple(each.cpu().numpy().tobytes() for each in parameter_inputs(program)) if brings else ()
    pairs = zip(program.parameters, program.standard, strict=True)
    many = any(given.shape[: given.ndim - own.ndim].numel() > 1 for given, own in pairs)
    return repr(program.output.runs), program.dtype, numbers, masks, many


def parameter_inputs(program: StepProgram) -> list[Tensor]:
    """Which numbers of each physical parameter samples may have of their own, bool; the others are the scene's.

    Of a parameter that samples bring these are all but zeros and ones that all of them share, as a planar scene's axes:
    such make short state maths, and the same ones for all variants.
    """
    found = []
    for given, own in zip(program.parameters, program.standard, strict=True):
        if given is own:
            found.append(torch.zeros_like(own, dtype=torch.bool))
            continue
        differs = given != own
        batch = given.ndim - own.ndim
        differs = differs.flatten(0, batch - 1).any(0) if batch else differs
        found.append(differs | ((own != 0) & (own.abs() != 1)))
    return found


class Executor(Protocol):
    """Runs the programs of one structure: made from one of them, ``EXECUTORS[name](program)``.

    It keeps what follows from the scene and the network's shape (compiled code, traces) and no number that training
    changes: those come with the program, as :meth:`pack` prepares it.
    """

    fixed_batch: bool  # whether another batch size costs a compilation
    reason: str | None  # why it runs by torch operations after all, for print

    def pack(self, program: StepProgram) -> StepProgram:
        """The program in the form that the other methods take, differentiable in the weights if these are."""
        ...

    def step(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        """Next state ``[*B, N, 13]`` and hidden state of a state and an action ``[*B, A]``."""
        ...

    def rollout(
        self, program: StepProgram, state: Tensor, actions: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        """States ``[*B, T + 1, N, 13]`` from a start state under actions ``[*B, T, A]``, and the last hidden state."""
        ...


@dataclass(frozen=True)
class PreparedStep:
    """A packed program with what runs it, for one or many steps of the same samples."""

    executor: Executor
    program: StepProgram

    @without_autocast
    def step(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """As :meth:`Executor.step`."""
        return self.executor.step(self.program, state, action, hidden)

    @without_autocast
    def rollout(self, state: Tensor, actions: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """As :meth:`Executor.rollout`."""
        return self.executor.rollout(self.program, state, actions, hidden)

    @without_autocast
    def delta(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """Predicted change ``[*B, N, 12]``, differentiable in the weights too, and hidden state."""
        return cast(Any, self.executor).delta(self.program, state, action, hidden)


def _runs(rows: list[int], size: int) -> tuple[tuple[bool, slice], ...]:
    """Where to take a full row of ``size`` from: adjacent kept ``rows``, or their constants."""
    runs: list[tuple[bool, slice]] = []
    for column in range(size):
        kept = column in rows
        place = rows.index(column) if kept else column
        if runs and runs[-1][0] == kept and runs[-1][1].stop == place:
            runs[-1] = (kept, slice(runs[-1][1].start, place + 1))
        else:
            runs.append((kept, slice(place, place + 1)))
    return tuple(runs)
