"""Checks that refuse TorchRL's transforms that mislead stateless environments."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, DTypeCastTransform, FrameSkipTransform, Transform, TransformedEnv

_FRAME_SKIP, _TRANSFORMED = FrameSkipTransform._step.__code__, TransformedEnv._step.__code__
_WORKERS = ("_run_worker_pipe_shared_mem", "_run_worker_pipe_direct")  # functions that run a ParallelEnv's workers
_SAME = 1e-5  # tolerance for the digits that casts lose
_DEPTH = 16  # callers to check: a few for each environment or transform around this one


@dataclass
class _Seen:
    """Last inputs and outputs of an environment in a worker of a ``ParallelEnv``."""

    reset: Tensor | None = None
    stepped: Tensor | None = None
    read: Tensor | None = None
    action: Tensor | None = None
    foreign: bool = False  # the first step after a reset did not start from the state that the reset wrote


def refuse_transforms(env: Any, tensordict: TensorDictBase, key: str | None = None) -> None:
    """Raise TypeError if a transform around this environment misleads its steps; call this first in ``_step``.

    A stateless environment steps from the entries of its input. ``FrameSkipTransform`` repeats a step with the same
    input, so it takes the same step each time, and adds its reward each time. Transforms of observations in place
    change the state that the next step starts from. Without an entry that a transform drops (``SelectTransform``),
    TorchRL keeps the one of the first step. The call stack shows the transforms, but it ends at the worker of a
    ``ParallelEnv``. There, the entry ``key`` shows transforms around the ``ParallelEnv``: it must equal the
    environment's output, and no step may repeat.
    """
    if torch.compiler.is_compiling():
        return
    frame = sys._getframe(2)
    for _ in range(_DEPTH):
        if frame is None:
            return
        if frame.f_code is _FRAME_SKIP:
            raise TypeError(_no_frame_skip("FrameSkipTransform", env))
        if frame.f_code is _TRANSFORMED:
            _refuse_drops(env, frame.f_locals["self"])
            _refuse_changes(env, frame.f_locals["self"].transform)
        if key is not None and frame.f_code.co_name in _WORKERS:
            return _check_in_worker(env, tensordict, key)
        frame = frame.f_back


def note_output(env: Any, written: Tensor, *, reset: bool) -> None:
    """Keep a state that an environment writes, for :func:`refuse_transforms` in a worker of a ``ParallelEnv``."""
    if torch.compiler.is_compiling() or multiprocessing.parent_process() is None:
        return
    seen = vars(env).setdefault("_seen", _Seen())
    if reset:
        seen.reset, seen.read, seen.foreign = written.detach().clone(), None, False
    else:
        seen.stepped = written.detach().clone()


def _check_in_worker(env: Any, tensordict: TensorDictBase, key: str) -> None:
    seen, given, action = vars(env).setdefault("_seen", _Seen()), tensordict.get(key), tensordict.get("action")
    ndim = tensordict.ndim
    known = any(_same(given, each, ndim) for each in (seen.reset, seen.stepped))
    again = _same(given, seen.read, ndim) and _same(action, seen.action, ndim)
    if not known and again:
        raise TypeError(_no_frame_skip("A transform around a ParallelEnv, such as FrameSkipTransform,", env))
    if not known and seen.foreign:
        raise TypeError(
            f"A transform around a ParallelEnv changes {key!r}, from which the next step of {env} starts: let it write"
            " another key, out_keys=[...]. To step from states of your own, reset to them, set_state=True."
        )
    seen.foreign = not known and seen.read is None and seen.reset is not None
    seen.read, seen.action = given.detach().clone(), action.detach().clone()


def _same(given: Tensor, kept: Tensor | None, ndim: int) -> bool:
    """Return True if one of the samples, of ``ndim`` batch dimensions, is equal; others may just have been reset."""
    if kept is None or kept.shape != given.shape:
        return False
    close = torch.isclose(given.to(kept.dtype), kept, rtol=_SAME, atol=_SAME, equal_nan=True)
    return bool(close.reshape(*given.shape[:ndim], -1).all(-1).any())


def _no_frame_skip(who: str, env: Any) -> str:
    return (
        f"{who} would repeat the same step of {env}, which keeps no state. Use TorchRL's MultiAction() with repeated"
        " actions, or a longer control step: load_scene(..., timestep=...)."
    )


def _refuse_drops(env: Any, around: TransformedEnv) -> None:
    carried = {*env.state_spec.keys(True)} & {*env.observation_spec.keys(True)}
    # A transform may also rename an entry both ways.
    if dropped := sorted(map(str, carried & {*around.state_spec.keys(True)} - {*around.observation_spec.keys(True)})):
        raise TypeError(
            f"A transform, such as SelectTransform or CatTensors(del_keys=True), drops {dropped[0]!r}, from which the"
            f" next step of {env} starts: every step would start from the same one. Let it keep this entry."
        )


def _refuse_changes(env: Any, transform: Transform) -> None:
    for part in _flat(transform):
        casts = isinstance(part, DTypeCastTransform)
        if casts and part.dtype_out.itemsize >= 4:  # pyright: ignore[reportAttributeAccessIssue]
            continue
        changed = {*(part.in_keys or ())} & {*(part.out_keys or ())} & {*env.state_spec.keys(True)}
        # Transforms with an inverse return the environment's own entries to the step, unless digits are lost.
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
