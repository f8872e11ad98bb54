"""Contact pairs: which nodes can touch, by MuJoCo's rules and at random configurations."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_gn.scenes import load_scene
from torchrl_gn.scenes.contact_pairs import MOST_CANDIDATES, MOST_OF_ALL, MOST_PAIRS

from .. import zoo

CHAIN = """<mujoco><option gravity="0 0 0"/><default><geom type="capsule" size="0.02" {geom}/></default><worldbody>
<body name="a"><joint axis="0 1 0"/><geom name="a" fromto="0 0 0 0.2 0 0"/>
<body name="b" pos="0.2 0 0"><joint axis="0 1 0" {joint}/><geom name="b" fromto="0 0 0 0.2 0 0"/>
<body name="c" pos="0.2 0 0"><joint axis="0 1 0"/><geom name="c" fromto="0 0 0 0.1 0 0"/></body></body></body>
</worldbody>{more}</mujoco>"""


def chain(geom="", joint="", more=""):
    return load_scene(CHAIN.format(geom=geom, joint=joint, more=more))


def names(scene) -> set[str]:
    return {" - ".join(scene.node_names[node] for node in nodes) for nodes in scene.contact_pairs.nodes}


@pytest.mark.slow
def test_a_finger_meets_box_and_table():
    scene = zoo.load("pusher")
    assert names(scene) == {"world - mount", "world - link", "world - box", "mount - box", "link - box"}
    pairs = scene.contact_pairs
    counts = np.bincount(pairs.pair)
    assert counts.max() <= MOST_CANDIDATES and counts.sum() <= MOST_OF_ALL and (np.diff(counts) <= 0).all()
    assert "can touch: world - box, " in str(scene)
    assert scene.contact_pairs is pairs
    again = zoo.load("pusher").contact_pairs
    for field in ("nodes", "pair", "start", "direction", "center", "half_size", "radius"):
        np.testing.assert_array_equal(getattr(again, field), getattr(pairs, field))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {"a - c"}),  # neighbours never collide in MuJoCo
        ({"more": '<option><flag filterparent="disable"/></option>'}, {"a - b", "b - c", "a - c"}),
        ({"more": '<contact><exclude body1="c" body2="a"/></contact>'}, set()),
        ({"more": '<contact><pair geom1="a" geom2="b"/></contact>'}, {"a - b", "a - c"}),
        ({"geom": 'contype="1" conaffinity="2"'}, set()),
        (
            {"geom": 'contype="1" conaffinity="2"', "more": '<contact><pair geom1="a" geom2="c"/></contact>'},
            {"a - c"},
        ),
        ({"more": '<option><flag contact="disable"/></option>'}, set()),
    ],
)
def test_only_those_that_may_collide(changes, expected):
    assert names(chain(**changes)) == expected


def test_only_those_that_come_near():
    assert names(chain(joint='limited="true" range="-170 170"')) == {"a - c"}
    assert names(chain(joint='limited="true" range="-10 10"')) == set()


def test_planar_boxes_have_one_candidate_for_two_corners_behind_each_other():
    text = """<mujoco><worldbody><body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <joint axis="0 1 0"/><geom type="box" size="0.1 0.2 0.05" pos="0.1 0 0.3" euler="0 20 0"/></body>
    <geom type="box" size="5 1 0.1"/></worldbody></mujoco>"""
    pairs = load_scene(text).contact_pairs
    assert len(pairs.pair) == 4
    np.testing.assert_allclose(pairs.start[:, 1], 0, atol=1e-12)


def test_a_plane_beside_that_of_the_contact_points_and_what_these_lack():
    text = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 1"><freejoint/>{}</body>
    {}</worldbody></mujoco>"""
    ball, drum = '<geom size="0.1"/>', '<geom type="cylinder" size="0.1 0.2"/>'
    wall = '<geom type="plane" size="1 1 1" pos="2 0 0" zaxis="-1 0 0"/>'
    assert len(load_scene(text.format(ball, "")).contact_pairs.nodes) == 0
    assert len(load_scene(text.format(drum, "")).contact_pairs.pair) == 1 + 2  # a segment and its ends
    pairs = load_scene(text.format(ball, wall)).contact_pairs
    assert len(pairs.pair) == 1
    surface = pairs.center[0] + pairs.rotation[0, :, 2] * pairs.half_size[0, 2]
    np.testing.assert_allclose(surface, [2, 0, 0], atol=1e-9)


def test_feet_find_a_wide_floor_of_boxes():
    step = '<geom type="box" size="9 9 0.1" pos="0 0 {}"/>'
    leg = '<body name="leg"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/></body>'
    body = f'<body name="body" pos="0 0 1"><freejoint/><geom type="box" size="0.3 0.2 0.1"/>{leg}</body>'
    scene = load_scene(f"<mujoco><worldbody>{step.format(0)}{body}</worldbody></mujoco>")
    assert names(scene) == {"world - body", "world - leg"}
    assert sorted(np.bincount(scene.contact_pairs.pair)) == [3, 8]


def test_height_fields_are_named():
    scene = zoo.load("everything")
    assert scene.contact_pairs.ignored == ("ground",)
    # Features show where bodies touch it; but not where it moves.
    assert "no contact features of ground" not in str(scene)
    hill = '<asset><hfield name="h" nrow="2" ncol="2" size="1 1 1 .1" elevation="0 1 0 1"/></asset>'
    moving = '<body><joint type="slide" axis="0 0 1"/><geom name="hill" type="hfield" hfield="h"/></body>'
    ball = '<body pos="0 0 3"><freejoint/><geom size=".1"/></body>'
    shown = str(load_scene(f"<mujoco>{hill}<worldbody>{moving}{ball}</worldbody></mujoco>"))
    assert shown.endswith("no contact features of hill")


@pytest.mark.slow
def test_the_most_frequent_pairs_are_kept():
    balls = "".join(f'<body pos="0 0 {i}"><freejoint/><geom size="0.1"/></body>' for i in range(9))
    scene = load_scene(f"<mujoco><worldbody>{balls}</worldbody></mujoco>")
    assert len(scene.contact_pairs.nodes) == MOST_PAIRS and scene.contact_pairs.left_out == 36 - MOST_PAIRS
    assert "12 less frequent pairs that are left out" in str(scene)


def test_the_paper_s_systems():
    found = {name: names(load_scene(name)) for name in ("pendulum", "cartpole", "acrobot", "swimmer6", "walker2d")}
    assert not any(found.values())  # their geoms' masks let them touch the floor alone, if anything
    assert names(load_scene("cheetah")) == {"torso - bfoot", "torso - bshin", "bthigh - bfoot", "torso - ffoot"}


@pytest.mark.slow
def test_print_does_not_look_for_the_pairs_of_a_large_scene():
    balls = "".join(
        f'<body pos="{x} 0 1"><freejoint/><geom size="0.05"/></body>' for x in range(33)
    )  # 33 * 32 / 2 = 528 pairs
    scene = load_scene(f"<mujoco><worldbody>{balls}</worldbody></mujoco>")
    assert "528 pairs of geoms may collide; scene.contact_pairs finds which" in str(scene)
    assert "contact_pairs" not in vars(scene)
    assert len(scene.contact_pairs.nodes) > 0 and "can touch: " in str(scene)


@pytest.mark.parametrize(
    ("vertices", "masks"),
    [("0 0 0 .2 0 0 .2 .2 0 0 .2 0", 'contype="0" conaffinity="0"'), ("0 0 0 .2 0 0 .2 .2 0 0 .2 0.1", "")],
)
def test_flat_meshes(vertices, masks):
    """A logo lies on a table: a flat mesh has no volume, and a visual mesh has no contacts."""
    scene = load_scene(f"""<mujoco>
      <asset><mesh name="logo" inertia="shell" vertex="{vertices}" face="0 1 2 0 2 3"/></asset>
      <worldbody><geom type="box" size=".5 .5 .05"/><geom type="mesh" mesh="logo" pos="0 0 .051" {masks}/>
      <body name="ball" pos="0 0 .5"><freejoint/><geom size=".1"/></body></worldbody></mujoco>""")
    assert names(scene) == {"world - ball"}
    assert "can touch: world - ball" in str(scene)


def test_bodies_are_moved_near_what_they_can_touch():
    """Among many pictures a body still finds the only box that it can stand on."""
    pictures = "".join(f'<geom size=".01" pos="{index} 0 0" contype="0" conaffinity="0"/>' for index in range(300))
    scene = load_scene(f"""<mujoco><worldbody><geom type="box" size=".1 .1 .1" pos="300 5 0"/>{pictures}
      <body name="ball" pos="0 0 9"><freejoint/><geom size=".1"/></body></worldbody></mujoco>""")
    assert names(scene) == {"world - ball"}


@pytest.mark.parametrize("limits", ["", 'range="-10000 10000"'])
def test_slides_whose_limits_bound_nothing_meet_others(limits):
    body = f'<joint type="slide" axis="1 0 0" {limits}/><joint type="slide" axis="0 1 0" {limits}/><geom size=".1"/>'
    scene = load_scene(
        f'<mujoco><worldbody><body name="a">{body}</body><body name="b" pos="1 0 0">{body}</body></worldbody></mujoco>'
    )
    assert names(scene) == {"a - b"}


def test_pairs_that_meet_far_from_all_corners_have_candidates():
    """Two bars that cross."""
    scene = load_scene(
        """<mujoco><worldbody>
        <body name="long"><joint axis="0 0 1" range="-20 20"/><geom type="box" size="1 .05 .05"/></body>
        <body name="across" pos="0 0 .12"><joint type="slide" axis="0 0 1" range="-.1 .1"/>
          <joint axis="1 0 0" range="-5 5"/>
          <geom type="box" size=".05 1 .05"/></body>
        <body name="ball" pos="0 0 .3"><joint type="slide" axis="0 0 1" range="-.1 .1"/><geom size=".05"/></body>
        </worldbody></mujoco>"""
    )
    assert {"long - across", "across - ball"} <= names(scene)
    assert np.bincount(scene.contact_pairs.pair, minlength=len(scene.contact_pairs.nodes)).min() > 0
