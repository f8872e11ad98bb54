"""Signed distances of points from surfaces, with outward normals."""

from __future__ import annotations

import torch
from torch import Tensor

_TINY = 1e-12  # metres


def from_plane(point: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance ``[*B]`` of points ``[*B, 3]`` above the plane z = 0, and normals ``[*B, 3]``."""
    return point[..., 2], torch.eye(3, dtype=point.dtype, device=point.device)[2].expand_as(point)


def from_box(point: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance ``[*B]`` from boxes centred at the origin with half sizes ``[*B, 3]``, and normals.

    A box with two zero half sizes is a segment, with three a point. Inside, use the nearest face.
    """
    outside = point - torch.minimum(torch.maximum(point, -half), half)
    far = outside.square().sum(-1)
    is_outside = far > _TINY**2
    length = far.clamp(min=_TINY**2).sqrt()
    depth = point.abs() - half  # [*B, 3] negative inside
    x, y, z = depth.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    on_x = torch.where(torch.maximum(y, z) > x, zero, one)
    on_y = torch.where(z > y, zero, 1 - on_x)
    face = torch.stack((on_x, on_y, 1 - on_x - on_y), dim=-1) * torch.where(point < 0, -1.0, 1.0)
    distance = torch.where(is_outside, length, depth.amax(-1))
    normal = torch.where(is_outside.unsqueeze(-1), outside / length.unsqueeze(-1), face)
    return distance, normal


def from_cylinder(point: Tensor, radius: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance ``[*B]`` from cylinders along z at the origin, with sizes ``[*B]``, and normals."""
    x, y, z = point.unbind(-1)
    across = (x.square() + y.square() + _TINY**2).sqrt()
    # The cylinder is a box in the plane of axis and point.
    flat = torch.stack((across, torch.zeros_like(z), z), dim=-1)
    distance, normal = from_box(flat, torch.stack((radius, torch.full_like(radius, 1e9), half), dim=-1))
    outwards = normal[..., 0] / across
    return distance, torch.stack((outwards * x, outwards * y, normal[..., 2]), dim=-1)


def from_ellipsoid(point: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance ``[*B]`` from ellipsoids centred at the origin with half axes ``[*B, 3]``, and normals.

    It is exact on the surface, along the axes and for spheres; elsewhere it is a first-order estimate.
    """
    scaled = point / half
    slope = scaled / half
    steep = (slope.square().sum(-1) + _TINY**2).sqrt()
    size = (scaled.square().sum(-1) + _TINY**2).sqrt()
    return size * (size - 1) / steep, slope / steep.unsqueeze(-1)


def from_hull(point: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance ``[*B]`` from a convex hull, and normals.

    It is exact inside and above faces. Above edges and corners it is too small, but has the right sign.

    Args:
        point: ``[*B, 3]``.
        faces: ``[F, 4]`` outward normal and offset of each face.
    """
    above = point @ faces[:, :3].mT - faces[:, 3]  # [*B, F]
    distance = above.amax(-1)
    # On ties, average the normals of the nearest faces.
    nearest = torch.where(above < distance.unsqueeze(-1), torch.zeros_like(above), torch.ones_like(above))
    normal = nearest @ faces[:, :3]
    return distance, normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)


def from_heights(point: Tensor, heights: Tensor, half: Tensor, nowhere: float) -> tuple[Tensor, Tensor]:
    """Return the distance ``[*B]`` from the height field's triangle below or above each point, and normals.

    A grid cell is two triangles, as in MuJoCo. The distance is exact above a triangle, but not beside ridges and peaks.

    Args:
        point: ``[*B, 3]`` in the frame of the field.
        heights: ``[rows, columns]`` along y and x, metres.
        half: ``[2]`` half sizes along x and y.
        nowhere: distance to return for points beside the field.
    """
    rows, columns = heights.shape
    last = torch.tensor([columns - 1, rows - 1], dtype=half.dtype, device=half.device)
    grid_position = (point[..., :2] / half + 1) * 0.5 * last
    cell = torch.minimum(
        torch.where(grid_position > 0, grid_position.floor(), 0.0), last - 1
    )  # a valid cell even for NaN
    u, v = (grid_position - cell).unbind(-1)
    column, row = cell.long().unbind(-1)
    flat, start = heights.flatten(), row * columns + column
    low, right, up, far = (flat[start + step] for step in (0, 1, columns, columns + 1))
    along = torch.where(u < v, far - up, right - low)
    across = torch.where(u < v, up - low, far - right)
    height = low + u * along + v * across
    slope = torch.stack((along, across), dim=-1) * (0.5 * last / half)
    normal = torch.cat((-slope, torch.ones_like(slope[..., :1])), dim=-1)
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    is_beside = (point[..., :2].abs() - half).amax(-1) > 0
    return torch.where(is_beside, nowhere, (point[..., 2] - height) * normal[..., 2]), normal
