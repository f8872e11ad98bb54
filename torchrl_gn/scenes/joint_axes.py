"""Joint axes: which body each is fixed to."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.scenes.scene import Scene


def joint_axes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Node ``[J]`` that each joint's axis is fixed to, and the unit axis ``[J, 3]`` in its frame.

    The node is the parent if no rotation precedes the joint on its body, else the child (approximate for the middle one
    of three hinges). Axes of balls and free joints are 0.
    """
    model, kind = scene.model, mujoco.mjtJoint
    nodes, axes = scene.receivers[::2].copy(), np.zeros((model.njnt, 3))
    rotated: set[int] = set()
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if model.jnt_type[joint] not in (int(kind.mjJNT_HINGE), int(kind.mjJNT_SLIDE)):
            rotated.add(body)
            continue
        axes[joint] = model.jnt_axis[joint]
        if body not in rotated:
            child = nodes[joint]
            nodes[joint] = scene.senders[2 * joint]
            rest = scene.static.nodes[child, [scene.static.node_names.index(f"quat[{index}]") for index in range(4)]]
            mujoco.mju_rotVecQuat(axes[joint], model.jnt_axis[joint], rest)
        if model.jnt_type[joint] == int(kind.mjJNT_HINGE):
            rotated.add(body)
    return nodes, axes
