"""Meshes of geoms: volumes, bounds, orientation and colours as MuJoCo has them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import load_scene
from torchrl_gn.viewer.meshes import geom_mesh, geom_rgba, scene_parts, visible_geoms

CUBE = "-1 -1 -1  1 -1 -1  1 1 -1  -1 1 -1  -1 -1 1  1 -1 1  1 1 1  -1 1 1"
SHAPES = {
    "sphere": ('<geom type="sphere" size=".3"/>', 4 / 3 * np.pi * 0.3**3),
    "capsule": ('<geom type="capsule" size=".2 .5"/>', np.pi * 0.2**2 * (1.0 + 4 / 3 * 0.2)),
    "ellipsoid": ('<geom type="ellipsoid" size=".1 .2 .4"/>', 4 / 3 * np.pi * 0.1 * 0.2 * 0.4),
    "cylinder": ('<geom type="cylinder" size=".3 .1"/>', np.pi * 0.3**2 * 0.2),
    "box": ('<geom type="box" size=".1 .2 .3"/>', 8 * 0.1 * 0.2 * 0.3),
    "mesh": ('<geom type="mesh" mesh="cube"/>', 8 * 0.1 * 0.2 * 0.3),
    "hfield": ('<geom type="hfield" hfield="hills"/>', None),
}
MODEL = f"""<mujoco><asset><mesh name="cube" vertex="{CUBE}" scale=".1 .2 .3"/>
  <hfield name="hills" nrow="3" ncol="4" size="1 2 .5 .25" elevation="0 1 0 0  1 1 0 1  0 0 1 1"/>
  <texture name="red" type="2d" builtin="flat" rgb1="1 .5 0" width="4" height="4"/>
  <material name="plain" rgba=".2 .4 .6 .8"/><material name="textured" texture="red" rgba=".5 1 1 1"/></asset>
  <worldbody>%s</worldbody></mujoco>"""


def compiled(geoms: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL % geoms)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume by the divergence theorem: positive if the faces are counter-clockwise from outside."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def boundary(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Sum of the faces' area vectors: zero for closed surfaces."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    return np.cross(b - a, c - a).sum(0) / 2


@pytest.mark.parametrize("kind", SHAPES)
def test_meshes_have_mujocos_bounds_and_volumes(kind):
    xml, expected = SHAPES[kind]
    model = compiled(xml)
    vertices, faces = geom_mesh(model, 0)
    center, half = model.geom_aabb[0].reshape(2, 3)
    np.testing.assert_allclose(vertices.min(0), center - half, atol=1e-6)
    np.testing.assert_allclose(vertices.max(0), center + half, atol=1e-6)
    np.testing.assert_allclose(boundary(vertices, faces), 0, atol=1e-9)
    assert faces.min() == 0 and faces.max() == len(vertices) - 1
    if expected is None:
        assert volume(vertices, faces) > 0  # its surface: test_height_fields_rise_where_mujocos_rays_meet_them
    elif kind in ("box", "mesh"):
        assert volume(vertices, faces) == pytest.approx(expected, rel=1e-6)
    else:  # inscribed polyhedra: below, but not by much
        assert 0.96 * expected < volume(vertices, faces) < expected


def test_height_fields_rise_where_mujocos_rays_meet_them():
    model = compiled(SHAPES["hfield"][0])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    vertices, faces = geom_mesh(model, 0)
    up = np.cross(*np.diff(vertices[faces], axis=1).swapaxes(0, 1))[:, 2]
    tops = vertices[faces[up > 1e-9]].mean(1)  # centres of the surface's triangles
    assert len(tops) == 2 * 2 * 3 + 0
    for top in tops:
        met = mujoco.mj_ray(model, data, top + [0, 0, 5], np.array([0.0, 0, -1]), None, 1, -1, np.zeros(1, np.int32))
        assert 5 - met == pytest.approx(0, abs=1e-6)


def test_planes_have_their_size_and_face_up():
    model = compiled('<geom type="plane" size="2 3 1"/><geom type="plane" size="0 3 1"/>')
    vertices, faces = geom_mesh(model, 0)
    assert np.ptp(vertices, axis=0).tolist() == [4, 6, 0]
    assert boundary(vertices, faces) == pytest.approx([0, 0, 24])
    assert np.ptp(geom_mesh(model, 1)[0], axis=0)[0] > 6, "a plane without a size is endless"


def test_creases_of_meshes_stay_sharp():
    vertices, faces = geom_mesh(compiled(SHAPES["mesh"][0]), 0)
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    for vertex in range(len(vertices)):
        around = normals[(faces == vertex).any(1)]
        assert (around @ around.T > 0.99).all()


def test_colours_are_the_geoms_else_the_materials():
    model = compiled(
        '<geom size=".1"/><geom size=".1" material="plain"/><geom size=".1" material="plain" rgba="1 0 0 1"/>'
        '<geom size=".1" material="textured"/>'
    )
    colors = [geom_rgba(model, geom).tolist() for geom in range(4)]
    expected = [[0.5, 0.5, 0.5, 1], [0.2, 0.4, 0.6, 0.8], [1, 0, 0, 1], [0.5, 0.5, 0, 1]]
    np.testing.assert_allclose(colors, expected, atol=0.01)


def test_collision_shapes_and_transparent_geoms_are_hidden_unless_there_are_no_others():
    model = compiled('<geom size=".1"/><geom size=".1" group="3"/><geom size=".1" rgba="1 1 1 0"/>')
    assert visible_geoms(model) == [0]
    assert visible_geoms(compiled('<geom size=".1" group="3"/>')) == [0]


def test_parts_stand_where_mujoco_has_the_geoms():
    scene = load_scene("cheetah")
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    by_node = {}
    for part in scene_parts(scene):
        by_node.setdefault(part.node, []).append(part.vertices)
    assert set(by_node) == set(range(1, scene.num_nodes)), "the floor is the ground, no part"
    for node, vertices in by_node.items():
        body = scene.body[node]
        world = np.concatenate(vertices) @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for geom in np.flatnonzero(scene.model.geom_bodyid == body):
            points, _ = geom_mesh(scene.model, geom)
            points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
        np.testing.assert_allclose([world.min(0), world.max(0)], [low, high], atol=1e-9)


def test_a_target_of_the_suite_is_not_drawn_where_no_episode_has_it():
    pytest.importorskip("dm_control")
    scene = load_scene("suite:reacher/easy")
    size = scene.model.geom("target").size[0]
    boxes = [part for part in scene_parts(scene) if part.node == 0 and np.ptp(part.vertices, axis=0).max() < 3 * size]
    assert "target" in [scene.model.geom(geom).name for geom in visible_geoms(scene.model)] and not boxes
