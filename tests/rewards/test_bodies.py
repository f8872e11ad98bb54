"""Positions and velocities of named bodies, against MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.rewards import Bodies, find_body, make_reward
from torchrl_gn.scenes import KinematicTree

from .. import zoo

NAMES = ("tip", "upper", "post", "lower")


@pytest.fixture(scope="module")
def arm(make_steps):
    return make_steps(zoo.load("welded_tip"))


def rotation(q: np.ndarray) -> np.ndarray:
    """Rotation matrices of quaternions ``[..., 4]``."""
    w, v = q[..., :1, None], q[..., 1:]
    cross = np.cross(v[..., None, :], np.eye(3)).swapaxes(-1, -2)  # columns v x e_i
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@pytest.mark.parametrize("name", [*NAMES, "jaco_hand/hand", "jaco_hand/b_finger_tip_2", "b_base"])
def test_pose_and_motion_are_mujocos(arm, steps, name):
    moving = arm if name in NAMES else steps("jaco")
    names = NAMES if name in NAMES else (name,)
    bodies, truth = Bodies(moving.scene, names), moving.truth(name)
    k, state = names.index(name), moving.next_state
    np.testing.assert_allclose(bodies.position(state)[:, k], truth.position, atol=1e-12)
    np.testing.assert_allclose(rotation(bodies.orientation(state)[:, k].numpy()), truth.rotation, atol=1e-12)
    np.testing.assert_allclose(bodies.linear_velocity(state)[:, k], truth.linear, atol=1e-11)
    np.testing.assert_allclose(bodies.angular_velocity(state)[:, k], truth.angular, atol=1e-11)
    if name not in ("post", "b_base"):
        assert np.abs(truth.angular).max() > 1e-3 and np.abs(truth.linear).max() > 1e-3


def test_welded_bodies_stand_off_their_node(arm):
    """The comparison above would say nothing if the offsets were identities."""
    tip = find_body(arm.scene, "tip")
    assert arm.scene.node_names[tip.node] == "lower"
    np.testing.assert_allclose(tip.pos, [0.4, 0.1, -0.2])
    assert abs(tip.quat[0]) < 0.9


def test_takes_any_batch_and_dtype_and_keeps_its_offsets_in_float64(arm):
    bodies = Bodies(arm.scene, NAMES)
    state = arm.path  # [M, T + 1, N, 13]
    for read in (bodies.position, bodies.orientation, bodies.linear_velocity, bodies.angular_velocity):
        whole = read(state)
        assert whole.shape[:3] == (*state.shape[:2], len(NAMES)) and whole.dtype == torch.float64
        torch.testing.assert_close(whole[2, 7], read(state[2, 7]), rtol=0, atol=1e-15)
        single = read(state.float())
        assert single.dtype == torch.float32
        torch.testing.assert_close(single.double(), whole, rtol=1e-5, atol=1e-5)
    before = bodies.position(state)
    assert torch.equal(bodies.float().position(state), before)


def test_gradients_are_the_finite_differences(arm):
    bodies, state = Bodies(arm.scene, NAMES), arm.next_state[0].clone().requires_grad_()
    for read in (bodies.position, bodies.orientation, bodies.linear_velocity, bodies.angular_velocity):
        assert torch.autograd.gradcheck(read, (state,))


def test_refuses_what_it_cannot_read(arm, steps):
    with pytest.raises(
        ValueError, match="'welded_tip' has no body 'hand'; it has: world, cart, upper, lower, post, tip"
    ):
        Bodies(arm.scene, ["tip", "hand"])
    with pytest.raises(ValueError, match="list of body names, got 'tip'"):
        Bodies(arm.scene, "tip")
    with pytest.raises(ValueError, match="list of body names"):
        Bodies(arm.scene, [])
    with pytest.raises(ValueError, match="must be distinct"):
        Bodies(arm.scene, ["tip", "tip"])
    with pytest.raises(ValueError, match=r"states of scene 'welded_tip' must be \[\*B, 4, 13\], got \[4, 10, 13\]"):
        Bodies(arm.scene, ["tip"]).position(steps("jaco").state)
    chain = KinematicTree("robot", ("a",), 0.1, ((0,),))
    with pytest.raises(TypeError, match="KinematicTree"):
        Bodies(chain, ["a"])
    with pytest.raises(TypeError, match="KinematicTree"):
        make_reward("reach", chain)
