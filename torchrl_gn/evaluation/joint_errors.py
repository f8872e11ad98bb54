"""Errors of predicted joint coordinates and rates, in metres and radians."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_gn.dynamics.adaptation import AdaptedPredictor
from torchrl_gn.dynamics.ensemble import BoundEnsemble
from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.dynamics.predictor import Predictor, require_bound
from torchrl_gn.evaluation.error_table import aligned
from torchrl_gn.evaluation.rollout import rollout_of
from torchrl_gn.maths import quaternion
from torchrl_gn.scenes import Scene, require_bodies
from torchrl_gn.scenes.checked_trajectories import check_trajectories

_SLIDE, _BALL, _FREE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("SLIDE", "BALL", "FREE"))


class JointErrors(NamedTuple):
    """Mean squared errors of each degree of freedom over all steps and rollouts; infinite where one diverged."""

    names: tuple[str, ...]  # [nv], the joint's name; ``root[2]`` where a joint has several degrees of freedom
    units: tuple[str, ...]  # [nv], "m" or "rad"
    coordinate: Tensor  # [nv], m² or rad²
    rate: Tensor  # [nv], (m/s)² or (rad/s)²

    @property
    def mean_square(self) -> float:
        """Mean over all coordinates and rates, regardless of units, as in MoSim."""
        return torch.cat((self.coordinate, self.rate)).mean().item()

    def to_metrics(self) -> dict[str, float]:
        """Return ``joint_mean_square``, and the root mean square errors of each degree of freedom by name."""
        metrics = {"joint_mean_square": self.mean_square}
        for name, coordinate, rate in zip(self.names, self.coordinate.sqrt(), self.rate.sqrt(), strict=True):
            metrics |= {f"joint_error/{name}": coordinate.item(), f"joint_rate_error/{name}": rate.item()}
        return metrics

    def __str__(self) -> str:
        rows = [("root mean square error", "coordinate", "rate")]
        for name, unit, coordinate, rate in zip(
            self.names, self.units, self.coordinate.sqrt(), self.rate.sqrt(), strict=True
        ):
            rows.append((name, f"{coordinate.item():.3g} {unit}", f"{rate.item():.3g} {unit}/s"))
        return "\n".join([*aligned(rows), f"mean square of all: {self.mean_square:.3g}"])


@torch.no_grad()
def joint_errors(model: Predictor | BoundEnsemble | AdaptedPredictor, trajectories: TensorDictBase) -> JointErrors:
    """Return the errors of MuJoCo's coordinates and velocities over all steps of rollouts from state 0.

    Angles differ by at most half a turn. The errors of a ball joint, and the last three of a free joint, are the
    components of the rotation vector from the true to the predicted orientation.

    Args:
        model: a bound or specialised model, an ensemble, or an adapted model.
        trajectories: ``[M]`` of ``state`` ``[M, T + 1, N, C]``, ``action`` ``[M, T, A]`` and, if the model reads them,
            physical parameters ``[M]`` at its ``parameters_key``.

    Raises:
        KeyError: if parameters that the model reads are missing.
        TypeError: if the model is not bound to a scene.
        UnsupportedSceneError: if coordinates of some joints, which the message names, do not follow from body states.
        ValueError: if the trajectories are of other variants than the model's scene, and it reads no parameters, or
            not finite, of another control step or shape.
    """
    require_bound(model)
    scene = require_bodies(model.scene, "joint_errors")
    coordinates = JointCoordinates(scene).cpu()
    check_trajectories(trajectories, scene, layout=scene.layout)
    predicted = rollout_of(model, trajectories)[:, 1:]
    state = trajectories.get("state")
    finite = predicted.isfinite().all()
    (position, velocity), (true_position, true_velocity) = coordinates(predicted), coordinates(state[:, 1:].cpu())
    names, units, parts = _degrees_of_freedom(scene)
    away = _difference(parts, position, true_position)
    errors = [error.square().flatten(0, -2).mean(0) for error in (away, velocity - true_velocity)]
    return JointErrors(names, units, *(torch.where(finite & error.isfinite(), error, torch.inf) for error in errors))


def _degrees_of_freedom(scene: Scene) -> tuple[tuple[str, ...], tuple[str, ...], list[tuple[int, int]]]:
    """Return names and units ``[nv]`` of degrees of freedom, and each joint's address in ``qpos`` and type."""
    model, names, units, parts = scene.model, [], [], []
    for joint, (kind, address) in enumerate(zip(model.jnt_type.tolist(), model.jnt_qposadr.tolist(), strict=True)):
        count, name = {_BALL: 3, _FREE: 6}.get(kind, 1), scene.joint_names[joint]
        names += [name] if count == 1 else [f"{name}[{index}]" for index in range(count)]
        units += ["m", "m", "m", "rad", "rad", "rad"] if kind == _FREE else count * ["m" if kind == _SLIDE else "rad"]
        parts.append((address, kind))
    return tuple(names), tuple(units), parts


def _difference(parts: list[tuple[int, int]], position: Tensor, truth: Tensor) -> Tensor:
    """Return the difference ``[*B, nv]`` from coordinates ``truth`` to ``position``, both ``[*B, nq]``."""
    differences = []
    for address, kind in parts:
        turned = address + 3 * (kind == _FREE)
        if kind == _FREE:
            differences.append(position[..., address:turned] - truth[..., address:turned])
        if kind in (_FREE, _BALL):
            to, start = (each[..., turned : turned + 4] for each in (position, truth))
            differences.append(quaternion.log(quaternion.product(quaternion.conjugate(start), to)))
            continue
        away = position[..., address : address + 1] - truth[..., address : address + 1]
        differences.append(away if kind == _SLIDE else torch.remainder(away + math.pi, 2 * math.pi) - math.pi)
    return torch.cat(differences, dim=-1)
