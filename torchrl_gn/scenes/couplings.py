"""Equality constraints that couple joints or tendons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.scenes.constraints import active_constraints, joined_frames, joins_bodies
from torchrl_gn.scenes.force_elements import straight_joints
from torchrl_gn.scenes.tendons import length_follows, tendon_joints
from torchrl_gn.scenes.topology import topology

if TYPE_CHECKING:
    from torchrl_gn.scenes.scene import Scene

_EQUALITY = mujoco.mjtEq


@dataclass(frozen=True)
class Coupling:
    """A constraint that sets a joint or tendon to a polynomial of a second one, each relative to its reference."""

    equality: int
    couples_tendons: bool
    first: int  # joint or tendon
    second: int  # -1: the first is held at the polynomial's constant


def couplings(scene: Scene) -> tuple[list[Coupling], list[int]]:
    """Return constraints of joints or tendons whose violation follows from body states, and ids of the others."""
    model, supported, others = scene.model, [], []
    straight = straight_joints(scene)
    for equality in active_constraints(model):
        kind = _EQUALITY(model.eq_type[equality])
        ends = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if kind not in (_EQUALITY.mjEQ_JOINT, _EQUALITY.mjEQ_TENDON):
            continue
        couples_tendons, elements = kind == _EQUALITY.mjEQ_TENDON, [end for end in ends if end >= 0]
        if all(length_follows(scene, end) for end in elements) if couples_tendons else straight[elements].all():
            supported.append(Coupling(equality, couples_tendons, *ends))
        else:
            others.append(equality)
    return supported, others


def coupled_joints(scene: Scene, coupling: Coupling) -> list[int]:
    """Return the joints at which a coupling acts."""
    ends = [end for end in (coupling.first, coupling.second) if end >= 0]
    joints = [tendon_joints(scene, end) if coupling.couples_tendons else [end] for end in ends]
    return sorted({joint for group in joints for joint in group})


def constraint_numbers(scene: Scene) -> list[list[float]]:
    """Return parameters of active constraints that features read but samples lack."""
    model, graph, rows = scene.model, topology(scene.model), []
    for equality in active_constraints(model):
        if joins_bodies(model, equality):
            frames = joined_frames(model, graph, equality)
            rows.append([number for _, position, quat in frames for number in (*position, *quat)])
        else:
            rows.append(model.eq_data[equality, :5].tolist())
    return [np.round(row, 9).tolist() for row in rows]
