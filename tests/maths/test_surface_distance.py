"""Distances from surfaces against closed forms and MuJoCo's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.maths import surface_distance as surfaces
from torchrl_gn.scenes.surfaces import find_surface

POINTS = torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
SIZES = torch.tensor([0.3, 0.5, 0.2], dtype=torch.float64)


def normals_are_slopes(function, points) -> None:
    """A distance's gradient is the normal, of length one."""
    points = points.clone().requires_grad_()
    distance, normal = function(points)
    (slope,) = torch.autograd.grad(distance.sum(), points)
    torch.testing.assert_close(normal, slope, rtol=0, atol=1e-7)
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones(len(points), dtype=points.dtype))


CASES = {
    "box": (lambda points: surfaces.from_box(points, SIZES), '<geom type="box" size=".3 .5 .2"/>'),
    "capsule": (
        lambda points: surfaces.from_box(points, torch.tensor([0, 0, 0.5], dtype=points.dtype)),
        '<geom type="capsule" size="1e-9 .5"/>',
    ),
    "cylinder": (
        lambda points: surfaces.from_cylinder(points, SIZES[0], SIZES[1]),
        '<geom type="cylinder" size=".3 .5"/>',
    ),
}


@pytest.mark.parametrize("kind", CASES)
def test_distances_and_normals_are_mujocos(kind):
    function, geom = CASES[kind]
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody>{geom}<body mocap="true"><geom size="1e-9"/></body></worldbody></mujoco>'
    )
    data, ends, expected = mujoco.MjData(model), np.zeros(6), []
    distance, normal = function(POINTS)
    outside = distance > 1e-6
    for point, towards in zip(POINTS[outside].numpy(), normal[outside].numpy(), strict=True):
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        expected.append(mujoco.mj_geomDistance(model, data, 0, 1, 10, ends))
        np.testing.assert_allclose(ends[3:] - ends[:3], expected[-1] * towards, atol=1e-6)
    np.testing.assert_allclose(distance[outside], expected, atol=1e-6)
    normals_are_slopes(function, POINTS)


def test_inside_a_box_and_a_cylinder_the_nearest_face_counts():
    point = torch.tensor([[0.25, 0.1, 0.0], [0.0, 0.0, -0.19]], dtype=torch.float64)
    distance, normal = surfaces.from_box(point, SIZES)
    torch.testing.assert_close(distance, torch.tensor([-0.05, -0.01], dtype=torch.float64))
    assert normal.tolist() == [[1, 0, 0], [0, 0, -1]]
    distance, normal = surfaces.from_cylinder(point, SIZES[0], SIZES[2])
    depth = 0.3 - np.hypot(0.25, 0.1)
    torch.testing.assert_close(distance, torch.tensor([-depth, -0.01], dtype=torch.float64))
    np.testing.assert_allclose(normal[0], np.array([0.25, 0.1, 0]) / np.hypot(0.25, 0.1))


def test_ellipsoids_are_exact_where_it_matters():
    away = POINTS / POINTS.norm(dim=-1, keepdim=True)
    on = away * SIZES
    distance, normal = surfaces.from_ellipsoid(on, SIZES)
    torch.testing.assert_close(distance, torch.zeros_like(distance), rtol=0, atol=1e-9)
    near = surfaces.from_ellipsoid(on + 1e-4 * normal, SIZES)[0]
    torch.testing.assert_close(near, torch.full_like(near, 1e-4), rtol=0, atol=1e-6)
    round_ = surfaces.from_ellipsoid(POINTS, torch.full((3,), 0.4, dtype=torch.float64))
    torch.testing.assert_close(round_[0], POINTS.norm(dim=-1) - 0.4, rtol=0, atol=1e-9)
    torch.testing.assert_close(round_[1], away)


def test_hulls_are_exact_above_faces_and_inside():
    """A box by its faces has the box's distances but beside edges, where they are smaller."""
    faces = torch.cat((torch.cat((torch.eye(3), -torch.eye(3))).double(), SIZES.repeat(2).unsqueeze(1)), 1)
    distance, normal = surfaces.from_hull(POINTS, faces)
    exact, direction = surfaces.from_box(POINTS, SIZES)
    beside = (POINTS.abs() > SIZES).sum(-1) > 1
    torch.testing.assert_close(distance[~beside], exact[~beside])
    torch.testing.assert_close(normal[~beside], direction[~beside])
    assert (distance[beside] > 0).all() and (distance[beside] < exact[beside]).all()
    _, on_edge = surfaces.from_hull(SIZES * torch.tensor([1.0, 1, 0]), faces)
    torch.testing.assert_close(on_edge, torch.tensor([0.5**0.5, 0.5**0.5, 0], dtype=torch.float64))


def test_heights_are_those_of_mujocos_triangles():
    heights = ".1 .9 .3 .2 .5 .4 .8 0 .7 1 .2 .6"
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><hfield name="h" nrow="3" ncol="4" size="1 .7 .3 .1" elevation="{heights}"/></asset>'
        '<worldbody><geom type="hfield" hfield="h"/></worldbody></mujoco>'
    )
    data, geom = mujoco.MjData(model), np.zeros(1, dtype=np.int32)
    mujoco.mj_forward(model, data)
    surface = find_surface(model, data, 0)
    assert surface is not None and surface.kind == "heights"
    grid, half = torch.as_tensor(surface.shape), torch.as_tensor(surface.constants[12:14])
    rng = np.random.default_rng(0)
    points = torch.as_tensor(rng.uniform([-1, -0.7, 0.4], [1, 0.7, 0.5], (100, 3)))
    found, normals = surfaces.from_heights(points, grid, half, 1e3)
    for point, gap, direction in zip(points.numpy(), found.tolist(), normals.numpy(), strict=True):
        above = mujoco.mj_ray(model, data, point, np.array([0, 0, -1.0]), None, 1, -1, geom)
        assert gap == pytest.approx(above * direction[2], abs=1e-6)
    outside = torch.tensor([[1.01, 0, 0.5], [0, -0.71, 0.5]], dtype=torch.float64)
    assert surfaces.from_heights(outside, grid, half, 1e3)[0].tolist() == [1e3, 1e3]
    corners = torch.tensor([[1, 0.7, 0.5], [-1, -0.7, 0.5]], dtype=torch.float64)
    heights = (
        0.5
        - surfaces.from_heights(corners, grid, half, 1e3)[0] / surfaces.from_heights(corners, grid, half, 1e3)[1][:, 2]
    )
    torch.testing.assert_close(heights, grid[[-1, 0], [-1, 0]])

    normals_are_slopes(lambda points: surfaces.from_heights(points, grid, half, 1e3), points)
