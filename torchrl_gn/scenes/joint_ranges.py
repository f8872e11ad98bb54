"""Ranges of joints in which poses are drawn."""

from __future__ import annotations

import mujoco
import numpy as np

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_WIDEST_HINGE = 16 * np.pi  # rad
_WIDEST_SLIDE = 20.0  # multiples of the model's extent


def bounded_joints(model: mujoco.MjModel) -> np.ndarray:
    """Find joints ``[J]``, bool, with limits that bound them in practice.

    Hinges with a range of over eight turns, and slides with a range of over 20 extents of the model, have none, as in
    files that write "unlimited" as a large number.
    """
    widest = np.full(model.njnt, np.inf)
    widest[model.jnt_type == _HINGE] = _WIDEST_HINGE
    widest[model.jnt_type == _SLIDE] = _WIDEST_SLIDE * model.stat.extent
    return model.jnt_limited.astype(bool) & (np.ptp(model.jnt_range, axis=1) <= widest)


def drawn_ranges(model: mujoco.MjModel, reference: np.ndarray) -> np.ndarray:
    """Return the ranges ``[J, 2]`` in which hinges and slides are drawn: their limits, if these bound them.

    Otherwise a hinge keeps half a turn, and a slide one extent of the model, to either side of the ``reference``
    ``[nq]``, within its limits.
    """
    reach = np.where(model.jnt_type == _HINGE, np.pi, model.stat.extent)
    around = reference[model.jnt_qposadr, None] + reach[:, None] * [-1.0, 1.0]
    limits = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.inf, np.inf])
    return np.where(bounded_joints(model)[:, None], model.jnt_range, np.clip(around, *limits.T[..., None]))
