"""Points and surfaces of contacts with the world against MuJoCo's own contacts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import load_scene

from .. import zoo

FLOOR = '<geom name="floor" type="plane" size="9 9 1"/>'
STEP = '<geom name="step" type="box" size=".5 1 .1" pos="1 0 .1"/>'
CUBE = '<body pos="0 0 1"><freejoint/><geom name="cube" type="box" size=".1 .1 .1"{}/></body>'


def scene(world: str = FLOOR + STEP, body: str = CUBE.format(""), more: str = ""):
    return load_scene(f"<mujoco><worldbody>{world}{body}</worldbody>{more}</mujoco>")


def names(found) -> list[str]:
    return [found.model.geom(surface.geom).name for surface in found.world_contacts.surfaces]


def test_what_mujoco_filters_cannot_touch():
    assert names(scene()) == ["floor", "step"]
    assert names(scene(FLOOR + STEP.replace("size", 'contype="0" conaffinity="0" size'))) == ["floor"]
    excluded = '<contact><exclude body1="{}" body2="cube"/></contact>'
    named = CUBE.format("").replace("<body", '<body name="cube"')
    on_table = FLOOR + f'<body name="table">{STEP}</body>'
    assert names(scene(on_table, named)) == ["floor", "step"]
    assert names(scene(on_table, named, excluded.format("table"))) == ["floor"]
    deaf = CUBE.format(' contype="0" conaffinity="0"')
    assert not len(scene(body=deaf).world_contacts.node)
    pair = '<contact><pair geom1="cube" geom2="step"/></contact>'
    assert names(scene(body=deaf, more=pair)) == ["step"]
    both = scene(body=deaf + '<body pos="0 0 3"><freejoint/><geom size=".1"/></body>', more=pair).world_contacts
    assert both.touches.sum(1).tolist() == [1] * 8 + [2]


def test_a_flat_height_field_is_a_box():
    field = '<asset><hfield name="h" nrow="3" ncol="3" size="2 1 .3 .2" elevation="{}"/></asset>'
    moves = 'surfacevel=".1 .2 .3 .4 .5 .6"' * hasattr(mujoco.MjModel, "geom_surfacevel")  # since MuJoCo 3.11
    place = f'<geom type="hfield" hfield="h" pos="1 2 3" axisangle="1 0 0 30" {moves}/>'
    flat, hilly = (scene(place, more=field.format(each)) for each in ("0 0 0 0 0 0 0 0 0", "0 1 0 1 0 1 0 0 1"))
    (box,), (heights,) = flat.world_contacts.surfaces, hilly.world_contacts.surfaces
    assert (box.kind, heights.kind) == ("box", "heights") and box.shape is None
    turned, down = heights.constants[3:12].reshape(3, 3), np.array([0, 0, -0.1])  # half of the depth below the field
    np.testing.assert_allclose(box.constants[:3], heights.constants[:3] + turned @ down, atol=1e-12)
    np.testing.assert_allclose(box.constants[12:16], [2, 1, 0.1, 0], atol=1e-12)
    linear, angular = heights.constants[16:19], heights.constants[19:]
    np.testing.assert_allclose(box.constants[16:], [*(linear + np.cross(angular, down)), *angular], atol=1e-12)


OVERRIDE = """<option o_margin="0.03" o_friction=".7 .7 .01 .01 .01"><flag override="enable"/></option>"""


def test_a_base_that_carries_a_robot_is_no_surface():
    link = '<body pos="0 0 .3">{}<geom size=".05" pos=".2 0 0"/></body>'
    arm = f'<body name="base"><geom name="foot" size=".1"/>{link}</body>'
    found = scene(FLOOR, arm.format('<joint axis="0 1 0"/>') + CUBE.format(""))
    assert names(found) == ["floor", "foot"]
    contacts = found.world_contacts
    assert contacts.touches[contacts.node == 1].tolist() == [[True, False]]  # the arm itself
    assert contacts.touches[contacts.node == 2].all()  # the cube


def test_a_floor_on_the_body_that_carries_all_is_ground():
    box = """<body name="box" pos="0 0 .5"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <joint axis="0 1 0"/><geom name="box" type="box" size=".1 .07 .05"/></body>"""
    floor = '<geom name="floor" type="plane" size="1 1 1"/>'
    plain, within = (
        load_scene(f"<mujoco><worldbody>{each}</worldbody></mujoco>")
        for each in (floor + box, f'<body name="lab">{floor}{box}</body>')
    )
    assert names(within) == names(plain) == ["floor"]
    np.testing.assert_array_equal(within.world_contacts.points, plain.world_contacts.points)
    assert within.world_contacts.touches.all() and "touch floor (plane): box" in str(within)


@pytest.mark.parametrize("option", ["", OVERRIDE])
@pytest.mark.parametrize(
    ("floor", "cube", "pair"),
    [
        ("", "", ""),
        (' margin=".01" gap=".004" friction=".3"', ' margin=".02" gap=".003" friction=".6"', ""),
        (' friction=".9" priority="1"', ' friction="2"', ""),
        (' condim="1"', ' condim="1"', ""),
        ("", "", ' margin=".02" gap=".005" friction=".4 .4 .1 .1 .1"'),
        ("", "", ' condim="1"'),
    ],
)
def test_friction_and_margin_are_those_of_the_contact(floor, cube, pair, option):
    world = FLOOR.replace("/>", f"{floor}/>")
    explicit = f'<contact><pair geom1="cube" geom2="floor"{pair}/></contact>' if pair else ""
    found = scene(world, CUBE.format(cube), explicit + option)
    data = mujoco.MjData(found.model)
    data.qpos[2] = 0.1
    mujoco.mj_forward(found.model, data)
    contact = data.contact[0]
    friction = contact.friction[0] if contact.dim > 1 else 0
    np.testing.assert_allclose(found.world_contacts.pairs[0, 0], [friction, contact.includemargin], atol=1e-12)


def test_nodes_have_at_most_eight_points_far_from_each_other():
    many = '<body pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3"/><geom type="box" size=".05 .1 .15"/></body>'
    found = scene(FLOOR, many)
    contacts = found.world_contacts
    assert contacts.slot.tolist() == list(range(8)) and contacts.reduced == ("body1",)
    np.testing.assert_allclose(np.abs(contacts.points[:, :3]), [[0.1, 0.2, 0.3]] * 8)
    assert "more than 8 contact points, of which some are shown: body1" in str(found)


def test_of_many_surfaces_the_largest_are_kept():
    stairs = "".join(f'<geom name="s{i}" type="box" size="{0.1 + 0.01 * i} .1 .1" pos="{i} 0 0"/>' for i in range(14))
    found = scene(stairs + FLOOR)
    assert names(found) == ["floor", *(f"s{index}" for index in range(3, 14))]
    assert found.world_contacts.ignored == ("s0", "s1", "s2")
    assert "surfaces without features: s0, s1, s2" in str(found)


def test_hulls_have_the_faces_of_their_mesh():
    cube = "-1 -1 -1 1 -1 -1 -1 1 -1 -1 -1 1 1 1 -1 1 -1 1 -1 1 1 1 1 1 0 0 0"
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(60, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    text = " ".join(f"{number:.6f}" for number in ball.ravel())
    asset = f'<asset><mesh name="cube" vertex="{cube}"/><mesh name="ball" vertex="{text}"/></asset>'
    world = '<geom name="c" type="mesh" mesh="cube" pos="1 2 3"/><geom name="b" type="mesh" mesh="ball" pos="5 0 0"/>'
    mesh = '<body pos="0 0 9"><freejoint/><geom type="mesh" mesh="ball"/></body>'
    found = scene(world, mesh, asset)
    first, second = (found.world_contacts.surfaces[index] for index in (0, 1))
    assert first.shape is not None and second.shape is not None
    assert sorted(map(tuple, first.shape.round(6) + 0.0)) == sorted(
        (*side, 1.0) for side in map(tuple, np.concatenate((np.eye(3), -np.eye(3))))
    )
    assert len(second.shape) == 32 and second.reduced and not first.reduced
    assert "hulls of fewer faces than MuJoCo's: b" in str(found)
    # All vertices are within, and each face touches some.
    model = found.model
    vertices = model.mesh_vert[model.mesh_vertadr[1] :][: model.mesh_vertnum[1]]
    above = vertices @ second.shape[:, :3].T - second.shape[:, 3]
    np.testing.assert_allclose(above.max(0), 0, atol=1e-5)
    points = found.world_contacts.points
    assert (
        len(points) == 8
        and np.linalg.norm(points[:, None, :3] - points[None, :, :3], axis=-1)[~np.eye(8, dtype=bool)].min() > 0.7
    )


def test_print_shows_what_touches_which_surfaces():
    text = str(zoo.load("everything"))
    assert "  touch floor (plane), " in text and "(heights): " in text
    assert "touch " not in str(load_scene("swimmer3"))
