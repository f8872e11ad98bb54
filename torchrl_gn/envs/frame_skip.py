"""Refuse TorchRL's FrameSkipTransform around environments that keep no state."""

from __future__ import annotations

import sys
from typing import Any

import torch
from torchrl.envs import FrameSkipTransform

_CODE = FrameSkipTransform._step.__code__
_DEPTH = 16  # callers to look at: a few for each environment or transform around this one


def refuse_frame_skip(env: Any) -> None:
    """Raise TypeError if the step is one that FrameSkipTransform repeats; call it first in ``_step``.

    The transform steps the same input again and again, as for an environment that remembers where it is. A stateless
    one would take the same step each time, and count its reward each time. Only the callers tell such a step from
    another, so that a transform around a ``ParallelEnv`` is not seen.
    """
    if torch.compiler.is_compiling():
        return
    frame = sys._getframe(2)
    for _ in range(_DEPTH):
        if frame is None:
            return
        if frame.f_code is _CODE:
            raise TypeError(
                f"FrameSkipTransform would repeat one and the same step of {env}, which keeps no state. Use"
                " MultiAction() of TorchRL, with the action as often as it is to be held, or a longer control step:"
                " load_scene(..., timestep=...)."
            )
        frame = frame.f_back
