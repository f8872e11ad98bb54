"""Known physics that a forward model corrects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor, nn

from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.state_layout import StateLayout


class Physics(Float64Buffers):
    """Next state of one robot as its known physics predict it (base class).

    ``physics(state [*B, N, C], action [*B, A])`` gives the next state ``[*B, N, C]``, differentiable in both. The
    action is that of the present, also where the model reads past commands. A forward model built with ``physics=``
    predicts what is left, in each component's own way of changing::

        next state = state + (physics(state, action) - state) + network

    It calls the physics at every step of rollouts and windows, and gradients flow through it. The network reads the
    change that the physics predicts (:class:`~torchrl_gn.dynamics.features.PhysicsChange`). Parameters of the physics
    that require gradients are trained with the network, and checkpoints hold them; their dtype stays as it is.

    Subclass it, or give any function or module of the same two arguments.
    """

    outside = False  # whether it runs outside torch, so that nothing can trace it

    @property
    def trained(self) -> bool:
        """Whether parameters are trained with the network."""
        return any(parameter.requires_grad for parameter in self.parameters())

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        raise NotImplementedError

    def description(self) -> dict:
        """JSON-able values that say which physics it is."""
        return {"function": f"{type(self).__module__}:{type(self).__qualname__}"}


class FunctionPhysics(Physics):
    """Physics of a function or module of state and action."""

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
    """Bodies or joints go on at their velocities: a baseline.

    Args:
        layout: of the states.
        timestep: control step, seconds.
    """

    def __init__(self, layout: StateLayout, timestep: float) -> None:
        super().__init__()
        self.layout, self.timestep = layout, timestep

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        unchanged = state.new_zeros((*state.shape[:-1], self.layout.delta_size))
        return self.layout.apply(state, self.layout.integrate(state, unchanged, self.timestep))


def as_physics(physics: Callable[[Tensor, Tensor], Tensor]) -> Physics:
    """The physics itself, or those of a function; TypeError if it cannot be called."""
    if isinstance(physics, Physics):
        return physics
    if not callable(physics):
        raise TypeError(f"physics={physics!r} must be a function of state and action, such as MujocoPhysics.")
    return FunctionPhysics(physics)


def physics_from_description(
    description: Mapping[str, Any] | None, given: Callable[[Tensor, Tensor], Tensor] | None = None
) -> Physics | None:
    """Physics of a :meth:`Physics.description`: ``given`` if it fits, or rebuilt from MJCF.

    ValueError if a function is not given, or another than the one described.
    """
    from torchrl_gn.dynamics.mujoco_physics import MujocoPhysics

    if description is None:
        if given is not None:
            raise ValueError("The model was trained without physics; leave out physics=.")
        return None
    if given is None:
        if "function" not in description:
            return MujocoPhysics.from_description(description)
        raise ValueError(
            f"The model corrects the physics {description['function']!r}, a function that a checkpoint does not hold:"
            " give it again, as load_pretrained(path, physics=...)."
        )
    physics = as_physics(given)
    found, wanted = _identity(physics.description()), _identity(description)
    if found != wanted:
        raise ValueError(f"The model corrects the physics {wanted}, not {found}: give the ones it was trained with.")
    return physics


def _identity(description: Mapping[str, Any]) -> str:
    """What tells physics apart: a function's name, wherever it lies, or the scene's fingerprint and scales."""
    if "function" in description:
        return description["function"].split(":")[-1]
    scene, scale = description["scene"], description["scale"]
    changed = "".join(f", {name} times {factor:g}" for name, factor in scale.items())
    return f"MuJoCo's of {scene['name']} ({scene['fingerprint']}{changed})"
