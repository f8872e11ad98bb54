"""Plants for iLQG: the true physics, or a learned model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, cast

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.data.simulate import Simulator
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.planners.linearize import Linearization, Tangent, linearize
from torchrl_gn.scenes.articulation import Articulation
from torchrl_gn.scenes.scene import Scene, UnsupportedSceneError

_COMPONENTS = ("position", "orientation", "linear_velocity", "angular_velocity")
# States [n, H + 1, S], their bodies [n, H + 1, N, C], and a mask [n, H] of steps that are stable, as are all before.
Paths = tuple[np.ndarray, np.ndarray, np.ndarray]
Policy = Callable[[int, np.ndarray], np.ndarray]  # step and states [n, S] to actions [n, A]


class Plant(Protocol):
    """Dynamics of ``n`` copies of one state ``[S]``, as float64 arrays."""

    @property
    def scene(self) -> Articulation: ...

    def rollout(self, start: np.ndarray, actions: np.ndarray) -> Paths:
        """Simulate action sequences ``[n, H, A]`` from one state; return the paths."""
        ...

    def follow(self, start: np.ndarray, count: int, steps: int, policy: Policy) -> Paths:
        """Simulate ``count`` copies of one state under a policy for ``steps``; return the paths."""
        ...

    def linearize(self, path: np.ndarray, actions: np.ndarray) -> Linearization:
        """Linearise the dynamics along states ``[H + 1, S]`` under ``actions`` ``[H, A]``."""
        ...


class SimulatedPlant:
    """Plant of the true physics, in MuJoCo.

    States are full physics states; changes are those of :class:`~torchrl_gn.planners.linearize.Tangent`.
    """

    def __init__(self, simulator: Simulator, *, central: bool = False) -> None:
        self.simulator, self.central = simulator, central
        self.scene = simulator.scene

    def rollout(self, start: np.ndarray, actions: np.ndarray) -> Paths:
        simulated = self.simulator.rollout(np.tile(start, (len(actions), 1)), actions)
        paths, bodies, whole = (cast(Tensor, simulated[key]).numpy() for key in ("physics", "state", "stable"))
        stable = np.repeat(whole[:, None], actions.shape[1], axis=1)
        if not whole.all():  # step by step, to find where
            some = actions[~whole]
            stable[~whole] = self.follow(start, len(some), actions.shape[1], lambda t, _: some[:, t])[2]
        return paths, bodies, stable

    def follow(self, start: np.ndarray, count: int, steps: int, policy: Policy) -> Paths:
        paths = np.empty((count, steps + 1, len(start)))
        bodies = np.empty((count, steps + 1, self.scene.num_nodes, self.scene.state_size))
        paths[:, 0], actions = start, np.empty(0)
        for t in range(steps):
            actions = policy(t, paths[:, t])
            paths[:, t + 1], bodies[:, t] = self.simulator.step(paths[:, t], actions)
        # One more step observes the last state and shows if it is stable.
        beyond, bodies[:, steps] = self.simulator.step(paths[:, steps], actions)
        stable = _stable_steps(paths)
        stable[:, -1] &= np.isfinite(beyond).all(axis=1)
        return paths, bodies, stable

    def linearize(self, path: np.ndarray, actions: np.ndarray) -> Linearization:
        return linearize(self.simulator, path, actions, central=self.central)


class LearnedPlant:
    """Plant of a learned model.

    States are flattened body states. Changes are those of :class:`~torchrl_gn.planners.linearize.Tangent` if joint
    coordinates follow from the body states, else of all ``N C`` channels. To linearise a step, the plant takes one
    gradient of the model for each component of a change.

    Args:
        predictor: the model.
        device: device of the model.
    """

    def __init__(self, predictor: Predictor, device: torch.device | str | None = "cpu") -> None:
        self.predictor, self.scene, self.device = predictor, predictor.scene, device
        self._shape = self.scene.num_nodes, self.scene.state_size
        self._coordinates: JointCoordinates | None = None
        self._simulator: Simulator | None = None
        if isinstance(self.scene, Scene):
            try:
                self._coordinates, self._simulator = JointCoordinates(self.scene).cpu(), Simulator(self.scene, 1)
            except UnsupportedSceneError:
                pass

    def rollout(self, start: np.ndarray, actions: np.ndarray) -> Paths:
        state, actions_tensor = self._tensors(np.tile(start, (len(actions), 1)), actions)
        with torch.no_grad():
            bodies = self.predictor.rollout(state.unflatten(-1, self._shape), actions_tensor)[0].cpu().numpy()
        paths = bodies.reshape(*bodies.shape[:2], -1)
        return paths, bodies, _stable_steps(paths)

    def follow(self, start: np.ndarray, count: int, steps: int, policy: Policy) -> Paths:
        bodies = np.empty((count, steps + 1, *self._shape))
        bodies[:, 0] = start.reshape(self._shape)
        paths = bodies.reshape(count, steps + 1, -1)
        with torch.no_grad():
            for t in range(steps):
                state, actions = self._tensors(bodies[:, t].copy(), policy(t, paths[:, t]))
                bodies[:, t + 1] = self.predictor.step(state, actions)[0].cpu().numpy()
        return paths, bodies, _stable_steps(paths)

    def linearize(self, path: np.ndarray, actions: np.ndarray) -> Linearization:
        states, steps = path.reshape(-1, *self._shape), len(actions)
        basis = self._basis(states)
        inverse = np.linalg.pinv(basis) if self._coordinates is not None else basis
        size = inverse.shape[1]
        # Row i of a step's Jacobian is the gradient of change i of the next state.
        with torch.inference_mode(False), torch.enable_grad():
            leaves = self._tensors(*(np.repeat(each, size, axis=0) for each in (states[:-1], actions)))
            state, action = (each.requires_grad_() for each in leaves)
            after = self.predictor.step(state, action)[0]
            gradient = self._tensors(inverse[1:].reshape(after.shape))[0].to(after.dtype)
            gradients = torch.autograd.grad(after, (state, action), gradient, materialize_grads=True)
        of_state, of_action = (each.double().cpu().numpy().reshape(steps, size, -1) for each in gradients)

        def deviation(t: int, paths: np.ndarray) -> np.ndarray:
            return (paths - path[t]) @ inverse[t].T

        return Linearization(np.concatenate((of_state @ basis[:-1], of_action), axis=2), basis, deviation)

    def _tensors(self, *arrays: np.ndarray) -> list[Tensor]:
        """Move arrays to the model's device."""
        return [torch.from_numpy(each).to(self.device) for each in arrays]

    def _basis(self, states: np.ndarray) -> np.ndarray:
        """Return Jacobians ``[T, N C, X]`` of body states with respect to the coordinates of changes."""
        count, channels = len(states), self._shape[0] * self._shape[1]
        if self._coordinates is None or self._simulator is None:
            return np.broadcast_to(np.eye(channels), (count, channels, channels))
        scene, epsilon = self._simulator.scene, 1e-6
        model, nv, tangent = scene.model, scene.model.nv, Tangent(scene)
        position, velocity = (each.numpy() for each in self._coordinates(torch.from_numpy(states)))
        physics = np.zeros((count, scene.physics_size))
        physics[:, 1 : 1 + model.nq] = position
        physics[:, 1 + model.nq :][:, :nv] = velocity
        change = np.broadcast_to(epsilon * np.eye(tangent.size)[:nv], (count, nv, tangent.size))
        above, below = (self._simulator.observe(tangent.add(physics[:, None], step)) for step in (change, -change))
        by_position, here = (above - below) / (2 * epsilon), (above + below) / 2
        # Joint rates map to body velocities as changes of joints map to changes of poses.
        place, turn, linear, angular = (BODY_STATE.slices[name] for name in _COMPONENTS)
        by_velocity = torch.zeros_like(by_position)
        by_velocity[..., linear] = by_position[..., place]
        rate = quaternion.product(by_position[..., turn], quaternion.conjugate(here[..., turn]))
        by_velocity[..., angular] = 2 * rate[..., 1:]
        held, late = scene.activations, scene.delays
        node = np.concatenate((held.node, late.node))
        channel = BODY_STATE.size + np.concatenate((held.slot, held.size + late.slot))
        of_actuators = by_position.new_zeros(count, len(node), *self._shape)
        of_actuators[:, range(len(node)), node, channel] = 1.0
        basis = torch.cat((by_position, by_velocity, of_actuators), dim=1).numpy()
        # The model's quaternions may have the opposite sign.
        flips = np.sign((here.numpy()[:, 0, :, turn] * states[..., turn]).sum(-1, keepdims=True))
        basis[..., turn] *= flips[:, None]
        return basis.reshape(count, tangent.size, channels).swapaxes(1, 2)


def _stable_steps(paths: np.ndarray) -> np.ndarray:
    """Return a mask ``[n, H]`` of steps: True if all states ``[n, H + 1, S]`` until the step's end are finite."""
    return np.logical_and.accumulate(np.isfinite(paths).all(axis=2), axis=1)[:, 1:]
