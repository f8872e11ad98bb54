"""Ball that a body fixed to the world by joints cannot leave."""

from __future__ import annotations

import math

import numpy as np

from torchrl_gn.rewards.bodies import find_body
from torchrl_gn.scenes.scene import Scene


def arm_reach(scene: Scene, body: str) -> tuple[np.ndarray, float]:
    """Centre and radius of a ball that a body cannot leave, whatever its joint limits.

    Bodies between hinges and ball joints are rigid links: the radius is the sum of their lengths.

    Args:
        scene: the scene.
        body: name of the body.

    Returns:
        Anchor of the first joint in the world, ``[3]`` metres (of a fixed body its own position), and the radius in
        metres. The radius is infinite if a joint on the way slides or is free, or if the joints of one body do not
        share one anchor.

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
