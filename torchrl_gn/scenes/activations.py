"""Activations: states of filtered, integrating and muscle actuators, each kept at one node."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.actuator_kinds import turning_servos
from torchrl_gn.scenes.node_channels import NodeChannels, moved_nodes, numbered
from torchrl_gn.scenes.topology import EdgePair

_DYN = mujoco.mjtDyn
_KNOWN = (_DYN.mjDYN_INTEGRATOR, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT, _DYN.mjDYN_MUSCLE)


@dataclass(frozen=True, eq=False)
class Activations(NodeChannels):
    """The ``na`` activations of a model (``mjData.act``), in order, each at the first node that its actuator moves."""

    actuator: np.ndarray  # [na] actuator of each activation
    known: np.ndarray  # [na] bool, True if it follows one of MuJoCo's laws, see ActivationLaws


def find_activations(model: mujoco.MjModel, pairs: Sequence[EdgePair], action: np.ndarray) -> Activations:
    """Find the activations of a model; ``action`` ``[P, C]`` holds the actuators at the edge ``pairs``."""
    order = np.argsort(model.actuator_actadr)
    actuators = np.repeat(order, np.maximum(model.actuator_actnum[order], 0))
    node, slot = numbered(moved_nodes(actuators.tolist(), pairs, action))
    return Activations(node, slot, actuators, _have_known_laws(model, actuators))


def _have_known_laws(model: mujoco.MjModel, actuators: np.ndarray) -> np.ndarray:
    lawful = np.isin(model.actuator_dyntype, [int(kind) for kind in _KNOWN]) & (model.actuator_actnum == 1)
    # Limits can clip an overshooting filter in any physics step, so it has no law for a control step.
    overshoots = (model.actuator_dyntype == int(_DYN.mjDYN_FILTER)) & (model.actuator_dynprm[:, 0] < model.opt.timestep)
    lawful &= ~(overshoots & model.actuator_actlimited.astype(bool))
    lawful &= turning_servos(model) == 0  # whole turns that depend on the bodies' poses
    return (lawful & (model.actuator_plugin < 0))[actuators]


def activation_numbers(model: mujoco.MjModel) -> list:
    """Return the parameters of activation laws and muscle forces, which all variants of a scene share."""
    acting = np.flatnonzero(model.actuator_actnum > 0)
    names = ("dyntype", "actnum", "dynprm", "actlimited", "actrange", "actearly")
    muscles = np.flatnonzero(muscle_actuators(model))
    by_acceleration = muscles[np.minimum(model.actuator_gainprm, model.actuator_biasprm)[muscles, 2] < 0]
    forces = ("gainprm", "biasprm", "lengthrange")
    columns = [*((name, acting) for name in names), *((name, muscles) for name in forces), ("acc0", by_acceleration)]
    arrays = [np.asarray(getattr(model, f"actuator_{name}")[which], dtype=float) for name, which in columns]
    return [np.round(each, 9).tolist() for each in arrays]


def muscle_actuators(model: mujoco.MjModel) -> np.ndarray:
    """Find actuators ``[A]``, bool, with a muscle's force, a function of length, velocity and activation."""
    gain, bias = mujoco.mjtGain, mujoco.mjtBias
    pulls = model.actuator_gaintype == int(gain.mjGAIN_MUSCLE)
    return pulls & np.isin(model.actuator_biastype, (int(bias.mjBIAS_MUSCLE), int(bias.mjBIAS_NONE)))
