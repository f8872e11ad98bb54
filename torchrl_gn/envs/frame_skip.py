"""A check that refuses TorchRL's FrameSkipTransform around stateless environments."""

from __future__ import annotations

import sys
from typing import Any

import torch
from torchrl.envs import FrameSkipTransform

_CODE = FrameSkipTransform._step.__code__
_DEPTH = 16  # callers to check: a few for each environment or transform around this one


def refuse_frame_skip(env: Any) -> None:
    """Raise TypeError if FrameSkipTransform repeats the step; call this first in ``_step``.

    The transform repeats a step with the same input, which advances only environments that keep a state. A stateless
    one would take the same step each time, and add its reward each time. The check reads the call stack, so it misses
    a transform around a ``ParallelEnv``.
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
