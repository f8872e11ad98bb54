"""Distance from a segment to a box against points along it, and its gradient against finite differences."""

from __future__ import annotations

import pytest
import torch

from torchrl_gn.maths.box_distance import segment_to_box


def draw(count: int, *, half: list[float], seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    start, end = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    return start, end - start, torch.tensor(half, dtype=torch.float64).expand(count, 3)


def distance_of_points(point, half):
    outside = (point.abs() - half).clamp(min=0).norm(dim=-1)
    return torch.where(outside > 0, outside, (point.abs() - half).amax(-1))


@pytest.mark.parametrize("half", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.7], [0.4, 0.2, 0.0], [0.3, 0.5, 0.1]])
def test_a_segment_is_as_far_as_its_nearest_point(half):
    start, direction, half = draw(500, half=half)
    found = segment_to_box(start, direction, half)
    fraction = torch.linspace(0, 1, 2001, dtype=torch.float64)
    points = start[:, None] + fraction[:, None] * direction[:, None]
    nearest = distance_of_points(points, half[:, None]).amin(-1)
    outside = nearest > 1e-3  # of a segment through the box one point inside is taken
    assert outside.sum() > 300
    error = (found.distance - nearest)[outside]
    assert error.min() > -2e-3 and error.max() < 2e-3
    point = start + found.fraction[:, None] * direction
    torch.testing.assert_close(found.distance, distance_of_points(point, half), rtol=0, atol=1e-9)
    assert (found.distance[~outside] < 2e-3).all()
    # The normal leads from the box to the point: along it, the distance grows at rate 1.
    torch.testing.assert_close(found.normal.norm(dim=-1), torch.ones(500, dtype=torch.float64))
    moved = distance_of_points(point + 1e-6 * found.normal, half)
    torch.testing.assert_close(moved, found.distance + 1e-6, rtol=0, atol=1e-9)


def test_a_point_inside_is_as_deep_as_the_nearest_face():
    point = torch.tensor([[0.0, 0.45, 0.0], [-0.28, 0.1, 0.0], [0.0, 0.0, -0.05]], dtype=torch.float64)
    found = segment_to_box(point, torch.zeros_like(point), torch.tensor([0.3, 0.5, 0.1], dtype=torch.float64))
    torch.testing.assert_close(found.distance, torch.tensor([-0.05, -0.02, -0.05], dtype=torch.float64))
    expected = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, -1]], dtype=torch.float64)
    torch.testing.assert_close(found.normal, expected)


@pytest.mark.slow
def test_its_gradient_is_that_of_finite_differences():
    start, direction, half = draw(20, half=[0.3, 0.5, 0.1])
    assert torch.autograd.gradcheck(
        lambda a, b: tuple(segment_to_box(a, b, half)), (start.requires_grad_(), direction.requires_grad_()), eps=1e-7
    )


@pytest.mark.parametrize("point", [[0.0, 0, 0], [0.3, 0, 0], [0.3, 0.5, 0.1], [0.3, 0.3, 0.3]])
def test_gradients_are_finite_everywhere(point):
    start = torch.tensor(point, dtype=torch.float64, requires_grad=True)
    for half in ([0.3, 0.5, 0.1], [0.0, 0, 0.5], [0.0, 0, 0], [0.3, 0.3, 0.3]):
        found = segment_to_box(start, torch.zeros(3, dtype=torch.float64), torch.tensor(half, dtype=torch.float64))
        (gradient,) = torch.autograd.grad(found.distance + found.normal.sum(), start)
        assert gradient.isfinite().all()
