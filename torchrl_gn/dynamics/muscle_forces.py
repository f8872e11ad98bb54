"""Forces of MuJoCo's muscles by length and velocity, as in ``mju_muscleGain`` and ``mju_muscleBias``."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths.float64_buffers import Float64Buffers

_TINY = mujoco.mjMINVAL
_NUMBERS = 9  # parameters of a muscle: range 2, force, scale, lmin, lmax, vmax, fpmax, fvmax


class MuscleForces(Float64Buffers):
    """Gain and bias of muscles; ``actuators`` ``[...]`` are their indices in the model, -1 for no muscle."""

    active: Tensor
    passive: Tensor

    def __init__(self, model: mujoco.MjModel, actuators: np.ndarray) -> None:
        super().__init__()
        has_bias = (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_MUSCLE))[actuators]
        bias = _constants(model, actuators, model.actuator_biasprm)
        bias[3] = np.where(has_bias, bias[3], 0.0)  # its peak force
        self.constants({"active": _constants(model, actuators, model.actuator_gainprm), "passive": bias})

    def gain(self, length: Tensor, velocity: Tensor) -> Tensor:
        """Return the force at full activation ``[*B, ...]`` for actuators' lengths (m or rad) and velocities."""
        begin, unit, first, peak, shortest, longest, fastest, _, most = self.active.to(length.dtype)
        at, speed = first + (length - begin) / unit, velocity / (unit * fastest)
        rise, fall = 0.5 * (shortest + 1), 0.5 * (1 + longest)
        below = _hump(at, shortest, rise)
        above = _hump(2 - at, 2 - longest, 2 - fall)
        slow = (speed + 1).clamp(min=0)
        more = most - 1
        fast = most - (more - speed).clamp(min=0).square() / more.clamp(min=_TINY)
        speed_factor = torch.where(speed < 0, slow * slow, fast)
        return -peak * torch.where(at < 1, below, above) * speed_factor

    def bias(self, length: Tensor) -> Tensor:
        """Return the passive force ``[*B, ...]``."""
        begin, unit, first, peak, _, longest, _, passive, _ = self.passive.to(length.dtype)
        at = first + (length - begin) / unit
        x = (at - 1) / (0.5 * (longest - 1)).clamp(min=_TINY)
        bent = x.clamp(min=0)
        return -peak * passive * torch.where(x < 1, 0.5 * bent * bent, x - 0.5)


def _hump(at: Tensor, zero: Tensor, middle: Tensor) -> Tensor:
    """Rise from 0 at ``zero`` to 1 at 1: a parabola that opens upwards until ``middle``, then one downwards."""
    x = ((at - zero) / (middle - zero).clamp(min=_TINY)).clamp(0, 1)
    y = ((1 - at) / (1 - middle).clamp(min=_TINY)).clamp(0, 1)
    return torch.where(at < middle, 0.5 * x * x, 1 - 0.5 * y * y)


def _constants(model: mujoco.MjModel, actuators: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return ``[9, ...]``: start and unit of the length, start of its range, peak force, and the curves' 5 numbers."""
    low, high, force, scale, *curves = np.moveaxis(numbers[actuators, :_NUMBERS], -1, 0)
    begin, end = np.moveaxis(model.actuator_lengthrange[actuators], -1, 0)
    unit = np.maximum((end - begin) / np.maximum(high - low, _TINY), _TINY)
    peak = np.where(force < 0, scale / np.maximum(model.actuator_acc0[actuators], _TINY), force)
    shortest, longest, fastest, passive, most = curves
    return np.stack((begin, unit, low, peak, shortest, longest, np.maximum(fastest, _TINY), passive, most))
