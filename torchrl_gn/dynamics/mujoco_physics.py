"""MuJoCo's simulation as physics that a forward model corrects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import torch
from mujoco.rollout import Rollout
from torch import Tensor

from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.dynamics.physics import Physics, as_physics
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.processor import usable_cores
from torchrl_gn.scenes import (
    KinematicTree,
    Scene,
    UnsupportedSceneError,
    load_scene,
    require_bodies,
    scene_from_description,
)
from torchrl_gn.scenes.messages import quiet_mujoco
from torchrl_gn.scenes.scaled import scaled_scene

_GROUPS = {
    "mass": ("body_mass", "body_inertia"),
    "friction": ("dof_damping", "dof_frictionloss", "geom_friction"),
}
_DIFFERENCE = 1e-6  # step of central differences, in the coordinates' units
_MEMORY = 2**23  # numbers of MuJoCo's output held at a time


class MujocoPhysics(Physics):
    """MuJoCo's prediction of a scene's bodies, or of a robot's joints.

    Simulates batches by ``mujoco.rollout``; a gradient costs two simulations for each coordinate, rate and action.
    States of a ``tree`` are converted to angles and rates of the scene's hinges, body states of a scene to joint
    coordinates (:class:`~torchrl_gn.dynamics.joint_coordinates.JointCoordinates`). Unstable simulations give NaN.

    Args:
        scene: the scene, or its MJCF as a file or text.
        tree: kinematic tree of a robot whose joint states are predicted instead of the scene's body states.
        joints: names of the scene's joints, one for each joint of the tree. Default: the joints of equal names, or all
            in order if names differ but numbers are equal.
        scale: factors on parts of the model: ``mass`` (with inertia), ``friction`` (damping, joint and contact
            friction), or any array of ``mjModel``, for example ``{"dof_armature": 2.0}``.
        num_threads: threads of the simulation; default: the number of cores that this process may use.

    Raises:
        UnsupportedSceneError: if the states do not determine the simulation's state.
        ValueError: if joints, commands, control step or scales do not fit.
    """

    outside = True

    def __init__(
        self,
        scene: Scene | str | Path,
        tree: KinematicTree | None = None,
        *,
        joints: Sequence[str] | None = None,
        scale: Mapping[str, float] | None = None,
        num_threads: int | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(scene, Scene):
            scene = load_scene(scene, timestep=None if tree is None else tree.timestep)
        self.scene, self.tree, self.scale, self.num_threads = scene, tree, dict(scale or {}), num_threads
        self.simulated = _scaled(scene, self.scale)
        self._pool: Rollout | None = None
        self._data: list[mujoco.MjData] = []
        model = scene.model
        state_size = 1 + model.nq + model.nv + model.na + (model.nhistory if scene.delays.size else 0)
        if scene.physics_size != state_size or (tree is not None and (model.na or scene.delays.size)):
            raise UnsupportedSceneError(f"States do not determine the simulation state of scene {scene.name!r}.")
        if tree is None:
            self.joints, self.coordinates = None, JointCoordinates(scene)
            return
        self.joints = _matched(scene, tree, joints)
        if not np.isclose(tree.timestep, scene.timestep, rtol=1e-6):
            raise ValueError(
                f"Scene {scene.name!r} has control steps of {scene.timestep:g} s, robot {tree.name!r} of"
                f" {tree.timestep:g} s: load_scene(..., timestep={tree.timestep:g})."
            )
        order = [scene.joint_names.index(joint) for joint in self.joints]
        motors = [[motor for motor in scene.edge_action[2 * joint].tolist() if motor >= 0] for joint in order]
        present = tree.present.commands
        for name, motor_ids, commands in zip(self.joints, motors, present, strict=True):
            if len(commands) != len(motor_ids):
                raise ValueError(
                    f"Joint {name!r} of scene {scene.name!r} has {len(motor_ids)} motors, but robot {tree.name!r} has"
                    f" {len(commands)} commands there."
                )
        pairs = zip(motors, present, strict=True)
        command_of = {
            motor: command for motor_ids, commands in pairs for motor, command in zip(motor_ids, commands, strict=True)
        }
        self.constants(
            {
                "order": torch.tensor(order),  # the scene's joint for each joint of the tree
                "back": torch.tensor(np.argsort(order)),
                "command": torch.tensor([command_of[motor] for motor in sorted(command_of)], dtype=torch.long),
            }
        )

    order: Tensor
    back: Tensor
    command: Tensor

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        state64 = state.double()
        if self.tree is None:
            position, velocity = self.coordinates(state64)
            act, late = self.scene.activations, self.scene.delays
            held = state64[..., act.node, BODY_STATE.size + act.slot]
            past = state64[..., late.node, BODY_STATE.size + act.size + late.slot]
            after = _Advance.apply(self, position, velocity, held, past, action.double())
            return cast(Tensor, after).unflatten(-1, (-1, self.scene.state_size)).to(state.dtype)
        joints = state64[..., 1:, :]
        position = torch.atan2(joints[..., 1], joints[..., 0])[..., self.back]
        velocity = joints[..., 2][..., self.back]
        none = position[..., :0]
        after = cast(Tensor, _Advance.apply(self, position, velocity, none, none, action.double()[..., self.command]))
        angle, rate = (each[..., self.order] for each in after.chunk(2, dim=-1))
        moved = torch.stack((angle.cos(), angle.sin(), rate), dim=-1)
        moved = torch.cat((moved, joints[..., 3:]), dim=-1)  # further channels stay as they are
        return torch.cat((state64[..., :1, :], moved), dim=-2).to(state.dtype)

    def advance(
        self, position: np.ndarray, velocity: np.ndarray, activation: np.ndarray, past: np.ndarray, action: np.ndarray
    ) -> np.ndarray:
        """Return coordinates and rates ``[n, nq + nv]``, or body states ``[n, N * C]``, a control step later.

        ``activation`` is ``[n, na]``. ``past`` ``[n, K]`` are controls of earlier steps that are still to act.
        """
        model, timestep = self.simulated.model, self.simulated.model.opt.timestep
        # Sensors show the state before a physics step, so one more step shows the state after the last.
        steps = self.scene.substeps + (self.tree is None)
        rest_physics = self.scene.rest_physics
        rest_physics[self.scene.delays.times(model)] += (
            1.0  # MuJoCo's reset to time 0 then reveals an unstable simulation
        )
        start = np.tile(rest_physics, (len(position), 1))
        values = np.concatenate((position, velocity, activation), axis=1)
        start[:, 1 : 1 + values.shape[1]] = values
        self.scene.delays.add(model, self.scene.substeps, start, past)
        finite = np.all(np.isfinite(np.concatenate((start, action), axis=1)), axis=1)
        start, action = np.where(finite[:, None], start, rest_physics), np.where(finite[:, None], action, 0.0)
        rows, parts = max(1, _MEMORY // (steps * (model.nsensordata + start.shape[1] + model.nu))), []
        for first in range(0, len(start), rows):
            part = slice(first, first + rows)
            held = self.scene.mocaps.inputs(model, np.repeat(action[part, None], steps, axis=1))
            held = held if held.shape[-1] else None
            pool = self._simulation()
            with quiet_mujoco():
                spec = self.scene.mocaps.control_spec
                after, sensors = pool.rollout(model, self._data, start[part], held, nstep=steps, control_spec=spec)
            # MuJoCo resets an unstable simulation, including its time.
            finite[part] &= after[:, -1, 0] > 1 + (steps - 0.5) * timestep
            bodies = self.tree is None
            # The control step ends one physics step before the last.
            parts.append(self.scene.states(sensors[:, -1], after[:, -2]) if bodies else after[:, -1, 1:])
        after = np.concatenate(parts) if parts else np.empty((0, self.scene.state_size, self.scene.num_nodes))
        after = after.reshape(len(after), -1)
        return np.where(finite[:, None], after, np.nan)

    def _simulation(self) -> Rollout:
        if self._pool is None:
            threads = self.num_threads or usable_cores()
            self._pool = Rollout(nthread=threads if threads > 1 else 0)
            self._data = [mujoco.MjData(self.simulated.model) for _ in range(threads)]
        return self._pool

    def description(self) -> dict:
        tree = None if self.tree is None else self.tree.description()
        joints = None if self.joints is None else list(self.joints)
        return {"scene": self.scene.description(), "tree": tree, "joints": joints, "scale": self.scale}

    @classmethod
    def from_description(cls, description: Mapping) -> MujocoPhysics:
        """Rebuild from :meth:`description`."""
        tree = description["tree"]
        return cls(
            require_bodies(scene_from_description(description["scene"]), "MujocoPhysics"),
            None if tree is None else KinematicTree.from_description(tree),
            joints=description["joints"],
            scale=description["scale"],
        )

    def __getstate__(self) -> dict:
        return {**super().__getstate__(), "_pool": None, "_data": []}  # copies start their own threads

    def extra_repr(self) -> str:
        return f"scene={self.scene.name!r}, scale={self.scale}"


class _Advance(torch.autograd.Function):
    """Control step with gradients by central differences."""

    @staticmethod
    def forward(ctx, physics: MujocoPhysics, *inputs: Tensor) -> Tensor:
        ctx.save_for_backward(*inputs)
        ctx.physics = physics
        count = inputs[0].shape[:-1].numel()
        arrays = [each.detach().cpu().numpy().reshape(count, each.shape[-1]) for each in inputs]
        after = torch.from_numpy(physics.advance(*arrays)).to(inputs[0].device)
        return after.view(*inputs[0].shape[:-1], after.shape[-1])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        inputs = ctx.saved_tensors
        sizes = [each.shape[-1] for each in inputs]
        flat = torch.cat(inputs, dim=-1).reshape(-1, sum(sizes)).cpu().numpy()
        steps = _DIFFERENCE * np.eye(sum(sizes))[:, None]
        shifted = np.concatenate((flat + steps, flat - steps)).reshape(-1, sum(sizes))  # [2 * K * n, K]
        after = ctx.physics.advance(*np.split(shifted, np.cumsum(sizes)[:-1], axis=1))
        ahead, behind = after.reshape(2, sum(sizes), len(flat), after.shape[-1])
        gradients = np.einsum("knm,nm->nk", ahead - behind, gradient.reshape(len(flat), -1).cpu().numpy())
        parts = torch.from_numpy(gradients / (2 * _DIFFERENCE)).to(gradient.device).split(sizes, dim=-1)
        return None, *(part.view_as(each) for part, each in zip(parts, inputs, strict=True))


def _scaled(scene: Scene, scale: Mapping[str, float]) -> Scene:
    """Return the scene with parts of its model multiplied."""
    if not scale:
        return scene
    factors = []
    for name, factor in scale.items():
        for array in _GROUPS.get(name, (name,)):
            values = getattr(scene.model, array, None)
            if not isinstance(values, np.ndarray) or not np.issubdtype(values.dtype, np.floating):
                raise ValueError(f"scale={name!r} is not known; use one of {list(_GROUPS)} or an array of mjModel.")
            factors.append((array, slice(None), factor))
    return scaled_scene(scene, factors)


def _matched(scene: Scene, tree: KinematicTree, joints: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the scene's joints, one for each joint of the tree."""
    if joints is None:
        same = set(tree.joint_names) == set(scene.joint_names)
        joints = tree.joint_names if same else scene.joint_names
    kinds = {name: int(kind) for name, kind in zip(scene.joint_names, scene.model.jnt_type, strict=True)}
    if sorted(joints) != sorted(scene.joint_names) or len(joints) != tree.num_joints:
        raise ValueError(
            f"Robot {tree.name!r} has joints {list(tree.joint_names)}, scene {scene.name!r} {list(scene.joint_names)}:"
            " pass joints=, the scene's joint for each of the robot's."
        )
    if wrong := [name for name in joints if kinds[name] != mujoco.mjtJoint.mjJNT_HINGE]:
        raise UnsupportedSceneError(
            f"Joints {wrong} of scene {scene.name!r} are not hinges; joint encoders measure angles of hinges alone."
        )
    return tuple(joints)


def physics_from_description(
    description: Mapping[str, Any] | None, given: Callable[[Tensor, Tensor], Tensor] | None = None
) -> Physics | None:
    """Return the physics of a :meth:`Physics.description`: ``given`` if it matches, or physics rebuilt from MJCF.

    Raises ValueError if a described function is not given, or if ``given`` does not match the description.
    """
    if description is None:
        if given is not None:
            raise ValueError("The model was trained without physics; leave out physics=.")
        return None
    if given is None:
        if "function" not in description:
            return MujocoPhysics.from_description(description)
        raise ValueError(
            f"The model corrects the physics {description['function']!r}, a function that a checkpoint does not hold:"
            " pass it again, load_pretrained(path, physics=...)."
        )
    physics = as_physics(given)
    identity, expected = _identity(physics.description()), _identity(description)
    if identity != expected:
        raise ValueError(
            f"The model corrects the physics {expected}, not {identity}: give the ones it was trained with."
        )
    return physics


def _identity(description: Mapping[str, Any]) -> str:
    """Return the identity of physics: a function's name without its module, or the scene's fingerprint and scales."""
    if "function" in description:
        return description["function"].split(":")[-1]
    scene, scale = description["scene"], description["scale"]
    changed = "".join(f", {name} times {factor:g}" for name, factor in scale.items())
    return f"MuJoCo's of {scene['name']} ({scene['fingerprint']}{changed})"
