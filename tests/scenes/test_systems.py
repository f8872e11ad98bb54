"""The paper's systems have the sizes of its table and the physics of dm_control."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import SYSTEMS, load_scene

# SM table: nodes, joints, actions, control step, physics steps in a control step.
TABLE = {
    "pendulum": (2, 1, 1, 0.02, 1),
    "cartpole": (3, 2, 1, 0.01, 1),
    "acrobot": (3, 2, 1, 0.01, 1),
    "swimmer3": (4, 5, 2, 0.02, 10),
    "swimmer6": (7, 8, 5, 0.02, 10),
    "swimmer10": (11, 12, 9, 0.02, 10),
    "cheetah": (8, 9, 6, 0.01, 1),
    "walker2d": (8, 9, 6, 0.0025, 1),
    "jaco": (10, 9, 9, 0.1, 50),
}


@pytest.mark.parametrize("name", TABLE)
def test_sizes_of_the_papers_table(name):
    nodes, joints, actions, timestep, substeps = TABLE[name]
    scene = load_scene(name)
    assert (scene.num_nodes, scene.num_edges, scene.num_actions) == (nodes, 2 * joints, actions)
    assert scene.timestep == pytest.approx(timestep, rel=1e-12)
    assert scene.substeps == substeps
    assert scene.settle_steps == (200 if name == "cheetah" else 0)
    assert scene.node_names[0] == "world" and scene.parent[0] == -1
    assert len(scene.node_names) == len(set(scene.node_names)) == len(scene.body)
    assert np.all(scene.parent[1:] < np.arange(1, nodes))


@pytest.mark.parametrize("name", TABLE)
def test_every_joint_is_a_pair_of_opposite_edges(name):
    scene = load_scene(name)
    down, up = slice(0, None, 2), slice(1, None, 2)
    np.testing.assert_array_equal(scene.senders[down], scene.receivers[up])
    np.testing.assert_array_equal(scene.receivers[down], scene.senders[up])
    np.testing.assert_array_equal(scene.senders[down], scene.parent[scene.receivers[down]])
    np.testing.assert_array_equal(scene.edge_action[down], scene.edge_action[up])
    used = scene.edge_action[down].squeeze(1)
    assert sorted(used[used >= 0]) == list(range(scene.num_actions))
    for action, joint in ((a, j) for j, a in enumerate(used) if a >= 0):
        assert scene.model.actuator_trnid[action, 0] == joint


def test_named_systems_share_every_column():
    scenes = [load_scene(name) for name in [*SYSTEMS, "swimmer10"]]
    for scene in scenes:
        static, first = scene.static, scenes[0].static
        assert static.node_names == first.node_names
        assert static.edge_names == first.edge_names
        assert static.global_names == first.global_names
        assert static.nodes.shape == (scene.num_nodes, len(static.node_names))
        assert static.edges.shape == (scene.num_edges, len(static.edge_names))
        assert static.globals_.shape == (len(static.global_names),)
        for names in (static.node_names, static.edge_names, static.global_names):
            assert len(set(names)) == len(names)
        for array in (static.nodes, static.edges, static.globals_):
            assert array.dtype == np.float64 and np.isfinite(array).all()


def _dm_control(name: str) -> mujoco.MjModel:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no display
        from dm_control.entities.manipulators import kinova
        from dm_control.suite import acrobot, cartpole, cheetah, pendulum, swimmer, walker

        if name == "jaco":
            arm = kinova.JacoArm()
            arm.attach(kinova.JacoHand())
            root = arm.mjcf_model
            return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())
        if name.startswith("swimmer"):
            xml, assets = swimmer.get_model_and_assets(int(name.removeprefix("swimmer")))
        else:
            modules = {
                "pendulum": pendulum,
                "cartpole": cartpole,
                "acrobot": acrobot,
                "cheetah": cheetah,
                "walker2d": walker,
            }
            xml, assets = modules[name].get_model_and_assets()
        assets = {key.removeprefix("./"): value for key, value in assets.items()}
        return mujoco.MjModel.from_xml_string(xml, assets)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot", "swimmer5", "cheetah", "walker2d", "jaco"])
def test_dynamics_of_dm_control(name):
    ours, theirs = load_scene(name).model, _dm_control(name)
    assert (ours.nq, ours.nv, ours.nu) == (theirs.nq, theirs.nv, theirs.nu)
    assert ours.opt.timestep == theirs.opt.timestep
    np.testing.assert_allclose(ours.actuator_ctrlrange, theirs.actuator_ctrlrange, rtol=1e-12)
    np.testing.assert_allclose(ours.jnt_range, theirs.jnt_range, rtol=1e-12)
    moving = (ours.body_mass[ours.body_mass > 0], theirs.body_mass[theirs.body_mass > 0])
    np.testing.assert_allclose(*moving, rtol=1e-12)
    inertias = (ours.body_inertia[ours.body_mass > 0], theirs.body_inertia[theirs.body_mass > 0])
    np.testing.assert_allclose(*inertias, rtol=1e-10)
    theirs.opt.disableflags = ours.opt.disableflags
    rng = np.random.default_rng(0)
    low, high = np.where(ours.jnt_limited[:, None], ours.jnt_range, [[-1.0, 1.0]]).T
    qpos = rng.uniform(low, high)
    trajectories = []
    for model in (ours, theirs):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        control = np.random.default_rng(1)
        for _ in range(20):
            data.ctrl[:] = control.uniform(*model.actuator_ctrlrange.T)
            mujoco.mj_step(model, data)
        trajectories.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(*trajectories, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
def test_loading_is_silent_and_leaves_the_environment_alone():
    code = (
        "import os, sys; from torchrl_gn.scenes import SYSTEMS, load_scene\n"
        "for name in SYSTEMS: load_scene(name)\n"
        "assert 'dm_control' not in sys.modules and 'MUJOCO_GL' not in os.environ"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY")}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    done = subprocess.run(
        [sys.executable, "-W", "always", "-c", code],
        check=False,
        capture_output=True,
        text=True,
        env=environment,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_attachments_follow_their_node():
    scene = load_scene("jaco")
    data = mujoco.MjData(scene.model)
    data.qpos[:] = np.random.default_rng(2).uniform(-1, 1, scene.model.nq)
    mujoco.mj_kinematics(scene.model, data)
    assert {"b_base", "jaco_hand/hand", "jaco_hand/b_finger_tip_1"} <= set(scene.attachments)
    for name, attachment in scene.attachments.items():
        root = scene.body[attachment.node]
        position, quat = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(position, attachment.pos, data.xquat[root])
        mujoco.mju_mulQuat(quat, data.xquat[root], attachment.quat)
        body = data.body(name)
        np.testing.assert_allclose(data.xpos[root] + position, body.xpos, atol=1e-12)
        assert abs(quat @ body.xquat) == pytest.approx(1.0, abs=1e-12)
