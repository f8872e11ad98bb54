"""Step programs, which hold one scene's prediction step as data, and the interface of executors."""

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
    """Scaling of node or edge features for the network: select columns, subtract the mean, multiply by the scale."""

    columns: Tensor | None  # [F'] columns that are read; None: all
    mean: Tensor  # [F'] float64
    scale: Tensor | None  # [F'] float64; None: folded into the core

    @classmethod
    def of(cls, normalizer: Normalizer) -> InputScaling:
        """Scale all columns as a normaliser does."""
        return cls(None, normalizer.mean, normalizer.inverse_std)

    @classmethod
    def folded(cls, normalizer: Normalizer) -> InputScaling:
        """Keep the columns that varied in training; the core absorbs their scale."""
        columns = (~normalizer.constant).nonzero().flatten()
        return cls(columns, normalizer.mean[columns], None)

    def __call__(self, features: Tensor, dtype: torch.dtype) -> Tensor:
        """Return scaled features ``[..., F']`` in the network's dtype."""
        # The mean is subtracted first: large numbers cancel before they are rounded.
        selected = features if self.columns is None else features[..., self.columns]
        centered = selected - self.mean.to(features.dtype)
        return (centered if self.scale is None else centered * self.scale.to(features.dtype)).to(dtype)


class OutputScaling(NamedTuple):
    """Scaling of the network's output to residual changes in SI units: 12 per body, and 12 relative to its parent."""

    # Source of the changes' columns, in order: slices of the output (True), or of the mean for components that never
    # varied (False); None: the output has all components and is to be scaled.
    runs: tuple[tuple[bool, slice], ...] | None
    mean: Tensor  # [12] float64; [24] with relative changes
    std: Tensor | None  # the same shape; None: folded into the core

    @classmethod
    def of(cls, normalizers: Sequence[Normalizer]) -> OutputScaling:
        """Scale all components back as the normalisers do; normalisers after the first use their std alone."""
        means = [normalizers[0].mean, *(torch.zeros_like(each.mean) for each in normalizers[1:])]
        return cls(None, torch.cat(means), torch.cat([each.std for each in normalizers]))

    def folded(self, rows: Tensor) -> OutputScaling:
        """Take components ``rows`` from an output in SI units; the others keep their mean."""
        return OutputScaling(_runs(rows.tolist(), len(self.mean)), self.mean, None)

    def __call__(self, predicted: Tensor, dtype: torch.dtype) -> Tensor:
        """Return residuals ``[*B, N, 12]``, or ``[*B, N, 24]`` with the relative ones last, in ``dtype``."""
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

    Immutable; made by :meth:`Predictor.program`. Executors (:mod:`~torchrl_gn.dynamics.executors`) take its tensors as
    arguments at every call. Constants of the scene are tensors and modules with buffers.
    """

    layout: StateLayout  # channels of the state
    timestep: float | None  # control step, seconds, to integrate the rates; None: rates are not integrated
    movable: Tensor  # [N, 12 + K] components that the network predicts
    edge_index: Tensor  # [2, E]
    reference: Tensor  # [N, C] float64, the scene's reference pose, at rest
    standard: PhysicalParameters  # physical parameters of the scene
    parameters: PhysicalParameters  # the same, or those of each sample
    canonicalizer: BoundCanonicalizer  # map to the canonical state
    controls: ControlInputs  # map from actions to edges
    activations: ActivationLaws | None  # dynamics of activations; None without activations
    delays: DelayedControls | None  # controls of actuators that act late; None without delays
    unwrapping: Unwrapping | None  # angles of joints whose whole turns matter; None without such joints
    node_features: nn.ModuleList  # modules from StepInputs to node features
    edge_features: nn.ModuleList  # modules to edge features
    nodes: InputScaling  # scaling of the node features
    edges: InputScaling  # scaling of the edge features
    recurrent: Core | None  # core that updates the hidden state; None for a feed-forward model
    static: Graph | None  # normalised static graph for that update
    core: FoldedCore  # the folded network
    output: OutputScaling  # scaling of the network's output
    # Pairs (node, parent), roots first, along which relative changes add up; None: the output has no relative changes.
    parents: tuple[tuple[int, int], ...] | None
    projection: MaximalProjection | None  # onto the joint constraints; None: no projection
    position_weight: Tensor | None  # [] float64, the projection's weight of a squared metre against a squared radian
    dtype: torch.dtype  # of the network
    physics: Physics | None = None  # known physics that the network corrects; None without


def numbers_of(program: StepProgram) -> list[Tensor]:
    """List the trained numbers that the state maths reads: means and scales of inputs and output, position weight.

    Everything else that the state maths reads belongs to the scene.
    """
    parts = [*program.nodes[1:], *program.edges[1:], *(program.output[1:] if program.output.runs is None else ())]
    return [part for part in (*parts, program.position_weight) if part is not None]


def with_numbers(program: StepProgram, numbers: Iterable[Tensor]) -> StepProgram:
    """Replace the numbers that :func:`numbers_of` lists, in its order; return the new program."""
    values = iter(numbers)

    def changed(scaling: Any) -> Any:
        return scaling._replace(
            **{name: next(values) for name in scaling._fields[1:] if getattr(scaling, name) is not None}
        )

    return replace(
        program,
        nodes=changed(program.nodes),
        edges=changed(program.edges),
        output=changed(program.output) if program.output.runs is None else program.output,
        position_weight=None if program.position_weight is None else next(values),
    )


def structure_key(program: StepProgram) -> tuple:
    """Return a key of a program's structure: one scene's programs with equal keys differ only in numbers."""
    tensors = [program.nodes.columns, program.edges.columns]
    # Components that never varied keep their mean.
    tensors += [program.output.mean[where] for varies, where in program.output.runs or () if not varies]
    if program.physics is not None:
        tensors += [*program.physics.parameters(), *program.physics.buffers()]
    numbers = tuple(None if each is None else each.detach().cpu().numpy().tobytes() for each in tensors)
    brings = any(value is not standard for value, standard in zip(program.parameters, program.standard, strict=True))
    masks = tuple(each.cpu().numpy().tobytes() for each in parameter_inputs(program)) if brings else ()
    pairs = zip(program.parameters, program.standard, strict=True)
    many = any(value.shape[: value.ndim - standard.ndim].numel() > 1 for value, standard in pairs)
    return repr(program.output.runs), program.dtype, numbers, masks, many


def parameter_inputs(program: StepProgram) -> list[Tensor]:
    """Return a bool mask for each physical parameter: True where samples may have numbers other than the scene's.

    A parameter with values per sample has True everywhere, except at zeros and plus or minus ones that all samples
    share with the scene, such as a planar scene's axes. Such constants shorten the state maths, and all variants get
    the same state maths.
    """
    masks = []
    for value, standard in zip(program.parameters, program.standard, strict=True):
        if value is standard:
            masks.append(torch.zeros_like(standard, dtype=torch.bool))
            continue
        differs = value != standard
        batch = value.ndim - standard.ndim
        differs = differs.flatten(0, batch - 1).any(0) if batch else differs
        masks.append(differs | ((standard != 0) & (standard.abs() != 1)))
    return masks


class Executor(Protocol):
    """Runner of all programs of one structure, made from one of them: ``EXECUTORS[name](program)``.

    An executor keeps data that depend on the scene and the network's shape (compiled code, traces), but no number that
    training changes. Those come with the program that :meth:`pack` prepares.
    """

    fixed_batch: bool  # True if another batch size costs a compilation
    reason: str | None  # reason why it falls back to torch operations, for print; None: it does not

    def pack(self, program: StepProgram) -> StepProgram:
        """Convert a program to the form that the other methods take, differentiable in weights that need gradients."""
        ...

    def step(
        self, program: StepProgram, state: Tensor, action: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        """Return the next state ``[*B, N, 13]`` and hidden state, after an action ``[*B, A]``."""
        ...

    def rollout(
        self, program: StepProgram, state: Tensor, actions: Tensor, hidden: Graph | None = None
    ) -> tuple[Tensor, Graph | None]:
        """Return states ``[*B, T + 1, N, 13]`` under actions ``[*B, T, A]``, and the last hidden state."""
        ...


@dataclass(frozen=True)
class PreparedStep:
    """A packed program with its executor, for one or many steps of the same samples."""

    executor: Executor
    program: StepProgram

    @without_autocast
    def step(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """See :meth:`Executor.step`."""
        return self.executor.step(self.program, state, action, hidden)

    @without_autocast
    def rollout(self, state: Tensor, actions: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """See :meth:`Executor.rollout`."""
        return self.executor.rollout(self.program, state, actions, hidden)

    @without_autocast
    def delta(self, state: Tensor, action: Tensor, hidden: Graph | None = None) -> tuple[Tensor, Graph | None]:
        """Return the predicted change ``[*B, N, 12]``, differentiable in the weights too, and the hidden state."""
        return cast(Any, self.executor).delta(self.program, state, action, hidden)


def _runs(rows: list[int], size: int) -> tuple[tuple[bool, slice], ...]:
    """List the sources of a full row of ``size``: slices of the kept ``rows`` (True) or of the constants (False)."""
    runs: list[tuple[bool, slice]] = []
    for column in range(size):
        is_kept = column in rows
        position = rows.index(column) if is_kept else column
        if runs and runs[-1][0] == is_kept and runs[-1][1].stop == position:
            runs[-1] = (is_kept, slice(runs[-1][1].start, position + 1))
        else:
            runs.append((is_kept, slice(position, position + 1)))
    return tuple(runs)
