"""Fingerprints: other physics, another one; anything else, or another machine's rounding, the same."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.scenes.fingerprint import physics

from .. import zoo
from ..static_columns import change_columns

PHYSICS = {
    "timestep": ('timestep="0.004"', 'timestep="0.002"'),
    "gravity": ("0 0 -9.8", "0 0 -9.7"),
    "density": ('density="1.2"', 'density="1.3"'),
    "viscosity": ('viscosity="0.01"', 'viscosity="0.02"'),
    "wind": ('wind="0.1 0 0"', 'wind="0.1 0 0.1"'),
    "integrator": ("implicitfast", "RK4"),
    "solver": ('solver="CG"', 'solver="Newton"'),
    "iterations": ('iterations="50"', 'iterations="150"'),
    "tolerance": ("1e-7", "1e-9"),
    "cone": ("elliptic", "pyramidal"),
    "impratio": ('impratio="2"', 'impratio="3"'),
    "a flag": ('eulerdamp="disable"', 'contact="disable"'),
    "corners of a mesh": ("0 0.2 0  0 0 0.1", "0 0.2 0  0 0 0.11"),
    "heights": ("0 0.5 1 0.2", "0 0.6 1 0.2"),
    "friction": ("0.7 0.005", "0.8 0.005"),
    "rolling friction": ("0.7 0.005 0.0001", "0.7 0.005 0.0002"),
    "the floor's place": ('name="floor" type="plane"', 'name="floor" pos="0 0 0.1" type="plane"'),
    "what the floor touches": ('name="floor" type="plane"', 'name="floor" contype="2" type="plane"'),
    "a body's place": ('name="arm" pos="0 0 0.2"', 'name="arm" pos="0 0 0.21"'),
    "a body's orientation": ("0.9 0.1 0.2 0.3", "0.9 0.1 0.2 0.31"),
    "a welded body's place": ('pos="0.2 0 0"', 'pos="0.2 0.1 0"'),
    "a joint's type": ('type="slide" axis', 'type="hinge" axis'),
    "a joint's axis": ('axis="0 1 0"', 'axis="0 1 0.1"'),
    "a joint's place": ('pos="0 0 0.01"', 'pos="0 0 0.02"'),
    "a joint's range": ('range="-1 1"/>\n      <geom', 'range="-1 2"/>\n      <geom'),
    "stiffness": ('stiffness="2"', 'stiffness="2.5"'),
    "a spring's rest": ('springref="0.3"', 'springref="0.4"'),
    "a joint's reference": ('ref="0.1"', 'ref="0.2"'),
    "damping": ('damping="0.3"', 'damping="0.31"'),
    "armature": ('armature="0.01"', 'armature="0.02"'),
    "frictionloss": ('frictionloss="0.02"', 'frictionloss="0.03"'),
    "a geom's size": ('size="0.1 0.2 0.05"', 'size="0.1 0.2 0.06"'),
    "a geom's place": ('pos="0 0 0.1"/></body>', 'pos="0 0 0.12"/></body>'),
    "a geom's mass": ('size="0.1 0.2 0.05"', 'size="0.1 0.2 0.05" mass="3"'),
    "solref": ('solref="0.01 1"', 'solref="0.02 1"'),
    "solimp": ("0.8 0.9 0.01", "0.8 0.91 0.01"),
    "a pair of geoms": ("0.4 0.4 0.005", "0.5 0.4 0.005"),
    "bodies that pass each other": ('body1="cart" body2="arm"', 'body1="world" body2="arm"'),
    "a tendon's stiffness": ('stiffness="3"', 'stiffness="4"'),
    "a tendon's range": ('range="0 2"', 'range="0 1"'),
    "where a tendon is fixed": ('name="tip" pos="0 0 0.5"', 'name="tip" pos="0 0 0.4"'),
    "a constraint": ('active="false"', 'active="true"'),
    "a motor's gain": ('kp="5"', 'kp="6"'),
    "a motor's gear": ('gear="2"', 'gear="3"'),
    "a motor's bounds": ('ctrlrange="-1 1"', 'ctrlrange="-1 2"'),
    "a motor's force": ('forcerange="-3 3"', 'forcerange="-3 4"'),
    "a motor's joint": ('<position name="servo" joint="hinge"', '<position name="servo" joint="slide"'),
    "a joint's name": ('name="slide"', 'name="glide"'),
    "whether a geom touches": ('solref="0.01 1"', 'solref="0.01 1" contype="0" conaffinity="0"'),
}

ELSE = {
    "a colour": ("1 0 0 1", "0 0 1 1"),
    "a material": ('rgba="0.5 0.5 0.5 1"', 'rgba="0.5 0.5 0.6 1"'),
    "a camera": ('name="eye" pos="0 -3 1"', 'name="lens" pos="0 -3 2" fovy="60"'),
    "a light": ('<light name="sun" pos="0 0 3"/>', ""),
    "the headlight": ("0.1 0.1 0.1", "0.2 0.2 0.2"),
    "how far the floor is drawn": ('size="2 2 0.1"', 'size="5 5 0.2"'),
    "a geom that is only seen": (
        '<geom name="rod"',
        '<geom size="0.3" mass="0" contype="0" conaffinity="0"/><geom name="rod"',
    ),
    "a geom's name": ('name="rod"', 'name="pole"'),
    "a site that nothing is fixed to": ('<site name="hook"', '<site name="mark" pos="1 1 1"/><site name="hook"'),
    "a sensor": ('<jointpos joint="hinge"/>', '<jointvel joint="hinge"/><framepos objtype="body" objname="arm"/>'),
    "a keyframe": ("<sensor>", '<keyframe><key qpos="0.1 0.2"/></keyframe><sensor>'),
    "bounds that are not in force": ('name="hinge" axis', 'name="hinge" limited="false" range="-3 3" axis'),
    "what is measured": ('eulerdamp="disable"', 'eulerdamp="disable" energy="enable"'),
}


def edited(old: str, new: str) -> Scene:
    return zoo.load("everything", (old, new), timestep=0.02)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return zoo.load("everything", timestep=0.02)


@pytest.mark.parametrize("what", PHYSICS)
def test_other_physics_have_another(scene, what):
    assert edited(*PHYSICS[what]).fingerprint() != scene.fingerprint()


def test_another_control_step_has_another(scene):
    assert zoo.load("everything", timestep=0.04).fingerprint() != scene.fingerprint()


@pytest.mark.parametrize("what", ELSE)
def test_what_moves_nothing_is_not_in_it(scene, what):
    assert physics(edited(*ELSE[what])) == physics(scene)


def test_order_of_what_is_seen_only_does_not_matter(scene):
    """Elements refer to each other by names, not by numbers."""
    body = '<body name="marker" pos="0 3 0"><geom size="0.1" contype="0" conaffinity="0"/></body>'
    assert edited('<body name="cart"', f'{body}<body name="cart"').fingerprint() == scene.fingerprint()


@pytest.mark.parametrize(
    "system", ["pendulum", "cartpole", "acrobot", "swimmer6", "cheetah", "walker2d", "jaco", "everything"]
)
def test_another_machines_rounding_does_not_matter(system):
    """Some units in the last place of everything, noise where there are zeros, and principal axes that are no one's."""
    scene, rng = zoo.load(system), np.random.default_rng(0)
    expected, model = physics(scene), scene.model
    originals = {name: value.copy() for name, value in arrays(model).items()}
    for _ in range(5):
        for name, value in arrays(model).items():
            value[...] = originals[name] * (1 + 2e-16 * rng.integers(-4, 5, value.shape))
            if name.endswith(("pos", "quat", "axis")):
                value += 1e-17 * rng.normal(size=value.shape)
        round_ = (model.body_inertia == model.body_inertia[:, :1]).all(1)
        model.body_iquat[round_] = rng.normal(size=(round_.sum(), 4))
        model.body_iquat /= np.linalg.norm(model.body_iquat, axis=1, keepdims=True)
        model.geom_quat[:] *= rng.choice([-1, 1], (model.ngeom, 1))  # the same rotation
        assert physics(scene) == expected


def arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    found = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {name: value for name, value in found.items() if isinstance(value, np.ndarray) and value.dtype == np.float64}


def test_a_new_static_feature_is_not_in_it(monkeypatch, scene):
    before = {name: load_scene(name).fingerprint() for name in ("cheetah", "jaco")}
    change_columns(monkeypatch, gain=True)
    assert load_scene("cheetah").static.node_names[0] == "charm"
    assert {name: load_scene(name).fingerprint() for name in before} == before
    assert zoo.load("everything", timestep=0.02).fingerprint() == scene.fingerprint()


def test_soft_bodies():
    scene = zoo.load("soft")
    for old, new in (('radius="0.01"', 'radius="0.02"'), ('damping="0.1"', 'damping="0.2"'), ('mass="1"', 'mass="2"')):
        assert zoo.load("soft", (old, new)).fingerprint() != scene.fingerprint(), new
    assert zoo.load("soft").fingerprint() == scene.fingerprint()
