"""Forces of actuators at sites as features."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.dynamics import Canonicalizer, ForwardModel, Wrenches, specialize
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.scenes import load_scene

from .. import zoo
from ..sizes import SMALL


def test_they_are_the_forces_of_rotors_in_the_world(random_states, random_actions):
    scene = zoo.load("quadrotor")
    program = (
        ForwardModel.for_scene(scene, canonicalizer=Canonicalizer(yaw=False), **SMALL).double().bind(scene).program()
    )
    state, action = random_states(scene, 5), random_actions(scene, 5)
    _, edges = eager.features(program, program.canonicalizer(state, program.parameters), action)
    wrench, data = edges[:, 0, -6:].numpy(), mujoco.MjData(scene.model)
    np.testing.assert_array_equal(wrench, edges[:, 1, -6:].numpy())
    for row in range(5):
        data.qpos[:] = state[row, 1, :7]
        data.ctrl[:] = action[row]
        mujoco.mj_forward(scene.model, data)
        # A free joint's generalised force: force in the world, torque in the body.
        torque = data.xmat[scene.body[1]].reshape(3, 3).T @ wrench[row, 3:]
        np.testing.assert_allclose(np.concatenate((wrench[row, :3], torque)), data.qfrc_actuator, atol=1e-12)


@pytest.mark.slow
def test_scenes_with_actuators_at_sites_have_them():
    for name, suits in (("quadrotor", True), ("machine", True), ("gripper", False), ("arm", False)):
        scene = zoo.load(name)
        model = ForwardModel.for_scene(scene, **SMALL)
        assert (Wrenches() in model.features) == Wrenches.suits(scene) == suits
        assert ForwardModel.from_description(model.description()).features == model.features
    # The native executor runs them.
    scene = zoo.load("quadrotor")
    assert "here by torch" not in str(specialize(ForwardModel.for_scene(scene, **SMALL).bind(scene)))


def test_a_scene_of_fewer_controls_is_refused():
    model = ForwardModel.for_scene(zoo.load("quadrotor"), **SMALL)
    with pytest.raises(ValueError, match=r"reads 4 controls at each edge, scene 'pendulum' has 1"):
        model.bind(load_scene("pendulum"))
