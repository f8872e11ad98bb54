"""What the channels of a state mean and how each is updated by a predicted change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from torchrl_gn.maths import quaternion

Kind = Literal["add", "rotation", "circle"]
Encoding = Literal["matrix", "quaternion"]

_SIZES: dict[str, tuple[int | None, int | None]] = {"add": (None, None), "rotation": (4, 3), "circle": (2, 1)}


@dataclass(frozen=True)
class Component:
    """One named group of state channels that is updated in one way.

    Attributes:
        name: standard name, for example ``"position"``.
        size: number of channels in the state.
        kind: ``"add"`` channels change by addition; ``"rotation"`` is a unit quaternion
            turned by a rotation vector (3 delta channels, Hamilton product, paper SM
            "Prediction of dynamic state change"); ``"circle"`` is a ``(cos, sin)`` pair
            turned by an angle (1 delta channel).
        rate: name of the component that is this one's time derivative, if the state has it.
    """

    name: str
    size: int
    kind: Kind = "add"
    rate: str | None = None

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


@dataclass(frozen=True)
class StateLayout:
    """The channels of a state, as components one after another.

    Every part that must know what a channel means reads it here: state change,
    noise, loss, normalisers, errors and movable channels.

    Attributes:
        components: the components in the order of the channels.

    Raises:
        ValueError: if two components share a name, or a ``rate`` names none that is added and
            has no rate itself.
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
        # Known before anything is compiled: the compiler cannot trace their first use.
        _ = self.size, self.delta_size, self.slices, self.delta_slices

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components."""
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
    def slices(self) -> dict[str, slice]:
        """Where each component lies in a state."""
        return _slices((c.name, c.size) for c in self.components)

    @cached_property
    def delta_slices(self) -> dict[str, slice]:
        """Where each component lies in a state change."""
        return _slices((c.name, c.delta_size) for c in self.components)

    def delta(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Change that leads from one state to the next.

        Args:
            state: ``[..., size]``.
            next_state: ``[..., size]``.

        Returns:
            ``[..., delta_size]``; rotations as world-frame rotation vectors in radians.
        """
        parts = []
        for component in self.components:
            where = self.slices[component.name]
            old, new = state[..., where], next_state[..., where]
            if component.kind == "add":
                parts.append(new - old)
            elif component.kind == "rotation":
                parts.append(quaternion.log(quaternion.product(new, quaternion.conjugate(old))))
            else:
                cross = old[..., :1] * new[..., 1:] - old[..., 1:] * new[..., :1]
                parts.append(torch.atan2(cross, (old * new).sum(-1, keepdim=True)))
        return torch.cat(parts, dim=-1)

    def apply(self, state: Tensor, delta: Tensor) -> Tensor:
        """State after a change, the inverse of :meth:`delta`; rotations keep unit norm.

        Args:
            state: ``[..., size]``.
            delta: ``[..., delta_size]``.

        Returns:
            ``[..., size]``.
        """
        parts = []
        for component in self.components:
            old = state[..., self.slices[component.name]]
            change = delta[..., self.delta_slices[component.name]]
            if component.kind == "add":
                parts.append(old + change)
            elif component.kind == "rotation":
                parts.append(quaternion.normalize(quaternion.product(quaternion.exp(change), old)))
            else:
                cos, sin = change.cos(), change.sin()
                turned = torch.cat(
                    (old[..., :1] * cos - old[..., 1:] * sin, old[..., :1] * sin + old[..., 1:] * cos), dim=-1
                )
                parts.append(turned / turned.norm(dim=-1, keepdim=True))
        return torch.cat(parts, dim=-1)

    def integrate(self, state: Tensor, delta: Tensor, timestep: float) -> Tensor:
        """Add to a state change what the rates alone would do (trapezoidal rule).

        A component with a ``rate`` moves by ``timestep * (rate + rate') / 2`` and the
        change given here is only what is left over: small and easier to learn.

        Args:
            state: ``[..., size]``.
            delta: ``[..., delta_size]``; for components with a rate, the residual.
            timestep: seconds.

        Returns:
            ``[..., delta_size]`` full change.
        """
        return delta + self._rate_term(state, delta, timestep)

    def residual(self, state: Tensor, delta: Tensor, timestep: float) -> Tensor:
        """Inverse of :meth:`integrate`: what the rates do not explain of a full change."""
        return delta - self._rate_term(state, delta, timestep)

    def _rate_term(self, state: Tensor, delta: Tensor, timestep: float) -> Tensor:
        parts = []
        for component in self.components:
            if component.rate is None:
                parts.append(torch.zeros_like(delta[..., self.delta_slices[component.name]]))
            else:
                rate, change = (
                    state[..., self.slices[component.rate]],
                    delta[..., self.delta_slices[component.rate]],
                )
                parts.append(timestep * (rate + 0.5 * change))
        return torch.cat(parts, dim=-1)

    def rotate(self, state: Tensor, rotation: Tensor, matrix: Tensor | None = None) -> Tensor:
        """State as seen when all of space is turned about the origin.

        Args:
            state: ``[*B, N, size]``.
            rotation: ``[*B, 4]`` unit quaternions, one for all ``N`` items.
            matrix: ``[*B, 3, 3]`` of that rotation, if it is known already.

        Returns:
            ``[*B, N, size]``.

        Raises:
            ValueError: if a component is no vector or rotation in space.
        """
        self._check_spatial()
        matrix = (quaternion.to_matrix(rotation).unflatten(-1, (3, 3)) if matrix is None else matrix).mT
        parts = []
        for component in self.components:
            part = state[..., self.slices[component.name]]
            if component.kind == "rotation":
                parts.append(quaternion.product(rotation.unsqueeze(-2), part))
            else:
                parts.append(part @ matrix)
        return torch.cat(parts, dim=-1)

    def rotate_delta(self, delta: Tensor, rotation: Tensor, matrix: Tensor | None = None) -> Tensor:
        """State change ``[*B, N, delta_size]`` as seen when all of space is turned, see :meth:`rotate`."""
        self._check_spatial()
        matrix = (quaternion.to_matrix(rotation).unflatten(-1, (3, 3)) if matrix is None else matrix).mT
        vectors = delta.reshape(*delta.shape[:-2], delta.shape[-2] * len(self.components), 3)
        return (vectors @ matrix).reshape(delta.shape)

    def _check_spatial(self) -> None:
        for component in self.components:
            if component.kind == "circle" or component.delta_size != 3:
                raise ValueError(
                    f"Component {component.name!r} is no vector or rotation in space and cannot be rotated."
                )

    def encode(self, state: Tensor, encoding: Encoding = "matrix", matrices: Tensor | None = None) -> Tensor:
        """Features of a state that the network sees.

        Args:
            state: ``[..., size]``.
            encoding: a rotation as its ``"quaternion"`` (paper) or as the 9 entries of its
                rotation ``"matrix"``: the same for ``q`` and ``-q``, and linear in how
                body-fixed vectors turn.
            matrices: ``[..., 3, 3]`` of the only rotation that the state has, if they are known already.

        Returns:
            ``[..., encoded_size(encoding)]``.
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
        """Number of features that :meth:`encode` gives."""
        return sum(where.stop - where.start for where in self.encoded_slices(encoding).values())

    def encoded_slices(self, encoding: Encoding = "matrix") -> dict[str, slice]:
        """Where each component lies in the features that :meth:`encode` gives."""
        turned = 9 if encoding == "matrix" else 4
        return _slices((c.name, turned if c.kind == "rotation" else c.size) for c in self.components)


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


def joint_layout(extras: Sequence[str] = ()) -> StateLayout:
    """State of a robot's body by its joint alone (paper, SM "Real JACO").

    Args:
        extras: names of further channels that were logged of every joint.

    Returns:
        Cosine and sine of the joint's angle, its velocity in rad/s, and the extras (``3 + extras`` channels).
    """
    angle, velocity = Component("angle", 2, "circle", rate="velocity"), Component("velocity", 1)
    return StateLayout((angle, velocity, *(Component(name, 1) for name in extras)))
