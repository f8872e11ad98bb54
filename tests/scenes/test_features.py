"""Static features and frame sensors against MuJoCo's own numbers."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import SYSTEMS, Scene, load_scene

from .. import zoo

SOURCES = (*SYSTEMS, "odd")


def _column(scene: Scene, kind: str, name: str) -> np.ndarray:
    values, names = getattr(scene.static, kind), getattr(scene.static, kind.rstrip("s_") + "_names")
    if name in names:
        return values[..., names.index(name)]
    return values[..., [i for i, full in enumerate(names) if full.startswith(f"{name}[")]]


def _random_state(scene: Scene, seed: int) -> mujoco.MjData:
    model, rng = scene.model, np.random.default_rng(seed)
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
    data.qvel[:] = rng.normal(size=model.nv)
    data.ctrl[:] = rng.uniform(scene.action_low, scene.action_high)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("source", SOURCES)
def test_frame_sensors_equal_object_velocity(source):
    scene = zoo.load(source)
    data = _random_state(scene, 0)
    state = data.sensordata.reshape(scene.num_nodes, 13)
    np.testing.assert_allclose(state[:, :3], data.xpos[scene.body], atol=1e-12)
    np.testing.assert_allclose(state[:, 3:7], data.xquat[scene.body], atol=1e-12)
    np.testing.assert_array_equal(state[0], [0, 0, 0, 1] + [0] * 9)
    for node, body in enumerate(scene.body):
        velocity = np.empty(6)  # angular first
        mujoco.mj_objectVelocity(scene.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        np.testing.assert_allclose(state[node, 7:], np.roll(velocity, 3), atol=1e-10)


@pytest.mark.parametrize("source", SOURCES)
def test_a_step_depends_on_physics_and_control_alone(source):
    scene = zoo.load(source)
    model, full = scene.model, mujoco.mjtState.mjSTATE_FULLPHYSICS
    rng = np.random.default_rng(3)
    data, fresh = _random_state(scene, 1), mujoco.MjData(model)
    physics = np.empty(scene.physics_size)
    for _ in range(20):
        mujoco.mj_getState(model, data, physics, full)
        mujoco.mj_resetData(model, fresh)
        mujoco.mj_setState(model, fresh, physics, full)
        data.ctrl[:] = fresh.ctrl[:] = rng.uniform(scene.action_low, scene.action_high)
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, fresh)
        np.testing.assert_array_equal(data.qpos, fresh.qpos)
        np.testing.assert_array_equal(data.qvel, fresh.qvel)


@pytest.mark.parametrize("source", SOURCES)
def test_composite_inertias_carry_the_kinetic_energy(source):
    scene = zoo.load(source)
    data = _random_state(scene, 2)
    mujoco.mj_energyVel(scene.model, data)
    armature = 0.5 * (scene.model.dof_armature * data.qvel**2).sum()
    state = data.sensordata.reshape(-1, 13)
    energy = 0.0
    for node in range(scene.num_nodes):
        frame, principal = np.empty(9), np.empty(9)
        mujoco.mju_quat2Mat(frame, state[node, 3:7])
        mujoco.mju_quat2Mat(principal, _column(scene, "nodes", "iquat")[node])
        frame, axes = frame.reshape(3, 3), frame.reshape(3, 3) @ principal.reshape(3, 3)
        linear, angular = state[node, 7:10], state[node, 10:]
        center = linear + np.cross(angular, frame @ _column(scene, "nodes", "ipos")[node])
        energy += 0.5 * _column(scene, "nodes", "mass")[node] * center @ center
        energy += 0.5 * _column(scene, "nodes", "inertia")[node] @ (axes.T @ angular) ** 2
    assert energy == pytest.approx(data.energy[1] - armature, rel=1e-9, abs=1e-12)
    assert _column(scene, "nodes", "mass").sum() == pytest.approx(scene.model.body_mass.sum(), rel=1e-12)


@pytest.mark.parametrize("source", SOURCES)
def test_parent_relative_frames_rebuild_the_reference_pose(source):
    scene = zoo.load(source)
    data = mujoco.MjData(scene.model)  # qpos0
    mujoco.mj_kinematics(scene.model, data)
    pos, quat = _column(scene, "nodes", "pos"), _column(scene, "nodes", "quat")
    np.testing.assert_array_equal(np.concatenate([pos[0], quat[0]]), [0, 0, 0, 1, 0, 0, 0])
    for node in range(1, scene.num_nodes):
        parent, body = scene.body[scene.parent[node]], scene.body[node]
        shift, turn = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(shift, pos[node], data.xquat[parent])
        mujoco.mju_mulQuat(turn, data.xquat[parent], quat[node])
        np.testing.assert_allclose(data.xpos[parent] + shift, data.xpos[body], atol=1e-12)
        assert abs(turn @ data.xquat[body]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("source", SOURCES)
def test_edge_features(source):
    scene = zoo.load(source)
    np.testing.assert_array_equal(_column(scene, "edges", "direction"), [1, -1] * (scene.num_edges // 2))
    edge_action = scene.edge_action.squeeze(1)
    motorized = edge_action >= 0
    np.testing.assert_array_equal(_column(scene, "edges", "motorized"), motorized)
    np.testing.assert_array_equal(_column(scene, "edges", "jnt_type").sum(axis=1), 1)
    for kind in ("gaintype", "biastype", "dyntype"):
        np.testing.assert_array_equal(_column(scene, "edges", f"actuator_{kind}").sum(axis=1), motorized)
    bounds = _column(scene, "edges", "actuator_ctrlrange")
    np.testing.assert_array_equal(bounds[motorized, 0], scene.action_low[edge_action[motorized]])
    np.testing.assert_array_equal(bounds[motorized, 1], scene.action_high[edge_action[motorized]])
    actuator = [name.startswith("actuator_") for name in scene.static.edge_names]
    assert not scene.static.edges[~motorized][:, actuator].any()


def test_global_features():
    scene = zoo.load("odd", timestep=0.006)
    assert _column(scene, "globals_", "timestep") == pytest.approx(0.006)
    np.testing.assert_array_equal(_column(scene, "globals_", "gravity"), [0.3, -0.2, -9])
    np.testing.assert_array_equal(_column(scene, "globals_", "wind"), [1, 0, 0])
    assert _column(scene, "globals_", "density") == 1.2
    assert _column(scene, "globals_", "disableflags[WARMSTART]") == 1
    assert _column(load_scene("swimmer6"), "globals_", "disableflags[CONTACT]") == 1
    assert _column(load_scene("cheetah"), "globals_", "disableflags[CONTACT]") == 0


def test_odd_model_has_the_expected_graph():
    scene = zoo.load("odd")
    assert scene.node_names == ("world", "arm", "ball", "body6")
    assert scene.parent.tolist() == [-1, 0, 1, 0]
    assert scene.senders.tolist() == [0, 1, 0, 1, 1, 2, 0, 3]
    assert scene.edge_action.tolist() == [[0], [0], [-1], [-1], [-1], [-1], [-1], [-1]]
    assert {name: a.node for name, a in scene.attachments.items()} == {"shelf": 0, "late": 1}
    damping = _column(scene, "edges", "dof_damping")
    np.testing.assert_array_equal(damping[:4], [0.3, 0.3, 0, 0])
