"""Overlays: contacts carry the weight, and centres of mass are MuJoCo's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.data import Simulator
from torchrl_gn.scenes import load_scene
from torchrl_gn.viewer.overlays import centers_of_mass, contacts, has_spatial_tendons, outermost, tendons

BOX = """<mujoco><worldbody><geom type="plane" size="5 5 1"/>
  <body pos="0 0 .1"><freejoint/><geom type="box" size=".3 .2 .1" mass="2"/></body></worldbody></mujoco>"""


def test_contact_forces_of_a_box_at_rest_carry_its_weight():
    scene = load_scene(BOX)
    rest = Simulator(scene, 1).rollout(scene.rest_physics, np.zeros((100, 0)))["physics"][-1].numpy()
    points, forces = contacts(scene, mujoco.MjData(scene.model), rest, None)
    assert len(points) == 4
    np.testing.assert_allclose(np.sort(np.abs(points[:, 0])), 0.3, atol=1e-6)
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-3)
    np.testing.assert_allclose(forces.sum(0), [0, 0, 2 * 9.81], atol=1e-2)


def test_without_contacts_there_are_none(scenes):
    points, forces = contacts(
        scenes["falling"], mujoco.MjData(scenes["falling"].model), scenes["falling"].rest_physics, None
    )
    assert points.shape == forces.shape == (0, 3)


ARM = """<mujoco><worldbody><site name="a" pos="0 0 1"/><site name="b" pos=".2 0 1"/>
  <body pos="0 0 .5"><joint name="j" axis="0 1 0"/><geom name="w" type="cylinder" size=".05 .1" euler="90 0 0"/>
  <geom size=".02" pos="0 0 .3"/><site name="c" pos="0 0 .3"/></body></worldbody>
  <tendon><spatial name="t" rgba="0 0 1 1"><site site="a"/><site site="c"/><pulley divisor="2"/><site site="b"/>
    <site site="c"/></spatial>
    <spatial name="s" rgba="0 1 0 1"><site site="a"/><site site="b"/></spatial>
    <fixed name="f"><joint joint="j" coef="1"/></fixed></tendon>
  <actuator><muscle tendon="t" lengthrange="0.1 1"/></actuator></mujoco>"""


def test_tendons_are_mujocos_paths_and_red_where_a_muscle_pulls():
    scene, activation = load_scene(ARM), 0.5
    data = mujoco.MjData(scene.model)
    data.act[:] = activation
    physics = np.zeros(scene.physics_size)
    mujoco.mj_getState(scene.model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    segments, colors = tendons(scene, mujoco.MjData(scene.model), physics)
    ends = [[[0, 0, 1], [0, 0, 0.8]], [[0.2, 0, 1], [0, 0, 0.8]], [[0, 0, 1], [0.2, 0, 1]]]  # none across the pulley
    np.testing.assert_allclose(segments, ends, atol=1e-12)
    assert colors.tolist() == [[107, 20, 147], [107, 20, 147], [0, 255, 0]]
    assert has_spatial_tendons(scene.model) and not has_spatial_tendons(load_scene(BOX).model)


@pytest.mark.parametrize("name", ["cheetah", "swimmer6"])
def test_centres_of_mass_are_mujocos(scenes, name):
    scene = scenes[name]
    data = mujoco.MjData(scene.model)
    data.qpos[:] = np.random.default_rng(0).normal(size=scene.model.nq)
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_comPos(scene.model, data)
    centers = centers_of_mass(scene)
    world = data.xpos[scene.body] + np.einsum("nij,nj->ni", data.xmat[scene.body].reshape(-1, 3, 3), centers)
    mass = scene.model.body_subtreemass[0]
    assert (world[1:].T @ scene.model.body_mass[scene.body[1:]] / mass) == pytest.approx(data.subtree_com[0], abs=1e-9)


def test_tips_of_plans_are_the_outermost_bodies(scenes):
    assert outermost(scenes["swimmer6"]) == [6]
    names = [scenes["cheetah"].node_names[node] for node in outermost(scenes["cheetah"])]
    assert names == ["bfoot", "ffoot"]
