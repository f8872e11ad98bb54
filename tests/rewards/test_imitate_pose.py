"""The distance from a target pose, and which poses an arm can take."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.maths import quaternion
from torchrl_gn.rewards import FreezeGoal, ImitatePose, arm_reach, make_reward
from torchrl_gn.scenes import load_scene

from .. import zoo

SLIDE = ('name="a" axis="0 1 0"', 'name="a" type="slide" axis="1 0 0"')


@pytest.fixture(scope="module")
def arm(steps):
    return steps("jaco")


@pytest.fixture(scope="module")
def poses(arm) -> torch.Tensor:
    """Many states ``[300, N, 13]`` of the arm."""
    scene, rng = arm.scene, np.random.default_rng(0)
    physics = sample_start_states(scene, 300, rng)
    low, high = scene.model.jnt_range.T
    limited = scene.model.jnt_limited.astype(bool)
    angles = rng.uniform(np.where(limited, low, -np.pi), np.where(limited, high, np.pi), (300, len(low)))
    physics[:, 1 : 1 + scene.model.nq] = angles  # after the time
    return Simulator(scene, num_threads=1).observe(physics)


def test_is_zero_exactly_where_the_pose_is(arm):
    for task in ("palm_pose", "full_pose"):
        reward = make_reward(task, arm.scene)
        goal = reward.task_of(arm.state, arm.next_state)
        assert reward(arm.state, None, arm.next_state, goal).abs().max() < 1e-30
        assert (reward(arm.state, None, arm.path[:, 2], goal) < -1e-6).all()


def test_reads_poses_of_its_bodies_only(arm):
    goal = arm.path[:, 2]
    hand = arm.scene.attachments["jaco_hand/hand"].node
    other = goal.clone()
    other[..., 7:] = 5.0
    other[:, [node for node in range(10) if node != hand], :7] = 3.0
    palm, full = make_reward("palm_pose", arm.scene), make_reward("full_pose", arm.scene)
    assert torch.equal(palm(None, None, arm.next_state, other), palm(None, None, arm.next_state, goal))
    assert torch.equal(palm.task_of(arm.state, other), other)
    assert not torch.equal(full(None, None, arm.next_state, other), full(None, None, arm.next_state, goal))
    goal[..., 7:] = 5.0
    assert full.bodies.names == arm.scene.node_names[1:] and len(full.bodies.names) == 9


@pytest.mark.parametrize("angle", [1e-9, 1e-4, 1.0, math.pi])
def test_angles_keep_their_digits_and_quaternions_have_no_sign(arm, angle):
    reward = make_reward("palm_pose", arm.scene)
    state = arm.next_state[0]
    turn = quaternion.exp(angle * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64))
    goal = state.clone()
    goal[:, 3:7] = quaternion.product(state[:, 3:7], turn)
    for sign in (1.0, -1.0, -3.0):  # any length
        goal[:, 3:7] *= sign
        value = reward(None, None, state, goal).item()
        assert value == pytest.approx(-(math.sin(angle / 2) ** 2), rel=1e-6, abs=1e-31)


def test_distance_is_in_square_metres(arm):
    reward = make_reward("full_pose", arm.scene)
    goal = arm.next_state.clone()
    goal[..., :3] += torch.tensor([0.01, 0.02, -0.02])
    torch.testing.assert_close(
        reward(None, None, arm.next_state, goal), torch.full((4, 1), -9 * 9e-4, dtype=torch.float64)
    )


def test_no_pose_is_beyond_the_reach_and_the_reach_is_no_larger_than_the_links(arm, poses):
    for name in (*arm.scene.node_names[1:], "jaco_hand/hand"):
        reward = ImitatePose(arm.scene, [name])
        assert torch.equal(reward.task_of(poses, poses), poses)
        base, reach = arm_reach(arm.scene, name)
        far = (reward.bodies.position(poses)[:, 0] - torch.as_tensor(base)).norm(dim=-1).max()
        assert far <= reach + 1e-9
        assert far >= 0.8 * reach
    np.testing.assert_allclose(base, [0, 0, 0.15675], atol=1e-6)


def test_a_stretched_arm_reaches_as_far_as_said():
    scene = zoo.load("two_links")
    for name, length in (("first", 0.0), ("second", 0.3), ("tip", 0.8)):
        base, reach = arm_reach(scene, name)
        np.testing.assert_allclose(base, [0, 0, 1])
        assert reach == pytest.approx(length, abs=1e-12)
    assert arm_reach(zoo.load("two_links", SLIDE), "tip")[1] == math.inf


def test_targets_out_of_reach_are_refused(arm):
    reward = make_reward("palm_pose", arm.scene)
    hand = arm.scene.attachments["jaco_hand/hand"].node
    goal = arm.next_state.clone()
    goal[2, hand, :3] = torch.tensor([5.0, 0.0, 0.15675])
    with pytest.raises(ValueError, match=r"at index \(2,\) puts 'jaco_hand/hand' 5 m from .* reach 0.8845 m"):
        reward.task_of(arm.state, goal)
    with pytest.raises(ValueError, match=r"ImitatePose puts 'jaco_hand/hand' 5 m"):
        reward.task_of(arm.state[2], goal[2])
    goal[2, hand, :3] = torch.tensor([0.884, 0.0, 0.15675])
    reward.task_of(arm.state, goal)
    goal[2, 1, 0] += 0.01  # the first link, whose origin never moves
    reward.task_of(arm.state, goal)
    with pytest.raises(ValueError, match="'b_1' 0.01 m"):
        make_reward("full_pose", arm.scene).task_of(arm.state, goal)


def test_rounded_targets_are_within_reach(poses):
    scene = load_scene("jaco")
    make_reward("full_pose", scene).task_of(poses, poses.float())


def test_what_slides_reaches_everywhere():
    scene = zoo.load("two_links", SLIDE)
    goal = torch.zeros(scene.num_nodes, 13, dtype=torch.float64)
    goal[:, 3], goal[:, 0] = 1, 100.0
    ImitatePose(scene, ["tip"]).task_of(goal, goal)
    with pytest.raises(ValueError, match="'tip' 100"):
        ImitatePose(zoo.load("two_links"), ["tip"]).task_of(goal, goal)


def test_bad_targets_and_tasks_are_named(arm):
    reward = make_reward("palm_pose", arm.scene)
    goal = arm.next_state.clone()
    goal[..., 3:7] = 0
    with pytest.raises(ValueError, match="quaternions of non-zero norm"):
        reward.task_of(arm.state, goal)
    goal[1, 0, 0] = math.nan
    with pytest.raises(ValueError, match=r"target of ImitatePose has nan at index \(1, 0, 0\)"):
        reward.task_of(arm.state, goal)
    with pytest.raises(ValueError, match=r"target of ImitatePose must be \[4, 10, 13\]"):
        reward.task_of(arm.state, arm.state[0])
    with pytest.raises(ValueError, match=r"ImitatePose needs a task: .* \[10, 13\]"):
        reward(arm.state, None, arm.next_state)
    with pytest.raises(ValueError, match=r"task of ImitatePose must be \[4, 10, 13\], got \[4, 7\]"):
        reward(arm.state, None, arm.next_state, torch.zeros(4, 7))


def test_freeze_goal_passes_the_target_on(arm):
    fixed = FreezeGoal(make_reward("palm_pose", arm.scene))(
        TensorDict({"state": arm.state, "target": arm.path[:, 2]}, batch_size=[4])
    )
    assert torch.equal(fixed["task"], arm.path[:, 2])
