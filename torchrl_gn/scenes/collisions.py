"""Pairs of geoms that MuJoCo lets collide."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.scenes.topology import weld_roots

_Disable = mujoco.mjtDisableBit


def colliding_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Return the pairs of geoms that can collide, ``[G, G]``, bool and symmetric.

    Explicit pairs can collide. Other pairs can if their masks match, and their bodies are neither excluded, nor parts
    of one node, nor parent and child below the world (unless ``filterparent`` is off).
    """
    if model.opt.disableflags & (_Disable.mjDSBL_CONTACT | _Disable.mjDSBL_CONSTRAINT):
        return np.zeros((model.ngeom, model.ngeom), dtype=bool)
    body = model.geom_bodyid
    weld, root = model.body_weldid[body], weld_roots(model)[body]  # they differ for mocap bodies
    masks = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    colliding = (masks | masks.T) & (root[:, None] != root)
    if not model.opt.disableflags & _Disable.mjDSBL_FILTERPARENT:
        above = model.body_weldid[model.body_parentid[weld]]
        child = (above[:, None] == weld) & (weld > 0)
        colliding &= ~(child | child.T)
    signature = (np.minimum(body[:, None], body) << 16) + np.maximum(body[:, None], body)
    colliding &= ~np.isin(signature, model.exclude_signature)
    colliding[model.pair_geom1, model.pair_geom2] = colliding[model.pair_geom2, model.pair_geom1] = True
    return colliding
