"""Active equality constraints of a model, and the frames that connects and welds join."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.scenes.topology import Topology, in_node, site_in_node

_EQUALITY, _DISABLE = mujoco.mjtEq, mujoco.mjtDisableBit


def active_constraints(model: mujoco.MjModel) -> list[int]:
    """Return the ids of active equality constraints."""
    if model.opt.disableflags & (_DISABLE.mjDSBL_EQUALITY | _DISABLE.mjDSBL_CONSTRAINT):
        return []
    return np.flatnonzero(model.eq_active0).tolist()


def joins_bodies(model: mujoco.MjModel, equality: int) -> bool:
    """Return True if a constraint is a connect or weld."""
    return model.eq_type[equality] in (int(_EQUALITY.mjEQ_CONNECT), int(_EQUALITY.mjEQ_WELD))


def joined_frames(model: mujoco.MjModel, graph: Topology, equality: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Return both nodes of a connect or weld, each with the joined frame: position and quaternion in the node's frame.

    While the constraint holds, both joined frames have the same position and, in a weld, the same orientation.
    """
    frames, data = [], model.eq_data[equality]
    weld = model.eq_type[equality] == int(_EQUALITY.mjEQ_WELD)
    for end, at in enumerate((int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))):
        if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
            frames.append(site_in_node(model, graph, at))
            continue
        # A weld stores one anchor, in the second body, and the second body's pose in the first body.
        node, position, quat = in_node(model, graph, at, data[3 * (end == (0 if weld else 1)) :][:3])
        if weld and end == 0:
            body_quat, quat = quat, np.empty(4)
            mujoco.mju_mulQuat(quat, body_quat, data[6:10])
        frames.append((node, position, quat))
    return frames
