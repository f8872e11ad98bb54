"""Unwrapped angles of hinges, which body poses do not show: whole turns, or a side of gimbal lock."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.force_elements import (
    joint_groups,
    limited_joints,
    passes_gimbal_lock,
    sprung,
    winding_joints,
)
from torchrl_gn.scenes.node_channels import NodeChannels, numbered
from torchrl_gn.scenes.tendons import is_fixed
from torchrl_gn.scenes.topology import Topology


@dataclass(frozen=True, eq=False)
class UnwrappedAngles(NodeChannels):
    """Unwrapped angles of hinges, as in ``qpos``, each at the node that its hinge moves."""

    joint: np.ndarray  # [K] joint of each angle


def find_unwrapped_angles(model: mujoco.MjModel, graph: Topology, action: np.ndarray) -> UnwrappedAngles:
    """Find hinges with a force that depends on the angle and that may make whole turns, and three that may lock.

    Of three hinges of a body, poses beyond gimbal lock look like others before it: all three angles tell them apart.
    ``action`` ``[P, C]`` holds the actuators at each edge pair.
    """
    groups, others = joint_groups(model, graph.body)
    matters = winding_joints(model) & _has_angle_forces(model, action[: model.njnt])
    matters[others] = False  # angles that do not follow from body poses
    for _, joints in groups["three"]:
        if passes_gimbal_lock(model, joints):
            matters[joints] = True
        else:
            matters[joints[1]] = False  # it stays within half a turn
    joint = np.flatnonzero(matters)
    node, slot = numbered(graph.node_of_body[model.jnt_bodyid[joint]].tolist())
    return UnwrappedAngles(node, slot, joint)


def _has_angle_forces(model: mujoco.MjModel, action: np.ndarray) -> np.ndarray:
    """Find joints ``[J]``, bool, where the force of a limit, spring, servo, tendon or coupling depends on the angle."""
    has_force = limited_joints(model) | sprung(model, "jnt")
    fixed, affine = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)
    none, sloped = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
    by_gain = np.where(model.actuator_gaintype == affine, model.actuator_gainprm[:, 1] != 0, True)
    by_bias = np.where(model.actuator_biastype == sloped, model.actuator_biasprm[:, 1] != 0, True)
    by_gain[model.actuator_gaintype == fixed] = False
    by_bias[model.actuator_biastype == none] = False
    plugins = model.actuator_plugin >= 0  # their laws are unknown
    acts = np.append(by_gain | by_bias | plugins, False)  # the last entry is for -1, no actuator
    has_force |= acts[action].any(1)
    has_force[_coupled(model, mujoco.mjtEq.mjEQ_JOINT)] = True
    tendons = model.tendon_limited.astype(bool) | sprung(model, "tendon")
    tendons[_coupled(model, mujoco.mjtEq.mjEQ_TENDON)] = True
    for tendon in np.flatnonzero(tendons).tolist():
        parts = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        if is_fixed(model, tendon):
            has_force[model.wrap_objid[parts]] = True
    return has_force


def _coupled(model: mujoco.MjModel, kind: mujoco.mjtEq) -> np.ndarray:
    """Return the joints or tendons of constraints of a kind."""
    some = model.eq_type == int(kind)
    joints = np.concatenate((model.eq_obj1id[some], model.eq_obj2id[some]))
    return joints[joints >= 0]
