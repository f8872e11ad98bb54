"""Distance from a segment to a box, for contacts between spheres, capsules and boxes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_gn.maths.surface_distance import from_box

_TINY = 1e-12  # metres; square metres for slopes
_PULL = 1e-8  # square metres; among equally near points, prefer the one nearest the segment's midpoint


class Nearest(NamedTuple):
    """The point of a segment nearest to a box."""

    distance: Tensor  # [*B] metres, negative inside the box
    normal: Tensor  # [*B, 3] unit vector from the box to the segment
    fraction: Tensor  # [*B] position of the point along the segment, 0 to 1


def segment_to_box(start: Tensor, direction: Tensor, half: Tensor) -> Nearest:
    """Return the signed distance of segments from boxes centred at the origin; differentiable.

    A segment of zero ``direction`` is a point. A box with two zero half sizes is a segment, with three a point. The
    squared distance is convex along the segment, and its slope is piecewise linear with breaks at the planes of the
    box's faces; the nearest point lies between two neighbouring breaks. For a segment through the box, the depth is the
    depth of some point inside, not of the deepest one.

    Args:
        start: ``[*B, 3]`` first end of each segment in its box's frame, metres.
        direction: ``[*B, 3]`` from ``start`` to the second end, metres.
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
    """Return half the slope ``[*B, J]`` of the squared distance at fractions ``[*B, J]`` of the segment."""
    point = start.unsqueeze(-2) + fraction.unsqueeze(-1) * direction.unsqueeze(-2)
    return (_outside(point, half.unsqueeze(-2)) * direction.unsqueeze(-2)).sum(-1) + _PULL * (fraction - 0.5)


def _outside(point: Tensor, half: Tensor) -> Tensor:
    """Return the vector ``[*B, 3]`` from the nearest point of the box to ``point``; 0 inside."""
    return point - torch.minimum(torch.maximum(point, -half), half)
