"""Known physics that a forward model corrects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout


class Physics(Float64Buffers):
    """Known physics of one robot, which predict its next state (base class).

    ``physics(state [*B, N, C], action [*B, A])`` returns the next state ``[*B, N, C]``, differentiable in both. The
    action holds present commands alone, clipped to their limits, even if the model also reads past ones. A forward
    model built with ``physics=`` predicts the rest of the change. Sums and differences follow the state's layout, which
    composes rotations::

        next state = state + (physics(state, action) - state) + network

    The model calls the physics at every step of rollouts and windows, and gradients flow through them. The network
    reads the change that the physics predict (:class:`~torchrl_gn.dynamics.features.PhysicsChange`). Parameters of the
    physics that require gradients are trained with the network and stored in checkpoints; they keep their dtype.

    Subclass this, or give any function or module of the same two arguments.
    """

    outside = False  # True if it runs outside torch and cannot be traced

    @property
    def trained(self) -> bool:
        """True if some parameters are trained with the network."""
        return any(parameter.requires_grad for parameter in self.parameters())

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        raise NotImplementedError

    def description(self) -> dict:
        """Return JSON-serialisable values that identify the physics."""
        return {"function": f"{type(self).__module__}:{type(self).__qualname__}"}


class FunctionPhysics(Physics):
    """Physics given by a function or module of state and action."""

    def __init__(self, function: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.function(state, action)

    def description(self) -> dict:
        named: Any = type(self.function) if isinstance(self.function, nn.Module) else self.function
        named = named if hasattr(named, "__qualname__") else type(named)
        return {"function": f"{named.__module__}:{named.__qualname__}"}


class ConstantVelocity(Physics):
    """Baseline physics: bodies or joints keep their velocities.

    Args:
        layout: layout of the states.
        timestep: control step, seconds.
    """

    def __init__(self, layout: StateLayout, timestep: float) -> None:
        super().__init__()
        self.layout, self.timestep = layout, timestep

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        unchanged = state.new_zeros((*state.shape[:-1], self.layout.delta_size))
        return self.layout.apply(state, self.layout.integrate(state, unchanged, self.timestep))


def as_physics(physics: Callable[[Tensor, Tensor], Tensor]) -> Physics:
    """Return the physics themselves, or wrap a function; TypeError if it cannot be called."""
    if isinstance(physics, Physics):
        return physics
    if not callable(physics):
        raise TypeError(f"physics={physics!r} must be a function of state and action, such as MujocoPhysics.")
    return FunctionPhysics(physics)
