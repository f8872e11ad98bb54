"""Checks of a loss's inputs: entries of a batch, collected steps, and fitted normalisers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.finite import is_traced, require_all_finite
from torchrl_gn.policies import ObservationModel, ObservationNetwork
from torchrl_gn.scenes.checked_trajectories import ENDS

_MASKS: tuple[NestedKey, ...] = (("collector", "mask"), "mask")  # where TorchRL marks real steps, beside padding
_AHEAD = "steps_to_next_obs"  # of MultiStep
_ROUNDING = 1e-3  # least jump between two steps that is not rounding
COLLECTED: tuple[NestedKey, ...] = (*_MASKS, _AHEAD)
"""Entries that say which collected steps are real, and of how many steps."""


def collected_mask(tensordict: TensorDictBase) -> Tensor | None:
    """Return TorchRL's mask ``[*B]`` of collected steps, False where it padded; None if all are steps.

    ``Collector(split_trajs=True)``, ``split_trajectories`` and ``SliceSampler(pad_output=True)`` pad.
    """
    for key in _MASKS:
        mask = cast("Tensor | None", tensordict.get(key, None))
        if isinstance(mask, Tensor) and mask.dtype == torch.bool and mask.numel() == tensordict.numel():
            return None if is_traced() or bool(mask.all()) else mask.reshape(tensordict.shape)
    return None


def ends_of(tensordict: TensorDictBase, done: NestedKey = ("next", "done")) -> Tensor | None:
    """Return where episodes of rows end, bool ``[B, H]``; None if there are no flags.

    Flags are ``[B, H]`` or ``[B, H, 1]``: ``done``, and ``terminated`` and ``truncated`` in the same place. Gymnasium
    has the last two only.
    """
    *prefix, _ = done if isinstance(done, tuple) else (done,)
    keys: list[NestedKey] = [done, *((*prefix, name) for name in ENDS[1:])]
    flags = [cast(Tensor, flag) for key in keys if (flag := tensordict.get(key, None)) is not None]
    return torch.stack([flag.reshape(len(flag), -1).bool() for flag in flags]).any(0) if flags else None


def require_steps(what: str, tensordict: TensorDictBase) -> None:
    """Raise ValueError, naming ``what``, if TorchRL's ``MultiStep`` has moved next states several steps ahead."""
    ahead = cast("Tensor | None", tensordict.get(_AHEAD, None))
    if ahead is not None and not is_traced() and bool((ahead != 1).any()):
        raise ValueError(
            f"{what} needs transitions of one step, the batch has some of {int(ahead.max())}"
            f" ({_AHEAD!r}): leave MultiStep out."
        )


def require_some(what: str, tensordict: TensorDictBase, state: Tensor | None = None) -> None:
    """Raise ValueError, naming ``what``, if a batch, or its entry ``state``, is empty: a mean over nothing is NaN."""
    if 0 in (tensordict.shape if state is None else state.shape):  # numel() of an empty TensorDict is 1
        raise ValueError(f"{what}: the batch {list(tensordict.shape)} is empty, so there is no loss.")


def require_unpadded(what: str, tensordict: TensorDictBase) -> None:
    """Raise ValueError, naming ``what``, if TorchRL has padded the episodes of a batch."""
    if collected_mask(tensordict) is not None:
        raise ValueError(f"{what}: the batch has padding, as its mask shows: give batch[mask].")


def require_consecutive(what: str, state: Tensor, next_state: Tensor, done: Tensor | None) -> None:
    """Raise ValueError if a step of rows ``[B, H, N, C]`` does not start where the step before it ended.

    The two states may differ by the row's largest change within a step (noise on the states). ``done`` ``[B, H]`` or
    ``[B, H, 1]`` is True where an episode ends; the step after it may start anywhere. ``what`` names the rows in the
    message.
    """
    if is_traced() or state.shape[1] < 2 or not state.numel():
        return
    change = (next_state - state).detach().flatten(2).norm(dim=-1)
    jump = (state[:, 1:] - next_state[:, :-1]).detach().flatten(2).norm(dim=-1)
    wrong = jump > change.amax(1, keepdim=True) + _ROUNDING
    if done is not None:
        wrong = wrong & ~done.reshape(change.shape)[:, :-1].bool()
    if bool(wrong.any()):
        row, step = wrong.nonzero()[0].tolist()
        raise ValueError(
            f"{what}: step {step + 1} of row {row} does not start where step {step} ended, and no ('next', 'done') says"
            " that an episode ends there. Rows must be consecutive steps, as of SliceSampler or"
            " trajectory_buffer(window=); after a reset inside a row, set ('next', 'done') of the step before it."
        )


def importance_weights(loss: Any, tensordict: TensorDictBase, shape: Sequence[int]) -> Tensor | None:
    """Return the weights ``[*B]``, of shape ``shape``, that a ``PrioritizedSampler`` gave to a batch; None without any.

    A sampler of rows ``[B, H]`` gives each step a weight, or each row. Weighted means divide by the sum of the weights,
    as in TorchRL's losses.
    """
    # Not LossModule._maybe_get_priority_weight, which raises a TypeError for a nested key.
    key = loss.tensor_keys.priority_weight
    weights = cast("Tensor | None", tensordict.get(key, None) if loss.use_prioritized_weights else None)
    if weights is None:
        return None
    require_all_finite({f"{key!r} of the batch": weights})
    weights = weights.detach().squeeze(-1) if weights.ndim > len(shape) else weights.detach()
    return weights.reshape(*weights.shape, *[1] * (len(shape) - weights.ndim)).expand(*shape)


def read_entries(loss: nn.Module, tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> list[Tensor]:
    """Return entries of a batch in the order of ``keys``, usable by autograd if they were made in inference mode.

    KeyError if one is missing, ValueError if NaN or Inf.
    """
    values = {}
    for key in keys:
        value = tensordict.get(key, None)
        if value is None:
            present = sorted(map(str, tensordict.keys(True)))
            raise KeyError(f"{type(loss).__name__} needs {key!r}, the batch has {present}.")
        values[f"{key!r} of the batch"] = value
    require_all_finite(values)
    return [usable_by_autograd(value) for value in values.values()]


def usable_by_autograd(entry: Tensor) -> Tensor:
    """Return a copy of a tensor that was made in inference mode, which autograd refuses; other tensors themselves.

    Compiled code returns the tensor itself, because Dynamo cannot ask for the mode.
    """
    if torch.compiler.is_compiling() or not entry.is_inference() or torch.is_inference_mode_enabled():
        return entry
    return entry.clone()


def require_fitted(loss: Any, *networks: nn.Module, remedy: str, also: Callable[[], None] | None = None) -> None:
    """Raise RuntimeError, with a ``remedy``, if normalisers of the loss's networks have seen no data.

    Reading statistics waits for the device. A loss therefore checks only until the check passes once, and never while
    it is compiled or transformed by ``torch.func``: call the loss once before. ``also`` is a second check, which raises
    its own error.
    """
    if getattr(loss, "_fitted", False) or is_traced():
        return
    for part in (part for network in networks for part in network.modules()):
        if isinstance(part, (ForwardModel, ObservationModel, ObservationNetwork)) and not part.fitted:
            raise RuntimeError(
                f"{type(loss).__name__}: normalisers of its {type(part).__name__} have seen no data, so it would"
                f" read zeros. {remedy}"
            )
    if also is not None:
        also()
    loss._fitted = True
