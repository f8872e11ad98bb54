"""Distance from a segment to a box: what contacts between spheres, capsules and boxes need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_gn.maths.surface_distance import from_box

_TINY = 1e-12  # metres, and the same of slopes
_PULL = 1e-8  # square metres: of all points alike near, the middle of the segment is taken


class Nearest(NamedTuple):
    """Where a segment is nearest to a box."""

    distance: Tensor  # [*B] metres, negative inside the box
    normal: Tensor  # [*B, 3] unit vector from the box to the segment
    fraction: Tensor  # [*B] of the segment's length, 0 to 1


def segment_to_box(start: Tensor, direction: Tensor, half: Tensor) -> Nearest:
    """Signed distance of segments from boxes about the origin, differentiable.

    A direction of 0 is a point; a box with two sizes 0 is a segment, one with three a point. The squared distance along
    the segment is convex, its slope piecewise linear: the nearest point is between two places where the segment enters
    or leaves the space beside a face. Of a segment through a box the depth is that of one of its points in the box.

    Args:
        start: ``[*B, 3]`` first end of each segment in its box's frame, metres.
        direction: ``[*B, 3]`` from there to the second end.
        half: ``[*B, 3]`` half sizes of each box, metres.
    """
    divisor = torch.where(direction.abs() > _TINY, direction, _TINY)
    breaks = torch.cat(((half - start) / divisor, (-half - start) / divisor), dim=-1).clamp(0, 1)
    rises = _slope(start, direction, half, breaks) > 0
    low = torch.where(rises, 0.0, breaks).amax(-1)
    high = 1 - torch.where(rises, 1 - breaks, 0.0).amax(-1)
    before, after = _slope(start, direction, half, torch.stack((low, high), dim=-1)).unbind(-1)
    fraction = low + (-before / (after - before + _TINY)).clamp(0, 1) * (high - low)
    point = start + fraction.unsqueeze(-1) * direction
    distance, normal = from_box(point, half)
    return Nearest(distance, normal, fraction)


def _slope(start: Tensor, direction: Tensor, half: Tensor, fraction: Tensor) -> Tensor:
    """Half the slope ``[*B, J]`` of the squared distance at fractions ``[*B, J]`` of the segment."""
    point = start.unsqueeze(-2) + fraction.unsqueeze(-1) * direction.unsqueeze(-2)
    return (_outside(point, half.unsqueeze(-2)) * direction.unsqueeze(-2)).sum(-1) + _PULL * (fraction - 0.5)


def _outside(point: Tensor, half: Tensor) -> Tensor:
    """Vector ``[*B, 3]`` from the nearest point of the box, 0 inside."""
    return point - torch.minimum(torch.maximum(point, -half), half)
