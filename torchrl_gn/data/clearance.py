"""Bodies that move up and down freely, and their distance to the planes below."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.constraints import active_constraints, joins_bodies
from torchrl_gn.scenes.topology import weld_roots

_FAR = 1e3  # m, search distance for planes


@dataclass(frozen=True)
class Base:
    """A body that moves up and down freely above planes."""

    height: int  # address of the height in qpos
    up: float  # world height per unit of qpos
    geoms: list[tuple[int, np.ndarray]]  # each plane, and the geoms on the body and its descendants that can touch it


def find_bases(model: mujoco.MjModel, touching: np.ndarray) -> list[Base]:
    """Find bodies with a free joint or an unlimited vertical slide on the world, above planes that they can touch.

    It leaves out a body that a connect or weld constraint holds at the world or at a robot with a fixed base, because
    such a body does not move up and down freely.
    """
    kind, found, roots = mujoco.mjtJoint, list[tuple[int, Base]](), weld_roots(model)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    planes = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (data.geom_xmat[:, 8] > 0.5))
    for joint in range(model.njnt):
        body, up = model.jnt_bodyid[joint], 1.0
        if roots[model.body_parentid[body]] != 0:
            continue
        height = int(model.jnt_qposadr[joint])
        if model.jnt_type[joint] == kind.mjJNT_FREE:
            height += 2
        elif model.jnt_type[joint] == kind.mjJNT_SLIDE and not model.jnt_limited[joint]:
            up = float(data.xaxis[joint, 2])
            if abs(up) < 0.99:
                continue
        else:
            continue
        carried = model.body_rootid[model.geom_bodyid] == model.body_rootid[body]
        geoms = [(int(plane), np.flatnonzero(carried & touching[plane])) for plane in planes]
        if any(len(each) for _, each in geoms):
            found.append((int(model.body_rootid[body]), Base(height, up, geoms)))
    held = _held(model, {root for root, _ in found})
    return [base for root, base in found if root not in held]


def _held(model: mujoco.MjModel, free: set[int]) -> set[int]:
    """Return the root bodies of ``free`` trees that connects or welds join to others, perhaps by way of free ones."""
    joined = list[set[int]]()
    for equality in active_constraints(model):
        if joins_bodies(model, equality):
            ends = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
            of_sites = model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE)
            joined.append(set(model.body_rootid[model.site_bodyid[ends] if of_sites else ends].tolist()))
    held, before = set[int](), -1
    while len(held) != before:
        before = len(held)
        held |= {root for pair in joined if pair - free | pair & held for root in pair & free}
    return held


def clearance(model: mujoco.MjModel, data: mujoco.MjData, base: Base) -> float:
    """Return the least vertical distance to planes [m]; infinite if none is within 1 km."""
    least, position = np.inf, data.geom_xpos
    for plane, geoms in base.geoms:
        normal = data.geom_xmat[plane, 2::3]
        bound = (position[geoms] - position[plane]) @ normal - model.geom_rbound[geoms]
        for row in np.argsort(bound):
            if bound[row] / normal[2] >= least:
                break
            distance = mujoco.mj_geomDistance(model, data, plane, geoms[row], _FAR, None)
            if distance < _FAR:
                least = min(least, distance / normal[2])
    return least
