"""Which body carries each joint's axis."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_gn.scenes.scene import Scene


def joint_axes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Node that each joint's axis is fixed to, and the axis in that node's frame.

    An axis is fixed to the parent if no rotation precedes the joint on its body, and else to
    the child (exactly if no rotation follows it either: a body with three hinges has a
    middle axis that neither carries, and the child is taken). A ball's axis, and a free
    joint's, has no meaning; theirs is zero.

    Args:
        scene: the scene, ``J`` joints.

    Returns:
        ``[J]`` nodes and ``[J, 3]`` unit axes.
    """
    model, kind = scene.model, mujoco.mjtJoint
    nodes, axes = scene.receivers[::2].copy(), np.zeros((model.njnt, 3))
    turned: set[int] = set()
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        if model.jnt_type[joint] not in (int(kind.mjJNT_HINGE), int(kind.mjJNT_SLIDE)):
            turned.add(body)
            continue
        axes[joint] = model.jnt_axis[joint]
        if body not in turned:
            child = nodes[joint]
            nodes[joint] = scene.senders[2 * joint]
            rest = scene.static.nodes[child, [scene.static.node_names.index(f"quat[{index}]") for index in range(4)]]
            mujoco.mju_rotVecQuat(axes[joint], model.jnt_axis[joint], rest)
        if model.jnt_type[joint] == int(kind.mjJNT_HINGE):
            turned.add(body)
    return nodes, axes
