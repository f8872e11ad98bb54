"""How far a chain of joints can carry a body."""

from __future__ import annotations

import math

import numpy as np

from torchrl_gn.rewards.bodies import find_body
from torchrl_gn.scenes.scene import Scene


def arm_reach(scene: Scene, body: str) -> tuple[np.ndarray, float]:
    """Ball that a body can never leave.

    The bodies between joints that only turn (hinges, balls) are rigid links, so a body is at most
    the sum of their lengths away from the first joint. Joint limits are not looked at.

    Args:
        scene: the scene.
        body: name of the body.

    Returns:
        Where the first joint of its chain is fixed to the world, ``[3]`` metres (or the body itself, if it
        is fixed), and how far the body gets from there, metres. Infinitely far if a joint on the way slides or is
        free, and for joints of one body that do not turn about one point.

    Raises:
        ValueError: the scene has no such body.
    """
    found, joint_anchors = find_body(scene, body), scene.joint_anchors
    node, point, length = found.node, found.pos, 0.0
    if joint_anchors.root[node] != 0:
        return np.zeros(3), math.inf
    while node:
        length += float(np.linalg.norm(point - joint_anchors.child_anchor[node]))
        node, point = int(joint_anchors.parent[node]), joint_anchors.parent_anchor[node]
    return point, length
