"""Refusal of scenes with forces that depend on mocap poses in actions, which no state holds."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from torchrl_gn.scenes.collisions import colliding_geoms
from torchrl_gn.scenes.lines import tendon_pieces
from torchrl_gn.scenes.mocap import MocapActions
from torchrl_gn.scenes.scene import UnsupportedSceneError
from torchrl_gn.scenes.topology import Topology, named

_OBJECT, _TRANSMISSION = mujoco.mjtObj, mujoco.mjtTrn


def refuse_mocap_actions(model: mujoco.MjModel, graph: Topology, mocaps: MocapActions) -> None:
    """Raise UnsupportedSceneError if forces or joints of moving bodies depend on poses that are actions.

    Mocap bodies whose poses are actions may act on moving bodies by connects and welds alone.
    """
    if not len(mocaps):
        return
    led = np.isin(model.body_rootid, mocaps.body)
    moving = graph.node_of_body > 0
    can_touch = colliding_geoms(model)[:, moving[model.geom_bodyid]].any(1)
    if len(touching := np.flatnonzero(led[model.geom_bodyid] & can_touch)):
        names = [named(model, _OBJECT.mjOBJ_GEOM, int(geom)) for geom in touching]
        raise UnsupportedSceneError(
            f"Geoms {names} of mocap bodies whose poses are actions can touch moving bodies, which states do not show:"
            ' give them contype="0" conaffinity="0".'
        )
    if carried := list(_carried(model, led)):
        raise UnsupportedSceneError(
            f"Mocap bodies whose poses are actions carry {', '.join(carried)}, which states do not show: move them to"
            " other bodies, or load the scene without mocap_actions."
        )


def _carried(model: mujoco.MjModel, led: np.ndarray) -> Iterator[str]:
    """Name bodies with joints, tendons and actuators that are on the bodies ``led`` ``[nbody]``, bool."""
    for body in np.flatnonzero(led & (model.body_jntnum > 0)).tolist():
        yield f"body {named(model, _OBJECT.mjOBJ_BODY, body)!r}"
    for tendon in range(model.ntendon):
        pieces = tendon_pieces(model, tendon)
        sites = [site for piece in pieces for site in (piece.first, piece.second)]
        geoms = [piece.geom for piece in pieces if piece.geom >= 0]
        if led[model.site_bodyid[sites]].any() or led[model.geom_bodyid[geoms]].any():
            yield f"tendon {named(model, _OBJECT.mjOBJ_TENDON, tendon)!r}"
    kinds = int(_TRANSMISSION.mjTRN_SITE), int(_TRANSMISSION.mjTRN_SLIDERCRANK)
    for actuator in np.flatnonzero(np.isin(model.actuator_trntype, kinds)).tolist():
        sites = [site for site in model.actuator_trnid[actuator].tolist() if site >= 0]
        if led[model.site_bodyid[sites]].any():
            yield f"actuator {named(model, _OBJECT.mjOBJ_ACTUATOR, actuator)!r}"
