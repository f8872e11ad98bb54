"""Joint axes from body frames equal MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes.physical_parameters import joint_axes

from .. import zoo


@pytest.mark.parametrize("name", ["cartpole", "swimmer4", "cheetah", "walker2d", "jaco", "joints", "two_hinges"])
def test_axes_are_mujocos_in_any_pose(name):
    scene = zoo.load(name)
    model, data = scene.model, mujoco.MjData(scene.model)
    nodes, axes = joint_axes(scene)
    has_axis = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)])
    assert (axes[~has_axis] == 0).all()
    rng = np.random.default_rng(0)
    for _ in range(5):
        data.qpos[:] = rng.uniform(-2, 2, model.nq)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        rotation = data.xmat[scene.body[nodes]].reshape(-1, 3, 3)
        world = np.einsum("jab,jb->ja", rotation, axes)
        np.testing.assert_allclose(world[has_axis], data.xaxis[has_axis], atol=1e-12)
