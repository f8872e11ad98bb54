"""Errors of MuJoCo at half its physics step."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import collect_trajectories
from torchrl_gn.evaluation import half_step_errors, squared_errors
from torchrl_gn.scenes import load_scene, sample_variants

from .. import zoo


@pytest.fixture(scope="module")
def scene():
    return zoo.load("crawler")


@pytest.fixture(scope="module")
def data(scene):
    return collect_trajectories(scene, 6, steps=12, seed=0)


def test_they_are_those_of_twice_as_many_steps(scene, data):
    table = half_step_errors(scene, data, horizons=[12, 4], num_threads=1)
    assert list(table.errors) == ["one_step_error", "rollout_error_4", "rollout_error_12"]
    fine = copy.copy(scene.model)
    fine.opt.timestep /= 2
    simulated, paths = mujoco.MjData(fine), []
    for sequence in range(len(data)):
        mujoco.mj_setState(fine, simulated, data["physics"][sequence, 0].numpy(), mujoco.mjtState.mjSTATE_FULLPHYSICS)
        states = []
        for action in data["action"][sequence].numpy():
            simulated.ctrl[:] = action
            for _ in range(2 * scene.substeps):
                mujoco.mj_step(fine, simulated)
            mujoco.mj_forward(fine, simulated)
            physics = np.concatenate(([simulated.time], simulated.qpos, simulated.qvel, simulated.act))
            states.append(scene.states(simulated.sensordata.copy(), physics))
        paths.append(states)
    moving = torch.as_tensor(scene.predicted)
    found, true = torch.tensor(np.array(paths))[:, :, moving], data["state"][:, 1:, moving]
    start = data["state"][:, :1, moving].expand_as(true)
    error, baseline = (squared_errors(each, true).mean((0, 1, 2)) for each in (found, start))
    for name, expected in zip(scene.layout.names, (error / baseline).tolist(), strict=True):
        assert table["rollout_error_12"].components[name] == pytest.approx(expected, rel=1e-6)
    assert 0 < table["rollout_error_4"].total < 1 and 0 < table["rollout_error_12"].total < 1


def test_trajectories_need_their_physics(scene, data):
    with pytest.raises(KeyError, match="physics"):
        half_step_errors(scene, data.exclude("physics"), horizons=[4])


def test_scenes_stay_as_they_are(scene, data):
    before = scene.model.opt.timestep
    half_step_errors(scene, data, horizons=[2], num_threads=1)
    assert scene.model.opt.timestep == before


def test_variants_are_refused():
    variants = sample_variants("pendulum", 2, rng=0)
    both = collect_trajectories(variants, 2, steps=4)
    with pytest.raises(ValueError, match="other parameters"):
        half_step_errors(load_scene("pendulum"), both, horizons=[2])
    assert half_step_errors(variants[1], both[1:], horizons=[2])["rollout_error_2"].total < 0.1
