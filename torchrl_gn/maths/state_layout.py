"""Layout of state channels, and their update by a predicted change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from torchrl_gn.maths import quaternion

Kind = Literal["add", "rotation", "circle", "scalar"]
Encoding = Literal["matrix", "quaternion"]

_SIZES: dict[str, tuple[int | None, int | None]] = {
    "add": (None, None),
    "scalar": (None, None),
    "rotation": (4, 3),
    "circle": (2, 1),
}


@dataclass(frozen=True)
class Component:
    """A named group of state channels with one update rule, its ``kind``.

    ``"add"`` and ``"scalar"`` channels change by addition; an ``"add"`` component may be a vector that rotates with the
    frame, a ``"scalar"`` one never rotates. ``"rotation"`` is a unit quaternion, rotated by a rotation vector (3 delta
    channels, Hamilton product, paper SM "Prediction of dynamic state change"). ``"circle"`` is a ``(cos, sin)`` pair,
    rotated by an angle (1 delta channel).
    """

    name: str  # standard name, such as "position"
    size: int  # channels in the state
    kind: Kind = "add"
    rate: str | None = None  # name of the component that is this one's time derivative, if the state has it

    def __post_init__(self) -> None:
        if self.kind not in _SIZES:
            raise ValueError(f"Component {self.name!r} has kind {self.kind!r}; use one of {sorted(_SIZES)}.")
        required = _SIZES[self.kind][0]
        if required is not None and self.size != required:
            raise ValueError(
                f"Component {self.name!r} of kind {self.kind!r} needs {required} channels, not {self.size}."
            )

    @property
    def delta_size(self) -> int:
        """Number of channels in the state change."""
        return _SIZES[self.kind][1] or self.size

    @property
    def adds(self) -> bool:
        """True if the component changes by addition."""
        return self.kind in ("add", "scalar")


@dataclass(frozen=True)
class StateLayout:
    """Components in the order of their channels.

    Raises:
        ValueError: if names repeat, or a ``rate`` is not an ``"add"`` component of the same size without a rate itself.
    """

    components: tuple[Component, ...]

    def __post_init__(self) -> None:
        names = self.names
        if len(set(names)) != len(names):
            raise ValueError(f"Component names must differ, got {names}.")
        for component in self.components:
            if component.rate is None:
                continue
            if component.rate not in names:
                raise ValueError(f"Component {component.name!r} has rate {component.rate!r}, not one of {names}.")
            rate = self.components[names.index(component.rate)]
            if rate.kind != "add" or rate.rate is not None:
                raise ValueError(f"Rate {rate.name!r} of {component.name!r} must have kind 'add' and no rate itself.")
            if rate.delta_size != component.delta_size:
                raise ValueError(f"Component {component.name!r} and its rate {component.rate!r} differ in size.")
        # Compute these before anything is compiled: the compiler cannot trace their first use.
        _ = self.size, self.delta_size, self.slices, self.delta_slices, self.spatial

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(component.name for component in self.components)

    @cached_property
    def size(self) -> int:
        """Number of state channels, 13 for a body."""
        return sum(component.size for component in self.components)

    @cached_property
    def delta_size(self) -> int:
        """Number of channels of a state change, 12 for a body."""
        return sum(component.delta_size for component in self.components)

    @cached_property
    def spatial(self) -> StateLayout:
        """The layout without scalar components."""
        components = tuple(component for component in self.components if component.kind != "scalar")
        return self if len(components) == len(self.components) else StateLayout(components)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Slice of each component in a state."""
        return _slices((c.name, c.size) for c in self.components)

    @cached_property
    def delta_slices(self) -> dict[str, slice]:
        """Slice of each component in a state change."""
        return _slices((c.name, c.delta_size) for c in self.components)

    def without_angle(self, state: Tensor) -> Tensor:
        """Return bool ``[...]``, True for states ``[..., size]`` with a zero quaternion (or ``cos = sin = 0``)."""
        angular = [self.slices[component.name] for component in self.components if not component.adds]
        return torch.stack([(state[..., where] == 0).all(-1) for where in angular]).any(0)

    def delta(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Return the change ``[..., delta_size]`` between states ``[..., size]``, with world-frame rotation vectors."""
        parts = []
        for component in self.components:
            where = self.slices[component.name]
            old, new = state[..., where], next_state[..., where]
            if component.adds:
                parts.append(new - old)
            elif component.kind == "rotation":
                parts.append(quaternion.log(quaternion.product(new, quaternion.conjugate(old))))
            else:
                cross = old[..., :1] * new[..., 1:] - old[..., 1:] * new[..., :1]
                parts.append(torch.atan2(cross, (old * new).sum(-1, keepdim=True)))
        return torch.cat(parts, dim=-1)

    def apply(self, state: Tensor, delta: Tensor) -> Tensor:
        """Apply a change ``[..., delta_size]`` to states ``[..., size]``; the inverse of :meth:`delta`.

        Quaternions and ``(cos, sin)`` pairs of the result have unit norm.
        """
        parts = []
        for component in self.components:
            old = state[..., self.slices[component.name]]
            change = delta[..., self.delta_slices[component.name]]
            if component.adds:
                parts.append(old + change)
            elif component.kind == "rotation":
                parts.append(quaternion.normalize(quaternion.product(quaternion.exp(change), old)))
            else:
                cos, sin = change.cos(), change.sin()
                x, y = old[..., :1], old[..., 1:]
                rotated = torch.cat((x * cos - y * sin, x * sin + y * cos), dim=-1)
                parts.append(rotated / rotated.norm(dim=-1, keepdim=True))
        return torch.cat(parts, dim=-1)

    def mean(self, states: Tensor, near: Tensor, known: Tensor) -> Tensor:
        """Return the mean ``[*B, size]`` of the known states.

        The mean of rotations and angles minimises the squared chords (Markley et al. 2007); for small differences it is
        the mean of the rotation vectors.

        Args:
            states: ``[K, *B, size]``, averaged over ``K``.
            near: ``[*B, size]``, any one of the known states.
            known: ``[K, *B, 1]`` bool; other states do not count.
        """
        parts, count = [], known.sum(0)
        for component in self.components:
            where = self.slices[component.name]
            each, first = states[..., where], near[..., where]
            if component.adds:  # small differences of large numbers stay exact
                parts.append(first + torch.where(known, each - first, 0.0).sum(0) / count)
                continue
            if component.kind == "rotation":
                each = torch.where((each * first).sum(-1, keepdim=True) < 0, -each, each)
            total = torch.where(known, each, 0.0).sum(0)
            parts.append(total / total.norm(dim=-1, keepdim=True))
        return torch.cat(parts, dim=-1)

    def integrate(self, state: Tensor, delta: Tensor, timestep: float) -> Tensor:
        """Add the change due to the rates, ``timestep * (rate + rate') / 2``, to a residual ``[..., delta_size]``."""
        return delta + self._rate_term(state, delta, timestep)

    def residual(self, state: Tensor, delta: Tensor, timestep: float) -> Tensor:
        """Subtract the change due to the rates from a full change; the inverse of :meth:`integrate`."""
        return delta - self._rate_term(state, delta, timestep)

    def _rate_term(self, state: Tensor, delta: Tensor, timestep: float) -> Tensor:
        parts = [
            torch.zeros_like(delta[..., self.delta_slices[c.name]])
            if c.rate is None
            else timestep * (state[..., self.slices[c.rate]] + 0.5 * delta[..., self.delta_slices[c.rate]])
            for c in self.components
        ]
        return torch.cat(parts, dim=-1)

    def rotate(self, state: Tensor, rotation: Tensor, matrix: Tensor | None = None) -> Tensor:
        """Rotate states ``[*B, N, size]`` about the origin by unit quaternions ``[*B, 4]``, one for all ``N`` items.

        ``matrix`` ``[*B, 3, 3]`` is the same rotation, if known. ValueError if a component cannot be rotated.
        """
        transposed = self._transposed(rotation, matrix)
        parts = []
        for c in self.components:
            values = state[..., self.slices[c.name]]
            if c.kind == "rotation":
                values = quaternion.product(rotation.unsqueeze(-2), values)
            elif c.kind == "add":
                values = values @ transposed
            parts.append(values)
        return torch.cat(parts, dim=-1)

    def rotate_delta(self, delta: Tensor, rotation: Tensor, matrix: Tensor | None = None) -> Tensor:
        """Rotate state changes ``[*B, N, delta_size]``; see :meth:`rotate`."""
        transposed, size = self._transposed(rotation, matrix), self._turning()
        vectors = delta[..., :size].reshape(*delta.shape[:-2], delta.shape[-2] * (size // 3), 3)
        turned = (vectors @ transposed).reshape(*delta.shape[:-1], size)
        return turned if size == self.delta_size else torch.cat((turned, delta[..., size:]), dim=-1)

    def _turning(self) -> int:
        """Count the leading channels of a change that rotate with the frame; ValueError if some cannot be rotated."""
        for c in self.components:
            if c.kind == "circle" or (c.kind != "scalar" and c.delta_size != 3):
                raise ValueError(f"Component {c.name!r} is not a vector or rotation in space and cannot be rotated.")
        kinds = [c.kind == "scalar" for c in self.components]
        if kinds != sorted(kinds):
            raise ValueError("Scalars must come last in a state that is rotated.")
        return sum(c.delta_size for c in self.components if c.kind != "scalar")

    def _transposed(self, rotation: Tensor, matrix: Tensor | None) -> Tensor:
        self._turning()
        return (quaternion.to_matrix(rotation).unflatten(-1, (3, 3)) if matrix is None else matrix).mT

    def encode(self, state: Tensor, encoding: Encoding = "matrix", matrices: Tensor | None = None) -> Tensor:
        """Encode states ``[..., size]`` as features ``[..., encoded_size(encoding)]`` for a network.

        Args:
            state: ``[..., size]``.
            encoding: encoding of rotations: ``"quaternion"`` (paper, 4 channels), or ``"matrix"`` (9 channels), which
                is the same for ``q`` and ``-q``.
            matrices: ``[..., 3, 3]``, rotation matrices of a state with a single rotation, if they are known already.
        """
        if encoding == "quaternion":
            return state
        parts = [
            (quaternion.to_matrix(state[..., self.slices[c.name]]) if matrices is None else matrices.flatten(-2))
            if c.kind == "rotation"
            else state[..., self.slices[c.name]]
            for c in self.components
        ]
        return torch.cat(parts, dim=-1)

    def encoded_size(self, encoding: Encoding = "matrix") -> int:
        return sum(where.stop - where.start for where in self.encoded_slices(encoding).values())

    def encoded_slices(self, encoding: Encoding = "matrix") -> dict[str, slice]:
        """Return the slice of each component in the features of :meth:`encode`."""
        rotation = 9 if encoding == "matrix" else 4
        return _slices((c.name, rotation if c.kind == "rotation" else c.size) for c in self.components)


def _slices(sizes) -> dict[str, slice]:
    slices, start = {}, 0
    for name, size in sizes:
        slices[name] = slice(start, start + size)
        start += size
    return slices


BODY_STATE = StateLayout(
    (
        Component("position", 3, rate="linear_velocity"),
        Component("orientation", 4, "rotation", rate="angular_velocity"),
        Component("linear_velocity", 3),
        Component("angular_velocity", 3),
    )
)
"""State of a rigid body in the world frame: metres, unit quaternion, m/s, rad/s (13 channels)."""


def body_layout(activations: int = 0, past_controls: int = 0, unwrapped_angles: int = 0) -> StateLayout:
    """Return :data:`BODY_STATE`, followed by that many activations, past controls and unwrapped angles."""
    carried = (("activation", activations), ("past_control", past_controls), ("unwrapped_angle", unwrapped_angles))
    further = [Component(name, count, "scalar") for name, count in carried if count]
    return StateLayout((*BODY_STATE.components, *further)) if further else BODY_STATE


def joint_layout(extras: Sequence[str] = ()) -> StateLayout:
    """Return a joint's layout (paper, SM "Real JACO"): cos and sin of its angle, velocity in rad/s, named extras."""
    angle, velocity = Component("angle", 2, "circle", rate="velocity"), Component("velocity", 1)
    return StateLayout((angle, velocity, *(Component(name, 1) for name in extras)))
