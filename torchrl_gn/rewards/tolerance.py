"""The control suite's tolerance: 1 within bounds, decreasing outside."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

Sigmoid = Literal["gaussian", "linear", "long_tail", "quadratic"]


def tolerance(
    value: Tensor,
    low: float = 0.0,
    high: float = 0.0,
    *,
    margin: float = 0.0,
    sigmoid: Sigmoid = "gaussian",
    at_margin: float = 0.1,
) -> Tensor:
    """Return 1 where ``low <= value <= high``, less outside, like ``dm_control.utils.rewards.tolerance``; elementwise.

    It is differentiable. Without a margin it is 0 outside, with zero gradient everywhere.

    Args:
        margin: distance from the nearest bound at which the result is ``at_margin``, below 1.

    Raises:
        ValueError: ``low`` is above ``high``, or ``margin``, ``at_margin`` or ``sigmoid`` is out of range.
    """
    if not low <= high or not 0 <= margin < math.inf:
        raise ValueError(f"low={low} must be at most high={high}, and margin={margin} 0 or more.")
    least = 0.0 if sigmoid in ("linear", "quadratic") else math.ulp(0.0)  # others never reach 0
    if margin and not least <= at_margin < 1:
        above = "0 or more" if least == 0 else "above 0"
        raise ValueError(f"at_margin={at_margin} must be {above}, and below 1, for sigmoid={sigmoid!r}.")
    beyond = (low - value).clamp(min=0.0) + (value - high).clamp(min=0.0)
    if margin == 0:
        return (beyond == 0).to(value.dtype)
    share = beyond / margin
    if sigmoid == "gaussian":
        return torch.exp(math.log(at_margin) * share.square())
    if sigmoid == "linear":
        return (1 - (1 - at_margin) * share).clamp(min=0.0)
    if sigmoid == "quadratic":
        return (1 - (1 - at_margin) * share.square()).clamp(min=0.0)
    if sigmoid == "long_tail":
        return 1 / (1 + (1 / at_margin - 1) * share.square())
    raise ValueError(f"sigmoid must be gaussian, linear, long_tail or quadratic, got {sigmoid!r}")
