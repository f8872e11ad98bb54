"""Every row of the paper's planning table against MuJoCo's own numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.maths import BODY_STATE
from torchrl_gn.rewards import (
    AngularSpeed,
    Balance,
    Position,
    Upright,
    Velocity,
    VerticalDistance,
    available_rewards,
    make_reward,
)
from torchrl_gn.scenes import load_scene, sample_variants

WALKER = ("torso", "right_thigh", "left_thigh", "right_leg", "left_leg")
JACO = [*(f"b_{i}" for i in range(1, 7)), *(f"jaco_hand/b_finger_{i}" for i in (1, 2, 3))]


def angle(truth) -> np.ndarray:
    """Angle of a body's rotation from upright, by its matrix."""
    return np.arccos(np.clip((np.trace(truth.rotation, axis1=1, axis2=2) - 1) / 2, -1, 1))


def uprightness(steps, *bodies) -> np.ndarray:
    return -sum(angle(steps.truth(body)) for body in bodies)


def reach(steps, target) -> np.ndarray:
    before, after = (steps.truth("head", step).position for step in (-2, -1))
    rows = []
    for old, new, goal in zip(before, after, target.numpy(), strict=True):
        toward = (goal - old)[:2] / np.hypot(*(goal - old)[:2])
        moved = (new - old)[:2]
        rows.append(moved @ toward - 0.01 * (moved @ np.array([-toward[1], toward[0]])) ** 2)
    return np.array(rows)


def pose(steps, target_step, *bodies) -> np.ndarray:
    """Squared distance and squared sine of half the angle, by positions and matrices."""
    total = 0.0
    for body in bodies:
        now, then = steps.truth(body), steps.truth(body, target_step)
        total = total - ((now.position - then.position) ** 2).sum(-1)
        cosine = (np.einsum("bij,bij->b", now.rotation, then.rotation) - 1) / 2
        total = total - (1 - cosine) / 2
    return total


def feet(steps) -> np.ndarray:
    torso = steps.truth("torso").position[:, 2]
    return sum((steps.truth(foot).position[:, 2] - torso) ** 2 for foot in ("right_foot", "left_foot"))


TARGET_STEP = 3  # of the simulated path: what the arm shall imitate
LOCATION = torch.tensor([[1.0, 2.0, 0.0], [-1.0, 0.3, 5.0], [0.0, -4.0, 0.1], [3.0, 0.0, 0.0]], dtype=torch.float64)

# (system, task): the reward by hand.
EXPECTED = {
    ("pendulum", "balance"): lambda s: uprightness(s, "pole"),
    ("cartpole", "balance"): lambda s: uprightness(s, "pole_1"),
    ("acrobot", "swing_up"): lambda s: uprightness(s, "upper_arm", "lower_arm"),
    ("swimmer6", "reach"): lambda s: reach(s, LOCATION),
    ("cheetah", "forward"): lambda s: s.truth("torso").linear[:, 0],
    ("cheetah", "height"): lambda s: s.truth("torso").position[:, 2],
    ("cheetah", "vertical_speed"): lambda s: s.truth("torso").linear[:, 2] ** 2,
    ("cheetah", "spin"): lambda s: (s.truth("torso").angular ** 2).sum(-1),
    ("walker2d", "forward"): lambda s: s.truth("torso").linear[:, 0],
    ("walker2d", "height"): lambda s: s.truth("torso").position[:, 2],
    ("walker2d", "inverse_verticality"): lambda s: uprightness(s, *WALKER),
    ("walker2d", "feet_to_head"): feet,
    ("jaco", "palm_pose"): lambda s: pose(s, TARGET_STEP, "jaco_hand/hand"),
    ("jaco", "full_pose"): lambda s: pose(s, TARGET_STEP, *JACO),
}
ROWS = pytest.mark.parametrize(("system", "task"), EXPECTED, ids=["-".join(row) for row in EXPECTED])


def target_of(steps, reward) -> torch.Tensor | None:
    if reward.target_shape is None:
        return None
    return LOCATION if reward.target_shape == (3,) else steps.path[:, TARGET_STEP]


def task_of(steps, reward) -> torch.Tensor | None:
    target = target_of(steps, reward)
    return None if target is None else reward.task_of(steps.state, target)


@ROWS
def test_is_what_the_table_says(steps, system, task):
    moving = steps(system)
    reward = make_reward(task, moving.scene)
    got = reward(moving.state, moving.action, moving.next_state, task_of(moving, reward))
    wanted = EXPECTED[system, task](moving)
    assert got.shape == (4, 1)
    np.testing.assert_allclose(got.squeeze(-1), wanted, rtol=1e-9, atol=1e-9)
    assert np.abs(wanted).max() > 1e-6 and np.ptp(wanted) > 1e-7  # there is something to compare


def test_all_rows_are_there_and_nothing_else():
    families = {("swimmerN" if system == "swimmer6" else system, task) for system, task in EXPECTED}
    of_the_suite = {("cheetah", "run"), ("walker2d", "run"), ("swimmerN", "near")}  # in test_suite.py
    assert len(families) == 14 and len(available_rewards()) == 17
    assert set(available_rewards()) == families | of_the_suite


@ROWS
def test_gradients_are_the_finite_differences(steps, system, task):
    moving = steps(system)
    reward = make_reward(task, moving.scene)
    fixed = task_of(moving, reward)
    # One sample is enough, and off the exact zeros of planar motion.
    generator = torch.Generator().manual_seed(0)
    state, next_state = (
        (full[0] + 0.02 * torch.randn(full[0].shape, generator=generator, dtype=torch.float64)).requires_grad_()
        for full in (moving.state, moving.next_state)
    )
    if fixed is None:
        assert torch.autograd.gradcheck(lambda after: reward(None, None, after), (next_state,))
        return
    goal = fixed[0].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda *args: reward(args[0], None, *args[1:]), (state, next_state, goal))
    target = target_of(moving, reward)[0].clone().requires_grad_()
    assert torch.autograd.gradcheck(reward.task_of, (state, target))


@ROWS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_the_ends(steps, system, task, dtype):
    """Upright, half a turn about each axis, at rest, with the target reached and not."""
    scene = steps(system).scene
    reward = make_reward(task, scene)
    state = torch.zeros(4, scene.num_nodes, 13, dtype=dtype)
    state[torch.arange(4), :, 3 + torch.arange(4)] = 1
    targets: list[torch.Tensor | None] = [None]
    if reward.target_shape == (3,):
        targets = [torch.zeros(4, 3), torch.full((4, 3), 1e-12), torch.ones(4, 3)]
    elif reward.target_shape is not None:
        state[..., :3] = steps(system).state[0, :, :3].to(dtype)
        targets = [state.clone(), state.roll(1, 0)]
    for target in targets:
        start, after = state.clone().requires_grad_(), state.clone().requires_grad_()
        goal = None
        if target is not None:
            target = target.requires_grad_()
            goal = reward.task_of(start, target)
        value = reward(start, None, after, goal)
        assert value.isfinite().all() and value.dtype == dtype
        value.sum().backward()
        for leaf in (start, after, target):
            assert leaf is None or leaf.grad is None or leaf.grad.isfinite().all()
        assert after.grad is not None


@ROWS
def test_takes_any_batch_and_dtype(steps, system, task):
    moving = steps(system)
    reward = make_reward(task, moving.scene)
    goal = task_of(moving, reward)
    flat = reward(moving.state, moving.action, moving.next_state, goal)

    def batched(x):
        return (
            None if x is None else x.unflatten(0, (2, 2)).unsqueeze(1).expand(2, 5, *x.unflatten(0, (2, 2)).shape[1:])
        )

    whole = reward(*map(batched, (moving.state, moving.action, moving.next_state, goal)))
    assert whole.shape == (2, 5, 2, 1)
    torch.testing.assert_close(whole[:, 3].flatten(0, 1), flat, rtol=1e-13, atol=1e-13)
    single = reward(*(None if x is None else x.float() for x in (moving.state, moving.action, moving.next_state, goal)))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), flat, rtol=1e-4, atol=1e-5)
    one = reward(moving.state[1], moving.action[1], moving.next_state[1], None if goal is None else goal[1])
    torch.testing.assert_close(one, flat[1], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    ("system", "bodies"), [("cartpole", ["pole_1"]), ("acrobot", ["upper_arm", "lower_arm"]), ("pendulum", ["pole"])]
)
def test_poles_without_rotation_stand(steps, system, bodies):
    """Poles with the identity rotation have their masses straight above their joints."""
    scene = steps(system).scene
    for body in bodies:
        centre = scene.model.body_ipos[scene.model.body(body).id]
        np.testing.assert_allclose(centre, [0, 0, 0.5], atol=1e-12)
        joint = scene.model.body(body).jntadr[0]
        np.testing.assert_array_equal(scene.model.jnt_pos[joint], 0)


def test_walker_without_rotation_stands(steps):
    model = steps("walker2d").scene.model
    for side in ("right", "left"):
        chain = ["torso", f"{side}_thigh", f"{side}_leg", f"{side}_foot"]
        for name in chain:
            np.testing.assert_array_equal(model.body(name).quat, [1, 0, 0, 0])
        for below in chain[1:]:
            assert model.body(below).pos[2] < -0.2


def test_a_walker_on_its_head_is_balances_target(steps):
    scene = steps("walker2d").scene
    upright, inverted = make_reward("inverse_verticality", scene), Balance(scene, WALKER, target=np.array([0, 0, 1, 0]))
    state = torch.zeros(2, scene.num_nodes, 13, dtype=torch.float64)
    state[0, :, 3] = 1
    state[1, :, 5] = 1
    torch.testing.assert_close(upright(None, None, state).flatten().tolist(), [0.0, -5 * np.pi])
    torch.testing.assert_close(inverted(None, None, state).flatten().tolist(), [-5 * np.pi, 0.0])


@pytest.mark.parametrize(("axis", "component"), [("x", 0), ("y", 1), ("z", 2)])
def test_axes_and_powers(steps, axis, component):
    moving = steps("jaco")
    truth = moving.truth("jaco_hand/hand")
    at = Position(moving.scene, "jaco_hand/hand", axis)(None, None, moving.next_state)
    np.testing.assert_allclose(at.squeeze(-1), truth.position[:, component], rtol=1e-12, atol=1e-14)
    for power in (1, 2, 3):
        speed = Velocity(moving.scene, "jaco_hand/hand", axis, power=power)(None, None, moving.next_state)
        np.testing.assert_allclose(speed.squeeze(-1), truth.linear[:, component] ** power, rtol=1e-7, atol=1e-15)
    spin = AngularSpeed(moving.scene, "jaco_hand/hand")(None, None, moving.next_state)
    np.testing.assert_allclose(spin.squeeze(-1), (truth.angular**2).sum(-1), rtol=1e-9)


@pytest.mark.parametrize(("axis", "component"), [("x", 0), ("y", 1), ("z", 2)])
def test_velocity_along_an_own_axis_and_towards_a_goal(steps, axis, component):
    moving = steps("jaco")
    scene, truth = moving.scene, moving.truth("jaco_hand/hand")
    along = np.einsum("mij,mi->mj", truth.rotation, truth.linear)[:, component]
    own = Velocity(scene, "jaco_hand/hand", axis, own=True)(None, None, moving.next_state)
    np.testing.assert_allclose(own.squeeze(-1), along, rtol=1e-7, atol=1e-12)
    for power in (1, 2):
        reward = Velocity(scene, "jaco_hand/hand", axis, own=True, goal=0.3, power=power)
        kept = reward(None, None, moving.next_state).squeeze(-1)
        np.testing.assert_allclose(kept, -(abs(along - 0.3) ** power), rtol=1e-7, atol=1e-12)
    with pytest.raises(ValueError, match="goal must be a finite velocity"):
        Velocity(scene, "jaco_hand/hand", axis, goal=np.nan)


def test_upright_leaves_the_yaw_open(steps):
    moving = steps("jaco")
    truth = moving.truth("jaco_hand/hand")
    upright = Upright(moving.scene, "jaco_hand/hand")
    np.testing.assert_allclose(upright(None, None, moving.next_state).squeeze(-1), truth.rotation[:, 2, 2], rtol=1e-9)
    turned = BODY_STATE.rotate(moving.next_state, torch.tensor([0.6, 0.0, 0.0, 0.8], dtype=torch.float64))
    torch.testing.assert_close(upright(None, None, turned), upright(None, None, moving.next_state))


@pytest.mark.parametrize("system", ["pendulum", "cartpole", "swimmer4", "cheetah", "jaco"])
def test_variants_have_the_rewards_of_their_system(system):
    scene = sample_variants(system, 1, rng=0)[0]
    family = "swimmerN" if system.startswith("swimmer") else system
    tasks = [task for name, task in available_rewards() if name == family]
    assert tasks
    for task in tasks:
        assert make_reward(task, scene).extra_repr().startswith(f"scene={scene.name!r}")


def test_a_system_by_another_name_is_still_that_system():
    assert "body='head'" in repr(make_reward("reach", load_scene("swimmer3", name="fish")))


def test_other_systems_tasks_are_refused(steps):
    with pytest.raises(ValueError, match=r"no reward 'reach' for scene 'cheetah'; there are: .*reach \(swimmerN\)"):
        make_reward("reach", steps("cheetah").scene)
    with pytest.raises(ValueError, match="no reward 'forward' for scene 'jaco'"):
        make_reward("forward", steps("jaco").scene)


def test_bad_arguments_are_named(steps):
    scene = steps("walker2d").scene
    with pytest.raises(ValueError, match="axis must be one of x, y, z, got 'up'"):
        Velocity(scene, "torso", "up")
    with pytest.raises(ValueError, match="axis must be one of x, y, z, got 2"):
        Position(scene, "torso", 2)
    for power in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="power must be a whole number from 1"):
            Velocity(scene, "torso", "x", power=power)
    for build in (
        lambda: Velocity(scene, "head", "x"),
        lambda: Position(scene, "head", "x"),
        lambda: AngularSpeed(scene, "head"),
        lambda: VerticalDistance(scene, ["head"], "torso"),
        lambda: VerticalDistance(scene, ["left_foot"], "head"),
    ):
        with pytest.raises(ValueError, match="'walker2d' has no body 'head'"):
            build()


def test_rewards_without_target_say_so(steps):
    reward = make_reward("height", steps("cheetah").scene)
    assert reward.target_shape is None
    with pytest.raises(ValueError, match="Position needs no target"):
        reward.task_of(steps("cheetah").state, torch.zeros(4, 3))


def test_vertical_distance_counts_below_and_above_alike(steps):
    scene = steps("walker2d").scene
    state = torch.zeros(scene.num_nodes, 13, dtype=torch.float64)
    for name, height in (("right_foot", 0.5), ("left_foot", -0.25), ("torso", 0.1)):
        state[scene.node_names.index(name), 2] = height
    value = VerticalDistance(scene, ["right_foot", "left_foot"], "torso")(None, None, state)
    assert value.item() == pytest.approx(0.4**2 + 0.35**2, rel=1e-12)
