"""Steps of some of a batch's episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

_ENDS = ("done", "terminated", "truncated")


def step_some(
    tensordict: TensorDictBase, step: Callable[[TensorDictBase], TensorDictBase], *, fixed: bool = False
) -> TensorDictBase:
    """Step the samples of a TensorDict ``[*B]`` that TorchRL's entry ``_step`` ``[*B]`` or ``[*B, 1]`` marks.

    TorchRL sets it for environments of a fixed batch size, so that episodes do not go on after their end, within a
    chunk of actions (``MultiAction``) or a rollout. Other samples keep state and flags, with reward 0. ``step`` gets
    only those to step, unless its batch size is ``fixed``.
    """
    mask = cast("Tensor | None", tensordict.get("_step", None))
    if mask is None:
        return step(tensordict)
    mask, tensordict = mask.reshape(tensordict.shape), tensordict.exclude("_step")
    if bool(mask.all()):
        return step(tensordict)
    stepped = step(tensordict)[mask] if fixed else step(cast(TensorDictBase, tensordict[mask]))
    after = cast(TensorDictBase, stepped)
    entries: dict[Any, Any] = {}
    for key, value in after.items():
        held = None if key == "reward" else tensordict.get(key, None)
        if held is None:  # without flags of its own, a sample that is not to be stepped is over
            fill = torch.ones if key in _ENDS else torch.zeros
            held = fill(*tensordict.shape, *value.shape[1:], dtype=value.dtype, device=value.device)
        entries[key] = held.clone() if isinstance(value, TensorDictBase) else held.to(value.dtype, copy=True)
        entries[key][mask] = value
    return TensorDict(entries, batch_size=tensordict.shape, device=after.device)
