"""Restarts of predictions where episodes end inside rows of collected steps, and padding of rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.networks import Graph


class Starts(NamedTuple):
    """Start of the step at one time of a row; ``[B]`` bool if it differs between samples."""

    true: bool | Tensor  # True: from the true state, else from the predicted one
    fresh: Tensor | None  # True: first step of an episode; None if it is for no sample


def starts_of(done: Tensor | None, steps: int, teacher_forced_steps: int) -> list[Starts]:
    """Return the start of each of a row's ``steps``, given ``done`` ``[B, steps]`` or ``[B, steps, 1]`` if known.

    The first ``teacher_forced_steps`` of an episode start from true states. Waits for the device once.
    """
    whole = [Starts(step < teacher_forced_steps, None) for step in range(steps)]
    if done is None or steps == 1:
        return whole
    ends = done.reshape(len(done), steps)[:, :-1].bool()
    fresh = torch.cat((ends.new_ones(len(done), 1), ends), dim=1)
    any_fresh = fresh.any(0).tolist()
    if not any(any_fresh[1:]):
        return whole
    step = torch.arange(steps, device=fresh.device)
    age = step - torch.where(fresh, step, 0).cummax(1).values
    forced = age < teacher_forced_steps
    return [Starts(forced[:, t], fresh[:, t] if any_fresh[t] else None) for t in range(steps)]


def fill_padding(
    batch: TensorDictBase, mask: Tensor, keys: Sequence[NestedKey], done: NestedKey
) -> tuple[TensorDictBase, Tensor]:
    """Replace the padding in rows ``[B, H]`` by copies of each row's first step, so that it breaks no prediction.

    Errors at padding must not count. An episode ends before and at each padded step.

    Args:
        mask: ``[B, H]``, True for collected steps. Rows without any are dropped.
        keys: entries to fill.
        done: key of the flags that end episodes.

    Returns:
        The remaining rows and their mask.
    """
    some = mask.any(1)
    batch, mask = cast(TensorDictBase, batch[some]), mask[some]
    first = mask.int().argmax(1)
    row = torch.arange(len(mask), device=mask.device)

    def filled(entry: Tensor) -> Tensor:
        return torch.where(mask.reshape(*mask.shape, *[1] * (entry.ndim - 2)), entry, entry[row, first].unsqueeze(1))

    # By key, as the parts of a lazy stack have other dimensions; an entry may be a TensorDict of parameters.
    known = {key: cast("Tensor | TensorDictBase | None", batch.get(key, None)) for key in keys}
    batch = batch.copy()
    for key, entry in known.items():
        if entry is not None:
            batch.set(key, entry.to_tensordict().apply(filled) if isinstance(entry, TensorDictBase) else filled(entry))
    ends = ~mask | torch.cat((~mask[:, 1:], torch.zeros_like(mask[:, :1])), dim=1)
    flags = batch.get(done, None)
    ends = ends if flags is None else ends | cast(Tensor, flags).reshape(mask.shape).bool()
    return batch.set(done, ends.unsqueeze(-1)), mask


def choose(true: bool | Tensor, one: Tensor, other: Tensor) -> Tensor:
    """Select samples of ``one`` ``[B, ...]`` where ``true`` ``[B]``, else of ``other``."""
    if isinstance(true, bool):
        return one if true else other
    return torch.where(true.reshape(-1, *[1] * (one.ndim - 1)), one, other)


def forget(hidden: Graph | None, fresh: Tensor | None) -> Graph | None:
    """Reset a recurrent model's hidden state to its initial zeros where an episode is ``fresh`` ``[B]``."""
    if hidden is None or fresh is None:
        return hidden
    return Graph(
        *(choose(fresh, torch.zeros_like(part), part) for part in hidden.features), edge_index=hidden.edge_index
    )


def require_constant(parameters: TensorDictBase, starts: list[Starts], what: str) -> None:
    """Raise ValueError if physical parameters ``[B, steps]`` change in rows in which an episode begins."""
    if all(start.fresh is None for start in starts):
        return
    for name, value in parameters.items(True, True):
        if not bool((value == value[:, :1]).all()):
            raise ValueError(
                f"{what} {name!r} change where an episode of a row ends: give windows [B, H] of one episode each"
            )
