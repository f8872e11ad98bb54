"""Ranges of joints in which poses are drawn."""

from __future__ import annotations

import mujoco
import numpy as np

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_WIDEST_HINGE = 16 * np.pi  # rad
_WIDEST_SLIDE = 20.0  # multiples of the model's extent


def endless_joints(model: mujoco.MjModel) -> np.ndarray:
    """Find hinges and slides ``[J]``, bool, whose limits bound nothing in practice.

    These are hinges with a range of over eight turns, and slides with a range of over 20 extents of the model, as in
    files that write "unlimited" as a large number.
    """
    widest = np.full(model.njnt, np.inf)
    widest[model.jnt_type == _HINGE] = _WIDEST_HINGE
    widest[model.jnt_type == _SLIDE] = _WIDEST_SLIDE * model.stat.extent
    return model.jnt_limited.astype(bool) & (np.ptp(model.jnt_range, axis=1) > widest)


def drawn_ranges(model: mujoco.MjModel, reference: np.ndarray) -> np.ndarray:
    """Return the limits ``[J, 2]`` of the joints; those of endless ones are narrowed.

    A hinge keeps half a turn and a slide one extent of the model to either side of the ``reference`` ``[nq]``.
    """
    ranges, endless = model.jnt_range.copy(), np.flatnonzero(endless_joints(model))
    reach = np.where(model.jnt_type[endless] == _HINGE, np.pi, model.stat.extent)
    here = reference[model.jnt_qposadr[endless], None] + reach[:, None] * [-1.0, 1.0]
    ranges[endless] = np.clip(here, *model.jnt_range[endless].T[..., None])
    return ranges
