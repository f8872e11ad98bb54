"""Checks that refuse TorchRL's transforms that mislead stateless environments."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any, cast

import torch
from torchrl.envs import Compose, DTypeCastTransform, FrameSkipTransform, Transform, TransformedEnv

_FRAME_SKIP, _TRANSFORMED = FrameSkipTransform._step.__code__, TransformedEnv._step.__code__
_DEPTH = 16  # callers to check: a few for each environment or transform around this one


def refuse_transforms(env: Any) -> None:
    """Raise TypeError if a transform around this environment misleads its steps; call this first in ``_step``.

    A stateless environment steps from the entries of its input. ``FrameSkipTransform`` repeats a step with the same
    input, so it takes the same step each time, and adds its reward each time. Transforms of observations in place
    change what the next step starts from. The check reads the call stack, so it misses transforms around a
    ``ParallelEnv``.
    """
    if torch.compiler.is_compiling():
        return
    frame = sys._getframe(2)
    for _ in range(_DEPTH):
        if frame is None:
            return
        if frame.f_code is _FRAME_SKIP:
            raise TypeError(
                f"FrameSkipTransform would repeat one and the same step of {env}, which keeps no state. Use"
                " MultiAction() of TorchRL, with the action as often as it is to be held, or a longer control step:"
                " load_scene(..., timestep=...)."
            )
        if frame.f_code is _TRANSFORMED:
            _refuse_changes(env, frame.f_locals["self"].transform)
        frame = frame.f_back


def _refuse_changes(env: Any, transform: Transform) -> None:
    for part in _flat(transform):
        casts = isinstance(part, DTypeCastTransform)
        if casts and part.dtype_out.itemsize >= 4:  # pyright: ignore[reportAttributeAccessIssue]
            continue
        changed = {*(part.in_keys or ())} & {*(part.out_keys or ())} & {*env.state_spec.keys(True)}
        # Those with an inverse give the step what the environment wrote, unless digits are lost.
        if changed := sorted(map(str, changed if casts else changed - {*(part.in_keys_inv or ())})):
            raise TypeError(
                f"{type(part).__name__} changes {changed[0]!r}, from which the next step of {env} starts: let it"
                " write another key, out_keys=[...]."
            )


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _flat(cast(Transform, part))
    else:
        yield transform
