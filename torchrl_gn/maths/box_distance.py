"""Distance from a segment to a box: what contacts between spheres, capsules and boxes need."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_STEPS = 4
_TINY = 1e-12  # metres


class Nearest(NamedTuple):
    """Where a segment is nearest to a box."""

    distance: Tensor  # [*B] metres, negative inside the box
    normal: Tensor  # [*B, 3] unit vector from the box to the segment
    fraction: Tensor  # [*B] of the segment's length, 0 to 1


def segment_to_box(start: Tensor, direction: Tensor, half: Tensor) -> Nearest:
    """Signed distance of segments from boxes about the origin, differentiable.

    A direction of 0 is a point; a box with two sizes 0 is a segment, one with three a point. The squared distance along
    the segment is convex and piecewise quadratic: a few Newton steps find its minimum. Of a segment through a box the
    depth is that of one of its points in the box.

    Args:
        start: ``[*B, 3]`` first end of each segment in its box's frame, metres.
        direction: ``[*B, 3]`` from there to the second end.
        half: ``[*B, 3]`` half sizes of each box, metres.
    """
    square = direction * direction
    fraction = (-(start * direction).sum(-1) / (square.sum(-1) + _TINY**2)).clamp(0, 1)
    for _ in range(_STEPS):
        point = start + fraction.unsqueeze(-1) * direction
        slope = (_outside(point, half) * direction).sum(-1)
        curvature = torch.where(point.abs() > half, square, 0.0).sum(-1)
        fraction = (fraction - slope / (curvature + _TINY**2)).clamp(0, 1)
    point = start + fraction.unsqueeze(-1) * direction
    outside = _outside(point, half)
    far = outside.square().sum(-1)
    apart = far > _TINY**2
    length = far.clamp(min=_TINY**2).sqrt()
    depth = point.abs() - half  # [*B, 3] negative inside
    x, y, z = depth.unbind(-1)
    sign = torch.where(point < 0, -1.0, 1.0)
    one = torch.ones_like(x)
    along_x = torch.where(torch.maximum(y, z) > x, 0.0, one)
    along_y = torch.where(z > y, 0.0, one) * (1 - along_x)
    face = torch.stack((along_x, along_y, 1 - along_x - along_y), dim=-1) * sign
    distance = torch.where(apart, length, depth.amax(-1))
    normal = torch.where(apart.unsqueeze(-1), outside / length.unsqueeze(-1), face)
    return Nearest(distance, normal, fraction)


def _outside(point: Tensor, half: Tensor) -> Tensor:
    """Vector ``[*B, 3]`` from the nearest point of the box, 0 inside."""
    return point - torch.minimum(torch.maximum(point, -half), half)
