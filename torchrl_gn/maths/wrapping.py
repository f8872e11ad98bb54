"""Shortest paths around spheres and cylinders, as MuJoCo wraps tendons."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

_TINY = 1e-15  # MuJoCo's mjMINVAL


class Wrap(NamedTuple):
    """Contact points of a line on a round body, in the body's frame.

    A line that does not touch the body has both straight parts equal to the whole line; its negative ``arc`` cancels
    one of them, so that the lengths still add up.
    """

    first: Tensor  # [..., 3] end of the straight part from the first point, metres
    second: Tensor  # [..., 3] start of the straight part to the second point, metres
    arc: Tensor  # [...] length on the surface, metres


def wrap(first: Tensor, second: Tensor, side: Tensor, has_side: Tensor, radius: Tensor, is_sphere: Tensor) -> Wrap:
    """Wrap lines between points ``[..., 3]`` around spheres, or cylinders along z, at the origin.

    A ``side`` ``[..., 3]`` outside the body selects the way around. A side inside the body, with which MuJoCo keeps a
    line within a ring, is not supported; nor is a side outside a sphere if its projection onto the line's plane is
    inside.
    """
    unit = torch.eye(3, dtype=first.dtype, device=first.device)
    normal = _unit(torch.linalg.cross(first, second))
    one = _unit(first)
    one, two = (
        torch.where(is_sphere.unsqueeze(-1), own, unit[row].expand_as(own))
        for row, own in enumerate((one, torch.linalg.cross(normal, one)))
    )
    a, b, toward = (((each * one).sum(-1), (each * two).sum(-1)) for each in (first, second, side))
    wraps, p, q, arc = _around_circle(a, b, toward, has_side, radius)
    start, end = (x.unsqueeze(-1) * one + y.unsqueeze(-1) * two for x, y in (p, q))
    # Along a cylinder's axis, the height is linear in the path length.
    before, after = (_length(x[0] - y[0], x[1] - y[1]) for x, y in ((a, p), (b, q)))
    rise = torch.where(is_sphere, 0.0, second[..., 2] - first[..., 2]) / (before + arc + after).clamp(min=_TINY)
    base = torch.where(is_sphere, 0.0, first[..., 2])
    heights = (base + rise * before, base + rise * (before + arc))
    start, end = (point + height.unsqueeze(-1) * unit[2] for point, height in zip((start, end), heights, strict=True))
    arc = torch.where(is_sphere, arc, _length(arc, rise * arc))
    wraps_around = (wraps > 0.5).unsqueeze(-1)
    straight = torch.linalg.vector_norm(second - first, dim=-1)
    arc = torch.where(wraps > 0.5, arc, -straight)
    return Wrap(torch.where(wraps_around, start, second), torch.where(wraps_around, end, first), arc)


_Point = tuple[Tensor, Tensor]


def _around_circle(
    a: _Point, b: _Point, side: _Point, has_side: Tensor, radius: Tensor
) -> tuple[Tensor, _Point, _Point, Tensor]:
    """Return 1 if the line from ``a`` to ``b`` wraps around a circle (else 0), both contact points, and arc length."""
    square, zero = radius * radius, torch.zeros_like(a[0])
    across = b[0] - a[0], b[1] - a[1]
    size = _dot(across, across)
    share = (-_dot(across, a) / size.clamp(min=_TINY)).clamp(0, 1)
    near = share * across[0] + a[0], share * across[1] + a[1]
    toward = side[0] / _length(*side) * radius, side[1] / _length(*side) * radius
    # A line that misses the circle wraps only if it passes on the other side than ``side``.
    opposite = torch.where(has_side, -_dot(toward, near), zero) > 0
    wraps = torch.where(_dot(near, near) > square, torch.where(opposite, zero + 1, zero), zero + 1)
    inside = torch.minimum(_dot(a, a), _dot(b, b)) < square
    wraps = torch.where(inside, zero, torch.where(size < _TINY, zero, wraps))
    # Other lines would have infinite gradients below: replace them by any line outside.
    yes = wraps > 0.5
    a = torch.where(yes, a[0], 2 * radius + zero), torch.where(yes, a[1], zero)
    b = torch.where(yes, b[0], zero), torch.where(yes, b[1], 2 * radius + zero)
    both = [_touching(a, b, sign, toward, has_side, radius) for sign in (1.0, -1.0)]
    first = both[0][2] > both[1][2]
    p, q = (
        (torch.where(first, both[0][i][0], both[1][i][0]), torch.where(first, both[0][i][1], both[1][i][1]))
        for i in (0, 1)
    )
    wraps = torch.where(_crosses(a, p, b, q) > 0.5, zero, wraps)
    turn = p[1] * q[0] - p[0] * q[1]
    turn = torch.where(first, turn, -turn)
    angle = torch.atan2(turn, _dot(p, q)) + torch.where(turn < 0, 2 * math.pi + zero, zero)
    return wraps, p, q, radius * angle


def _touching(
    a: _Point, b: _Point, sign: float, toward: _Point, has_side: Tensor, radius: Tensor
) -> tuple[_Point, _Point, Tensor]:
    """Return both tangent points of one way around, and the score of that way; higher is better."""
    square, points = radius * radius, []
    for (x, y), turned in ((a, sign), (b, -sign)):
        long = x * x + y * y
        root = turned * radius * (long - square).clamp(min=_TINY).sqrt()
        points.append(((x * square + y * root) / long, (y * square - x * root) / long))
    p, q = points
    middle = p[0] + q[0], p[1] + q[1]
    difference = p[0] - q[0], p[1] - q[1]
    good = torch.where(has_side, _dot(middle, toward) / _length(*middle), -_dot(difference, difference))
    return p, q, torch.where(_crosses(a, p, b, q) > 0.5, -1e4, good)


def _crosses(a: _Point, p: _Point, b: _Point, q: _Point) -> Tensor:
    """Return 1 where the straight parts from ``a`` to ``p`` and from ``b`` to ``q`` cross, else 0."""
    one, two, difference = (p[0] - a[0], p[1] - a[1]), (q[0] - b[0], q[1] - b[1]), (a[0] - b[0], a[1] - b[1])
    determinant = two[1] * one[0] - two[0] * one[1]
    parallel = determinant.abs() < _TINY
    determinant = torch.where(parallel, 1.0, determinant)
    shares = [(each[0] * difference[1] - each[1] * difference[0]) / determinant for each in (two, one)]
    within = torch.minimum(*(torch.minimum(share, 1 - share) for share in shares))
    zero = torch.zeros_like(within)
    return torch.where(parallel, zero, torch.where(within < 0, zero, zero + 1))


def _dot(a: _Point, b: _Point) -> Tensor:
    return a[0] * b[0] + a[1] * b[1]


def _length(x: Tensor, y: Tensor) -> Tensor:
    return (x * x + y * y).clamp(min=_TINY * _TINY).sqrt()


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.square().sum(-1, keepdim=True).clamp(min=_TINY * _TINY).sqrt()
