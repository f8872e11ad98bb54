"""Points that can touch the plane, against MuJoCo's own contacts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import load_scene
from torchrl_gn.scenes.contact_points import contact_slots

PLANE = '<geom type="plane" size="9 9 1" pos="0 0 .2" euler="0 20 0"/>'
WELDED = '<body pos=".3 0 0"><geom size=".1" pos=".1 .2 0"/></body>'


def body(geom: str, plane: str = PLANE, welded: str = WELDED) -> str:
    return f"""
      <mujoco><option gravity="0 0 0"/><worldbody>{plane}
        <body pos="0 0 2"><freejoint/>{geom}{welded}</body>
      </worldbody></mujoco>
    """


def lowest(scene, data) -> float:
    """Distance of the nearest point from the plane, metres."""
    points, distances = scene.contact_points, []
    for node, offset, radius in zip(points.node, points.offset, points.radius, strict=True):
        root = scene.body[node]
        place = data.xpos[root] + data.xmat[root].reshape(3, 3) @ offset
        distances.append((place - points.origin) @ points.normal - radius)
    return min(distances)


@pytest.mark.parametrize(
    "geom",
    [
        '<geom size=".1" pos=".1 0 .2"/>',
        '<geom type="capsule" size=".05 .3" pos=".1 0 .2" euler="30 40 50"/>',
        '<geom type="box" size=".1 .2 .3" pos=".1 0 .2" euler="30 40 50"/>',
    ],
)
def test_a_body_touches_where_its_points_do(geom):
    scene = load_scene(body(geom))
    assert set(scene.contact_points.node) == {1}  # the second body is welded to the first
    model, data = scene.model, mujoco.MjData(scene.model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[3:] = rng.standard_normal(4)
        data.qpos[:3] = [0, 0, 2]
        mujoco.mj_forward(model, data)
        gap = lowest(scene, data)
        for sink, touches in ((gap - 1e-6, False), (gap + 1e-6, True)):
            data.qpos[:3] = np.array([0, 0, 2]) - sink * scene.contact_points.normal
            mujoco.mj_forward(model, data)
            assert (data.ncon > 0) == touches


def test_a_model_sees_all_sides_of_a_box():
    box = '<geom type="box" size=".1 .2 .3" euler="30 40 50"/>'
    offset, _, there = contact_slots(load_scene(body(box, welded="")))
    assert there[1].all()
    np.testing.assert_allclose(offset[1].sum(0), 0, atol=1e-9)  # no four corners of a face, nor three of one
    assert np.linalg.matrix_rank(offset[1]) == 3


@pytest.mark.parametrize(
    "plane",
    [
        "",
        '<geom type="plane" size="9 9 1" contype="0" conaffinity="0"/>',
        '<geom type="box" size="9 9 .1"/>',
    ],
)
def test_without_a_plane_to_touch_there_are_none(plane):
    bare = '<geom size=".1"/>'
    scene = load_scene(body(bare, plane).replace("<geom size=", '<geom conaffinity="0" contype="2" size='))
    assert scene.contact_points is None


def test_systems():
    walker, cheetah = load_scene("walker2d"), load_scene("cheetah")
    assert set(walker.contact_points.node) == set(cheetah.contact_points.node) == set(range(1, 8))
    assert load_scene("swimmer6").contact_points is None
    np.testing.assert_allclose(walker.contact_points.normal, [0, 0, 1])


def test_print_shows_what_touches_the_plane():
    assert "  touch ground (plane): torso, bthigh, " in str(load_scene("cheetah"))
