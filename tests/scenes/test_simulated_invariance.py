"""A scene loses invariances that simulations refute, and keeps the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.scenes.invariance import translation_invariant
from torchrl_gn.scenes.simulated_invariance import Motion, changes_dynamics, confirmed
from torchrl_gn.scenes.topology import topology
from torchrl_gn.scenes.yaw_frame import YawFrame, find_yaw_frame

from .. import zoo

BALL = '<geom name="ball" type="sphere" size=".1" pos=".05 0 0"/>'
FLOOR = '<geom name="floor" type="plane" size="1 1 .1"/>'


def free(inside: str = BALL, height: float = 0.08) -> str:
    return f'<body name="a" pos="0 0 {height}"><freejoint/>{inside}</body>'


# What the rules overlook: elements, what is left of translation, whether the yaw frame is exact (None: there is none).
OVERLOOKED = {
    "a tendon's side site in the world": (
        '<worldbody><site name="w" pos=".3 .2 .5"/>'
        + free(
            BALL + '<site name="s" pos=".3 0 0"/><geom name="c" type="cylinder" size=".05 .2" pos=".1 .1 0"/>', height=1
        )
        + f'<body name="b" pos="1 0 1"><freejoint/>{BALL.replace("ball", "other")}<site name="t"/></body></worldbody>'
        '<tendon><spatial stiffness="100"><site site="s"/><geom geom="c" sidesite="w"/><site site="t"/></spatial>'
        "</tendon>",
        [False, False, False],
        None,
    ),
    "a pair that rolls more easily one way": (
        f'<option cone="elliptic"/><worldbody>{FLOOR}{free()}</worldbody><contact><pair geom1="floor" geom2="ball"'
        ' condim="6" friction="1 1 .005 .1 .0001"/></contact>',
        [True, True, False],
        False,
    ),
    "a capsule that always stands upright, on friction pyramids": (
        f'<worldbody>{FLOOR}<body pos="0 0 .29"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
        '<joint type="slide" axis="0 0 1"/><joint axis="0 0 1"/><geom type="capsule" size=".1 .2"/></body></worldbody>',
        [True, True, False],
        False,
    ),
    "friction of all contacts that is larger one way": (
        '<option cone="elliptic" o_friction="1 .1 .005 .0001 .0001"><flag override="enable"/></option>'
        f"<worldbody>{FLOOR}{free()}</worldbody>",
        [True, True, False],
        False,
    ),
}
# What is claimed of scenes that are not so: translation, and whether a yaw frame is exact.
FALSE = {
    "gravity along x": ('<option gravity="-9.81 0 0"/><worldbody>' + free(height=1) + "</worldbody>", None, True),
    "wind": ('<option density="100" wind="3 0 0"/><worldbody>' + free(height=1) + "</worldbody>", None, True),
    "a spring to the world": (
        f'<worldbody><body pos="0 0 1"><joint type="free" stiffness="3"/>{BALL}</body></worldbody>',
        [True, False, False],
        None,
    ),
    "a wall": (f'<worldbody><geom type="plane" size="1 1 .1" euler="0 90 0"/>{free()}</worldbody>', [True] * 3, None),
    "a tilted plane": (f'<worldbody><geom type="plane" size="1 1 .1" euler="0 20 0"/>{free()}</worldbody>', None, True),
    "friction pyramids": (f"<worldbody>{FLOOR}{free()}</worldbody>", None, True),
    "a slow sideways damper": (
        '<worldbody><body pos="0 0 1"><joint type="slide" axis="1 0 0" damping="1"/><joint type="slide" axis="0 1 0"/>'
        f"<joint axis='0 0 1'/>{BALL}</body></worldbody>",
        None,
        True,
    ),
}


def mjcf(elements: str) -> str:
    return f"<mujoco>{elements}</mujoco>"


@pytest.mark.parametrize("name", [name for name in OVERLOOKED if "tendon" not in name])
def test_bodies_that_are_high_above_a_plane_touch_it_too(name):
    """Where no pose near the reference does."""
    elements, invariant, exact = OVERLOOKED[name]
    scene = load_scene(mjcf(elements.replace('pos="0 0 0.', 'pos="0 0 8.').replace('pos="0 0 .', 'pos="0 0 8.')))
    assert scene.reference_state[1, 2] > 8
    assert scene.translation_invariant.tolist() == invariant
    assert scene.yaw_frame is not None and scene.yaw_frame.exact == exact


def test_overridden_friction_that_is_larger_one_way_turns_no_colliding_bodies():
    bodies = free('<geom size=".1"/>', 1) + free('<geom size=".1"/>', 2).replace('"a"', '"b"')
    option = '<option gravity="0 0 0" cone="elliptic" o_friction="1 {} .1 .1 .1"><flag override="enable"/></option>'
    for friction, exact in (("1", True), (".1", False)):
        frame = load_scene(mjcf(f"{option.format(friction)}<worldbody>{bodies}</worldbody>")).yaw_frame
        assert frame is not None and frame.exact == exact


@pytest.mark.parametrize("name", OVERLOOKED)
def test_simulations_deny_what_rules_overlook(name):
    elements, invariant, exact = OVERLOOKED[name]
    scene = load_scene(mjcf(elements), name="scene")
    assert scene.translation_invariant.tolist() == invariant
    assert (None if scene.yaw_frame is None else scene.yaw_frame.exact) == exact


@pytest.mark.parametrize("name", FALSE)
def test_false_claims_are_denied(name):
    elements, claimed, exact = FALSE[name]
    scene = load_scene(mjcf(elements), name="scene")
    claims = np.array(scene.translation_invariant if claimed is None else claimed)
    frame = None if exact is None else YawFrame(exact, 1, 2, np.zeros(3), np.array([1.0, 0, 0, 0]))
    kept, yaw_frame = confirmed(scene.model, topology(scene.model), claims, frame)
    assert kept.tolist() == scene.translation_invariant.tolist()
    if exact:
        assert yaw_frame is None or not yaw_frame.exact
        assert (yaw_frame is None) == (scene.yaw_frame is None or scene.yaw_frame.axis != 2)


def test_a_false_claim_of_every_axis_leaves_the_true_one():
    """Gravity leaves the rotation about z; without it and the hinge's anchor, every rotation is left."""
    free = '<body name="body"><freejoint/><geom size=".1 .2 .3" type="ellipsoid"/></body>'
    for gravity, axis in (("0 0 -9", 2), ("0 9 0", 1), ("9 0 0", 0), ("0 0 0", None)):
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option gravity="{gravity}"/><worldbody>{free}</worldbody></mujoco>'
        )
        claim = YawFrame(True, 1, None, np.zeros(3), np.array([1.0, 0, 0, 0]))
        frame = confirmed(model, topology(model), np.ones(3, bool), claim)[1]
        assert frame is not None and frame.exact and frame.axis == axis


SYSTEMS = ("pendulum", "cartpole", "acrobot", "swimmer3", "swimmer6", "cheetah", "walker2d", "jaco")
FILES = sorted(path.stem for path in Path(zoo.__file__).parent.glob("*.xml"))


@pytest.mark.parametrize("name", [*SYSTEMS, *FILES])
def test_what_holds_is_kept(name):
    scene = load_scene(name) if name in SYSTEMS else zoo.load(name)
    scene = replace(scene, **by_rules(scene))
    kept, frame = confirmed(scene.model, topology(scene.model), scene.translation_invariant, scene.yaw_frame)
    assert kept.tolist() == scene.translation_invariant.tolist() and frame is scene.yaw_frame


def by_rules(scene: Scene) -> dict:
    graph, data = topology(scene.model), mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    frame = find_yaw_frame(scene.model, data, graph, scene.movable[:, :12])
    return {"translation_invariant": translation_invariant(scene.model, data, graph), "yaw_frame": frame}


def test_models_and_random_numbers_stay_as_they_were():
    scene = load_scene("swimmer3")
    before, drawn = scene.model.opt.iterations, repr(np.random.get_state())
    assert not changes_dynamics(scene.model, topology(scene.model), Motion(np.array([1.7, 0, 0])), contacts=True)
    assert changes_dynamics(scene.model, topology(scene.model), Motion(np.zeros(3), 0, 0.8), contacts=False)
    assert scene.model.opt.iterations == before and repr(np.random.get_state()) == drawn
