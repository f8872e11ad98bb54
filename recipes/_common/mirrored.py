"""Mirror images of a robot's log as further data."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_gn.scenes import KinematicTree


def mirrored(tree: KinematicTree, data: TensorDictBase) -> tuple[KinematicTree, TensorDictBase]:
    """Return the robot with symmetric command bounds, and the trajectories followed by their mirror images.

    Mirror images have negated angles, velocities and commands.

    Raises:
        ValueError: if the robot has further channels, whose mirror images are unknown.
    """
    if tree.extras:
        raise ValueError(f"mirror=true knows angles, velocities and commands, not the channels {list(tree.extras)}.")
    most = np.maximum(np.abs(tree.action_low), np.abs(tree.action_high))
    image = data.clone()
    image["state"][..., 1:, 1:] *= -1  # sine and velocity
    image["action"] *= -1
    return replace(tree, action_low=-most, action_high=most), cast(TensorDictBase, torch.cat([data, image]))
