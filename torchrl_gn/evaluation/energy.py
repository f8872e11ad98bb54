"""Kinetic energy of a scene from the states of its bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchrl_gn.maths import quaternion

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene


def kinetic_energy(state: Tensor, scene: Scene) -> Tensor:
    """Kinetic energy ``[...]``, joules, of all moving bodies, without joint armature.

    Args:
        state: ``[..., N, 13]``.
    """
    columns = {
        name: torch.as_tensor(column)
        for name, column in zip(scene.static.node_names, scene.static.nodes.T, strict=True)
    }

    def feature(name: str, size: int) -> Tensor:
        return torch.stack([columns[f"{name}[{index}]"] for index in range(size)], -1).to(state)

    mass, moves = columns["mass"].to(state), torch.as_tensor(scene.predicted).to(state)
    orientation, linear, angular = state[..., 3:7], state[..., 7:10], state[..., 10:13]
    offset = quaternion.rotate(orientation, feature("ipos", 3))
    velocity = linear + torch.linalg.cross(angular, offset)
    principal = quaternion.product(orientation, feature("iquat", 4))
    spin = quaternion.rotate(quaternion.conjugate(principal), angular)
    energy = mass * velocity.square().sum(-1) + (feature("inertia", 3) * spin.square()).sum(-1)
    return 0.5 * (energy * moves).sum(-1)
