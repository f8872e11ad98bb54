"""Variants of any scene: numbers of its MuJoCo model multiplied, which simulations and models see."""

from __future__ import annotations

import json
import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator, collect_trajectories
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.scenes import PhysicalParameters, load_scene, scene_from_description, with_factors
from torchrl_gn.scenes.scaled import find_numbers

from ..sizes import SMALL

ARM = """<mujoco><worldbody><body name="upper"><joint name="shoulder" axis="0 1 0" damping=".3"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/><body name="lower" pos="0 0 -.4">
  <joint name="elbow" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>
  </body></body></worldbody><actuator><motor joint="shoulder" gear="2" ctrlrange="-1 1"/></actuator></mujoco>"""
FORGED = (["body_mass", [99], 2.0], ["body_mass", [1], math.inf], ["names", [0], 2.0], ["body_mass", [1], -1.0])


@pytest.fixture(scope="module")
def arm():
    return load_scene(ARM, name="arm")


def masses(scene) -> np.ndarray:
    return scene.static.nodes[:, scene.static.node_names.index("mass")]


def test_models_and_simulations_read_the_new_numbers(arm):
    heavy = with_factors(arm, {"body_mass": ["lower"], "dof_damping": ["shoulder"]}, [3.0, 0.5])
    np.testing.assert_allclose(heavy.model.body_mass, arm.model.body_mass * [1, 1, 3])
    np.testing.assert_allclose(masses(heavy), masses(arm) * [1, 1, 3])
    np.testing.assert_allclose(heavy.model.body_inertia[2], 3 * arm.model.body_inertia[2])
    names, before, after = PhysicalParameters._fields, PhysicalParameters.of(arm), PhysicalParameters.of(heavy)
    changed = {name for name, a, b in zip(names, before, after, strict=True) if not torch.equal(a, b)}
    assert changed == {"nodes", "edges"}  # mass and damping
    start, actions = np.zeros((1, arm.physics_size)), np.ones((1, 5, 1))
    ends = [Simulator(each).rollout(start, actions)["state"][0, -1] for each in (arm, heavy)]
    assert (ends[0] - ends[1]).abs().max() > 1e-3
    twice = with_factors(heavy, {"body_mass": ["lower"]}, [2.0])
    assert twice.model.body_mass[2] == pytest.approx(6 * arm.model.body_mass[2])


def test_names_in_a_tuple_share_a_factor(arm):
    both = with_factors(arm, {"body_mass": [("upper", "lower")], "dof_damping": None}, [2.0, 3.0])
    np.testing.assert_allclose(both.model.body_mass, 2 * arm.model.body_mass)
    np.testing.assert_allclose(both.model.body_inertia, 2 * arm.model.body_inertia)
    names = find_numbers(arm.model, {"body_mass": [("upper", "lower")], "actuator_gear": [arm.actuator_names]})[0]
    assert names == ("body_mass upper and 1 more", "actuator_gear actuator0")
    assert scene_from_description(both.description()).fingerprint() == both.fingerprint()
    with pytest.raises(ValueError, match="body_mass: 'lower' is named twice"):
        find_numbers(arm.model, {"body_mass": ["lower", ("upper", "lower")]})
    with pytest.raises(ValueError, match="dof_damping of 'elbow' is 0"):
        find_numbers(arm.model, {"dof_damping": [("shoulder", "elbow")]})


def test_descriptions_hold_the_factors(arm, recwarn):
    heavy = with_factors(with_factors(arm, {"body_mass": None}, [2.0, 3.0]), {"actuator_gear": None}, [0.5])
    again = scene_from_description(json.loads(json.dumps(heavy.description())))
    assert again.fingerprint() == heavy.fingerprint() != arm.fingerprint()
    np.testing.assert_array_equal(again.static.nodes, heavy.static.nodes)
    slippery = with_factors(load_scene("cheetah"), {"geom_friction": ["ground"]}, [0.5])
    assert scene_from_description(slippery.description()).fingerprint() == slippery.fingerprint()
    assert not recwarn.list


@pytest.mark.parametrize("factor", FORGED)
def test_forged_descriptions_are_refused(arm, factor):
    with pytest.raises(ValueError, match="body_mass has 3 rows|is not an array of mjModel"):
        scene_from_description({**arm.description(), "factors": [factor]})


@pytest.mark.parametrize(
    ("numbers", "factors", "message"),
    [
        ({"body_mass": ["hand"]}, [2.0], "the model has no 'hand'"),
        ({"actuator_delay": None}, [2.0], "actuator_delay must be whole physics steps"),
        ({"body_weight": None}, [2.0], "'body_weight' is not an array"),
        ({"body_mass": None}, [2.0], r"There are 2 numbers, so factors must be \[2\], got \[1\]"),
        ({"body_mass": ["lower"]}, [0.0], "is not above 0"),
        ({"body_mass": ["lower"]}, [math.nan], "is not above 0"),
        ({"dof_frictionloss": ["elbow"]}, [2.0], "is 0, so a factor has no effect"),
    ],
)
def test_what_does_not_fit_is_refused(arm, numbers, factors, message):
    with pytest.raises(ValueError, match=message):
        with_factors(arm, numbers, factors)


@pytest.mark.parametrize("numbers", ["dof_damping", ["dof_damping"]])
def test_numbers_without_names_of_elements_are_refused(arm, numbers):
    with pytest.raises(TypeError, match=r"must be a dictionary, such as .*; got .*dof_damping"):
        with_factors(arm, numbers, [2.0])


IDLE = """<mujoco><option><flag damper="disable"/></option>
  <asset><mesh name="tet" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/></asset><worldbody>
  <geom name="floor" type="plane" size="9 9 1"/><body name="post" pos="1 1 0"><geom name="pole" size=".1"/></body>
  <body name="b" pos="0 0 1"><joint name="x" type="slide" pos="1 0 0" damping="1"/><joint name="y" axis="0 1 0"/>
  <geom name="tet" type="mesh" mesh="tet"/><geom name="look" size=".1" pos=".1 0 0" contype="0" conaffinity="0"/>
  <geom name="ball" size=".1"/></body></worldbody>
  <tendon><fixed name="t" limited="false" range="-1 1"><joint joint="y" coef="1"/></fixed></tendon>
  <actuator><motor name="m" joint="y" ctrlrange="-1 1" forcelimited="false" forcerange="-1 1"/></actuator></mujoco>"""
WITHOUT_EFFECT = {
    "geom_size": ("tet", "the shape of a mesh"),
    "geom_friction": ("look", "the geom touches nothing"),
    "geom_pos": ("look", "the geom touches nothing"),
    "geom_rbound": ("ball", "MuJoCo computes it from other numbers"),
    "geom_rgba": ("ball", "physics does not read it"),
    "body_quat": ("b", "is a direction"),
    "body_mass": ("post", "no joint moves the body"),
    "jnt_solref": ("y", "the joint has no limits"),
    "jnt_pos": ("x", "a free or slide joint has no anchor"),
    "dof_damping": ("x", "disableflags switch damper off"),
    "dof_solimp": ("y", "no friction loss"),
    "tendon_range": ("t", "the tendon has no limits"),
    "actuator_forcerange": ("m", "this range is not a limit"),
    "actuator_dynprm": ("m", "the actuator has no activation"),
}


@pytest.mark.parametrize("array", WITHOUT_EFFECT)
def test_numbers_without_effect_are_refused(array):
    name, why = WITHOUT_EFFECT[array]
    with pytest.raises(ValueError, match=why):
        with_factors(load_scene(IDLE), {array: [name]}, [2.0])


STILL = """<mujoco><option actuatorgroupdisable="2"><flag {flag}="disable"/></option><worldbody>
  <geom name="floor" type="plane" size="9 9 1"/><body name="free" pos="0 0 1" gravcomp=".5"><freejoint/>
  <geom name="ball" size=".1"/></body><body name="cart" pos="0 2 1"><joint name="x" type="slide" axis="1 0 0"/>
  <geom size=".1" pos=".1 0 0"/><body name="load" pos="0 0 .2"><geom size=".1"/><body name="arm">
  <joint name="y" axis="0 1 0"/><geom size=".1" pos=".1 0 0"/></body></body></body></worldbody>
  <actuator><adhesion name="stick" body="free" ctrlrange="0 1" gain="2"/>
  <intvelocity name="speed" joint="y" kp="1" ctrlrange="-1 1" actrange="-1 1"/>
  <motor name="off" joint="x" group="2" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("array", "name", "flag", "why"),
    [
        ("body_pos", "free", "limit", "a free joint places the body"),
        *((array, "cart", "limit", "no joint turns the body") for array in ("body_inertia", "body_ipos")),
        ("body_inertia", "load", "limit", "no joint turns the body"),
        ("body_inertia", "arm", "limit", None),
        ("body_inertia", "free", "limit", None),
        ("body_gravcomp", "free", "limit", None),
        ("body_gravcomp", "free", "gravity", "switch gravity off"),
        ("geom_size", "ball", "contact", "the geom touches nothing"),
        ("geom_friction", "ball", "constraint", "switch constraint off"),
        ("actuator_gear", "stick", "limit", "adhesion has no gear"),
        ("actuator_dynprm", "speed", "limit", "only integrates its control"),
        ("actuator_gear", "off", "limit", "switches the actuator's group off"),
    ],
)
def test_numbers_without_effect_are_refused_and_others_are_not(array, name, flag, why):
    scene = load_scene(STILL.format(flag=flag))
    if why is None:
        with_factors(scene, {array: [name]}, [2.0])
        return
    with pytest.raises(ValueError, match=why):
        with_factors(scene, {array: [name]}, [2.0])


def test_of_all_numbers_only_those_with_an_effect_count():
    scene = load_scene(IDLE)
    assert find_numbers(scene.model, {"geom_size": None})[0] == ("geom_size pole", "geom_size ball")
    assert find_numbers(scene.model, {"body_mass": None})[0] == ("body_mass b",)
    with pytest.raises(ValueError, match="are 0 or have no effect"):
        find_numbers(scene.model, {"dof_damping": None})


SIZES = {"sphere": [0.1], "capsule": [0.1, 0.2], "ellipsoid": [0.1, 0.2, 0.15], "cylinder": [0.1, 0.2]}
SIZES["box"] = [0.1, 0.2, 0.3]


@pytest.mark.parametrize("kind", SIZES)
def test_scaled_geoms_touch_what_those_of_a_file_touch(kind):
    def load(factor):
        size = " ".join(str(factor * number) for number in SIZES[kind])
        other = '<geom size=".01" pos="0 0 {}"/><geom size=".01" pos="0 .5 {}"/>'
        return load_scene(
            f"""<mujoco><worldbody><body name="a"><freejoint/><geom name="a" type="{kind}" size="{size}"/>
            {other.format(5, 5)}</body><body name="b" pos=".19 0 0"><freejoint/><geom name="b" size=".05"/>
            {other.format(-5, -5)}</body></worldbody></mujoco>"""
        )

    def touching(scene):
        data = mujoco.MjData(scene.model)
        mujoco.mj_forward(scene.model, data)
        return data.contact.dist.tolist()

    small, wide = load(1.0), load(2.0)
    scaled = with_factors(small, {"geom_size": ["a"]}, [2.0])
    assert touching(small) == [] and len(touching(wide)) == 1
    assert touching(scaled) == pytest.approx(touching(wide))
    assert scaled.model.geom_rbound == pytest.approx(wide.model.geom_rbound)


def test_trajectories_bring_the_variants_parameters(arm):
    variants = [with_factors(arm, {"body_mass": ["lower"]}, [factor]) for factor in (0.5, 1.0, 3.0)]
    data = collect_trajectories(variants, 6, 5, seed=0)
    bound = ForwardModel.for_scene(arm, parameters="scene", **SMALL).bind(arm, parameters_key="parameters")
    given = torch.stack([bound.parameters_of(each) for each in variants])
    for name, value in given.items():
        torch.testing.assert_close(data["parameters"][:3][name], value)


VARIED = """<mujoco><worldbody>
  <body name="arm" pos="0 0 1"><joint name="arm" axis="0 1 0" pos="0 0 .02" {force}/>
    <geom name="arm" type="capsule" fromto="0 0 0 .3 0 0" size=".03"/><site name="tip" pos=".3 0 0"/></body>
  <body name="box" pos=".3 0 .1"><freejoint/><geom name="box" type="box" size=".1 .1 .1" {surface}/>
    <site name="top" pos="0 0 .1"/></body>
  <geom name="floor" type="plane" size="3 3 .1"/><site name="wall" pos="0 0 1.5"/></worldbody>
  <contact><exclude body1="arm" body2="box"/></contact>
  <actuator><motor name="turn" joint="arm" gear="3" ctrlrange="-1 1"/>{actuator}</actuator></mujoco>"""
BETWEEN = '<motor name="pull" site="top" refsite="tip" gear="0 0 5 0 0 0" ctrlrange="-1 1"/>'
CRANK = '<motor name="push" cranksite="tip" slidersite="wall" cranklength=".7" ctrlrange="-1 1"/>'


@pytest.mark.parametrize(
    ("array", "name", "edit", "what"),
    [
        ("actuator_ctrlrange", "turn", {}, "action bounds"),
        ("jnt_actfrcrange", "arm", {"force": 'actuatorfrcrange="-1 1"'}, "limits of the actuators' forces at joints"),
        ("actuator_gear", "pull", {"actuator": BETWEEN}, "tendons, slider-cranks or sites"),
        ("jnt_pos", "arm", {"actuator": CRANK}, "tendons, slider-cranks or sites"),
        pytest.param(
            *("geom_surfacevel", "box", {"surface": 'surfacevel="1 0 0 0 0 0"'}, "moving surfaces of bodies"),
            marks=pytest.mark.skipif(not hasattr(mujoco.MjModel, "geom_surfacevel"), reason="MuJoCo before 3.11"),
        ),
    ],
)
def test_variants_whose_features_samples_do_not_hold_are_refused(array, name, edit, what):
    """Features would show the bound scene's numbers."""
    scene = load_scene(VARIED.format(**{"force": "", "surface": "", "actuator": ""} | edit))
    heavy, other = (with_factors(scene, {key: [of]}, [1.5]) for key, of in (("body_mass", "box"), (array, name)))
    bound = ForwardModel.for_scene(scene, parameters="scene", **SMALL).bind(scene, parameters_key="parameters")
    bound.parameters_of(heavy)
    with pytest.raises(ValueError, match=f"not a variant of .*: {what} differ"):
        bound.parameters_of(other)
    if array != "actuator_ctrlrange":  # simulators refuse these
        with pytest.raises(ValueError, match=f"not a variant of .*: {what} differ"):
            collect_trajectories([scene, heavy, other], 3, 2)


@pytest.mark.parametrize(("strength", "free"), [('force="3"', True), ('scale="3"', False)])
def test_masses_vary_in_scenes_with_muscles_whose_force_does_not_depend_on_them(strength, free):
    muscle = f'<muscle joint="arm" lengthrange="-1 1" {strength}/>'
    scene = load_scene(VARIED.format(force="", surface="", actuator=muscle))
    variant = with_factors(scene, {"body_mass": ["arm"]}, [2.0])
    bound = ForwardModel.for_scene(scene, parameters="scene", **SMALL).bind(scene, parameters_key="parameters")
    if free:
        bound.parameters_of(variant)
        return
    with pytest.raises(ValueError, match="activations differ"):
        bound.parameters_of(variant)


LED = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body name="lead" mocap="true" pos="0 0 1"><site name="hook" pos=".3 0 0"/></body>
  <body name="ball" pos="0 0 1"><freejoint/><geom size=".1"/><site name="eye" pos=".1 0 0"/></body></worldbody>
  <tendon><spatial name="line" range="0 .4"><site site="hook"/><site site="eye"/></spatial></tendon>
  <equality><connect body1="lead" body2="ball" anchor="0 0 .2"/><tendon tendon1="line"/></equality>
  <keyframe><key name="home" mpos="0 0 2" mquat="1 0 0 0" qpos="0 0 2 1 0 0 0"/></keyframe></mujoco>"""


def test_mocap_bodies_of_a_keyframe_keep_the_anchors_of_the_file():
    scene = load_scene(LED)
    same, heavy = (with_factors(scene, {"body_mass": ["ball"]}, [factor]) for factor in (1.0, 2.0))
    for array in ("eq_data", "tendon_length0", "actuator_length0"):
        for variant in (same, heavy):
            np.testing.assert_allclose(getattr(variant.model, array), getattr(scene.model, array), atol=1e-12)
    start = scene.rest_physics[None]
    start[0, 3] = 2.0  # where the connect holds the ball
    still = Simulator(same).rollout(start, np.zeros((1, 20, 0)))["physics"][0, -1, 1:4]
    np.testing.assert_allclose(still, [0, 0, 2], atol=1e-9)


def test_all_that_follows_from_the_numbers_is_found_anew():
    text = """<mujoco><worldbody><body name="a" pos="{} 0 1"><joint name="j" axis="0 0 1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"/>
      <body name="tip" pos="{} 0 0"><geom size=".05"/></body></body></worldbody>
      <actuator><motor name="m" joint="j" ctrlrange="-{} {}"/></actuator></mujoco>"""
    factors = {"body_pos": ["a", "tip"], "actuator_ctrlrange": None}
    found = with_factors(load_scene(text.format(0.5, 0.4, 1, 1)), factors, [2.0, 3.0, 0.5])
    right = load_scene(text.format(1.0, 1.2, 0.5, 0.5))
    assert found.yaw_frame is not None and right.yaw_frame is not None
    np.testing.assert_allclose(found.yaw_frame.pivot[:2], right.yaw_frame.pivot[:2])
    np.testing.assert_allclose(found.attachments["tip"].pos, right.attachments["tip"].pos)
    assert (found.action_low, found.action_high) == (-0.5, 0.5)
    data = collect_trajectories(found, 4, steps=10)
    assert data["action"].abs().max() <= 0.5


def test_a_number_that_breaks_an_invariance_ends_it():
    scene = load_scene(
        """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" damping="1"/>
        <joint name="y" type="slide" axis="0 1 0" damping="1"/><joint name="turn" axis="0 0 1"/>
        <geom type="box" size=".1 .2 .1"/></body></worldbody></mujoco>"""
    )
    assert scene.yaw_frame is not None
    assert with_factors(scene, {"dof_damping": ["x"]}, [5.0]).yaw_frame is None
