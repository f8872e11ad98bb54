"""Kinetic energy against MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.evaluation import kinetic_energy
from torchrl_gn.scenes import load_scene


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "swimmer6", "cheetah", "jaco"])
def test_kinetic_energy_is_mujocos(name):
    scene = load_scene(name)
    model, rng = scene.model, np.random.default_rng(0)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    for _ in range(5):
        data.qpos[:], data.qvel[:] = model.qpos0 + rng.normal(size=model.nq), rng.normal(size=model.nv)
        mujoco.mj_forward(model, data)
        state = torch.as_tensor(data.sensordata.reshape(-1, 13))
        armature = 0.5 * float(model.dof_armature @ data.qvel**2)
        assert float(kinetic_energy(state, scene)) == pytest.approx(data.energy[1] - armature, rel=1e-9)
