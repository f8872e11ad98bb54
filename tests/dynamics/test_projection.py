"""Projection onto the joint constraints: joined bodies stay together, and are predicted better for it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics.constraints.generalized_coordinates import GeneralizedProjection
from torchrl_gn.dynamics.constraints.maximal_coordinates import MaximalProjection, position_weight
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.scenes import load_scene
from torchrl_gn.scenes.physical_parameters import joint_axes

from .. import zoo

pytestmark = pytest.mark.filterwarnings("ignore::torchrl_gn.data.UncontrolledSceneWarning")  # a creature has no motors

SYSTEMS = ["cartpole", "acrobot", "swimmer6", "cheetah", "walker2d", "jaco"]
CONSTRAINED = [*SYSTEMS, "creature", "crawler"]


def project(bound, state, delta):
    weight, matrices = position_weight(bound.model.delta_normalizer.std), bound.canonicalizer.matrices(state)
    return bound.projection(state, matrices, delta, weight, bound.scene_parameters)


def gaps(scene, state):
    """How far, and how fast, every joint's anchor is apart on its two bodies."""
    joint_anchors = scene.joint_anchors
    frame = quaternion.to_matrix(state[..., 3:7]).unflatten(-1, (3, 3))
    places, speeds = [], []
    for node, anchors in (
        (joint_anchors.parent, joint_anchors.parent_anchor),
        (range(scene.num_nodes), joint_anchors.child_anchor),
    ):
        node = torch.as_tensor(list(node))
        child_anchor = (frame[..., node, :, :] @ torch.as_tensor(anchors).unsqueeze(-1)).squeeze(-1)
        places.append(state[..., node, :3] + child_anchor)
        speeds.append(state[..., node, 7:10] + torch.linalg.cross(state[..., node, 10:13], child_anchor))
    return (places[1] - places[0]).abs().max(), (speeds[1] - speeds[0]).abs().max()


@pytest.mark.parametrize("name", CONSTRAINED)
def test_true_changes_are_linked_already(make_model, name):
    scene = zoo.load(name, timestep={"creature": 0.002, "crawler": 0.005}.get(name))
    trajectories = collect_trajectories(scene, 2, 20)
    state, after = trajectories["state"][:, :-1], trajectories["state"][:, 1:]
    assert max(gaps(scene, state)) < 1e-12
    bound = make_model(scene, fitted=False).bind(scene)
    delta = BODY_STATE.delta(state, after)
    torch.testing.assert_close(project(bound, state, delta), delta, rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONSTRAINED)
def test_pinned_bodies_stay_together(make_model, random_actions, name):
    scene = zoo.load(name)
    trajectories = collect_trajectories(scene, 2, 20)
    state = trajectories["state"][:, -1].clone()
    moving = torch.as_tensor(scene.movable[:, :3]).double()
    state[..., :3] += 0.01 * moving  # where the network's errors may have led
    bound, loose = (make_model(scene, project=project).bind(scene) for project in (True, False))
    actions = random_actions(scene, 2, 20)
    assert max(gaps(scene, bound.rollout(state, actions)[0][:, 1:].detach())) < 1e-10
    assert max(gaps(scene, loose.rollout(state, actions)[0][:, 1:].detach())) > 1e-4


def test_parallel_hinges_at_one_place_share_their_turn_in_single_precision_too(make_model, random_states):
    scene = zoo.load("parallel_hinges", timestep=0.002)
    bound = make_model(scene, fitted=False).bind(scene)
    assert isinstance(bound.projection, GeneralizedProjection)
    state = collect_trajectories(scene, 20, 5, seed=0)["state"][:, -1]
    delta = BODY_STATE.delta(state, random_states(scene, 20, scale=0.1))
    delta = 0.1 * delta / delta.abs().amax((-2, -1), keepdim=True)
    single, double = (project(bound, state.to(dtype), delta.to(dtype)) for dtype in (torch.float32, torch.float64))
    assert (single - double).norm() < 1e-5 * double.norm()


def test_a_body_that_turns_about_one_place_needs_no_linking(make_model):
    scene = load_scene("pendulum")
    bound, projection = make_model(scene).bind(scene), MaximalProjection(scene)
    assert scene.joint_anchors.ancestors.any() and bound.projection is None
    trajectories = collect_trajectories(scene, 2, 20)
    state = trajectories["state"][:, :-1]
    delta, matrices = bound.delta(state, trajectories["action"]).detach(), bound.canonicalizer.matrices(state)
    assert torch.equal(
        projection(state, matrices, delta, position_weight(bound.model.delta_normalizer.std), bound.scene_parameters),
        delta,
    )


def off_axis(scene, state):
    """Return the rotations of hinges about wrong axes, rad, and their rates, rad/s."""
    joints = scene.model.jnt_bodyid
    edges, count = np.arange(0, 2 * len(joints), 2), np.bincount(joints)[joints]
    single = (scene.model.jnt_type == 3) & (count == 1)
    edges, nodes = edges[single], joint_axes(scene)
    parent, child = (torch.as_tensor(index[edges].copy()) for index in (scene.senders, scene.receivers))
    axis = quaternion.rotate(state[..., nodes[0][single], 3:7], torch.as_tensor(nodes[1][single]))
    spin = state[..., child, 10:13] - state[..., parent, 10:13]
    relative = quaternion.product(quaternion.conjugate(state[..., parent, 3:7]), state[..., child, 3:7])
    return relative, spin - (spin * axis).sum(-1, keepdim=True) * axis


@pytest.mark.parametrize("name", ["jaco", "creature", "crawler"])
def test_hinges_turn_about_their_axes_alone(make_model, random_actions, name):
    scene = zoo.load(name)
    bound = make_model(scene).bind(scene)
    assert isinstance(bound.projection, GeneralizedProjection)
    state = collect_trajectories(scene, 2, 20)["state"][:, -1]
    states = bound.rollout(state, random_actions(scene, 2, 20))[0].detach()
    relative, spin = off_axis(scene, states)
    assert spin.abs().max() < 1e-9
    # From step to step the relative rotation changes about the axis, which its parent carries.
    nodes, axes = joint_axes(scene)
    step = quaternion.log(quaternion.product(relative[:, 1:], quaternion.conjugate(relative[:, :-1])))
    joints = np.bincount(scene.model.jnt_bodyid)[scene.model.jnt_bodyid]
    single = (scene.model.jnt_type == 3) & (joints == 1)
    axis = torch.as_tensor(axes[single])
    assert step.norm(dim=-1).max() > 1e-3
    assert torch.linalg.cross(step, axis.expand_as(step)).abs().max() < 1e-9


@pytest.mark.parametrize("name", ["jaco", "creature"])
def test_linking_by_joints_takes_noise_away(make_model, name):
    """Generalised coordinates leave less of a random error than maximal ones, which leave less than it was."""
    scene = zoo.load(name)
    bound = make_model(scene).bind(scene)
    states = collect_trajectories(scene, 4, 20)["state"]
    delta = BODY_STATE.delta(states[:, :-1], states[:, 1:])
    std = delta.flatten(0, 2).std(0)
    generator = torch.Generator().manual_seed(0)
    movable = bound.movable[:, :12]  # without unwrapped angles
    noisy = delta + 0.1 * std * torch.randn(delta.shape, generator=generator, dtype=torch.float64) * movable
    seen = std > 1e-9
    seen_from = states[:, :-1], bound.canonicalizer.matrices(states[:, :-1])
    left = [
        ((by(*seen_from, noisy, position_weight(std), bound.scene_parameters) - delta)[..., seen] / std[seen])
        .square()
        .mean()
        for by in (GeneralizedProjection(scene), MaximalProjection(scene), lambda _, __, change, *___: change)
    ]
    assert left[0] < 0.9 * left[1] < 0.8 * left[2]


@pytest.mark.parametrize("name", ["cartpole", "swimmer6", "cheetah"])
def test_in_the_plane_both_ways_are_the_same(make_model, name):
    scene = zoo.load(name)
    bound = make_model(scene).bind(scene)
    assert type(bound.projection) is MaximalProjection
    state = collect_trajectories(scene, 4, 20)["state"][:, -1].clone()
    state[..., 7:] = 0  # where bodies move, the one solves for rates before turning and the other after
    generator = torch.Generator().manual_seed(0)
    raw = 1e-4 * torch.randn(4, scene.num_nodes, 12, generator=generator, dtype=torch.float64) * bound.movable
    std = torch.ones(12, dtype=torch.float64)
    matrices = bound.canonicalizer.matrices(state)
    ours, theirs = (
        by(state, matrices, raw, position_weight(std), bound.scene_parameters)
        for by in (GeneralizedProjection(scene), MaximalProjection(scene))
    )
    assert (ours - theirs).norm() < 1e-3 * raw.norm()


@pytest.mark.slow
def test_gradients_of_linking_by_joints(make_model):
    scene = load_scene("jaco")
    bound = make_model(scene).bind(scene)
    state = collect_trajectories(scene, 1, 5)["state"][0, -1:]
    generator = torch.Generator().manual_seed(0)
    raw = 1e-2 * torch.randn(1, scene.num_nodes, 12, generator=generator, dtype=torch.float64) * bound.movable
    std = torch.ones(12, dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda delta: bound.projection(
            state,
            bound.canonicalizer.matrices(state),
            delta * bound.movable,
            position_weight(std),
            bound.scene_parameters,
        ),
        (raw.requires_grad_(),),
    )


def test_a_mechanism_moves_as_its_bodies_mean(scenes, make_model, random_actions):
    """Changes on which the bodies disagree are averaged; changes on which they agree are kept."""
    scene = scenes["swimmer6"]
    bound = make_model(scene, fitted=False).bind(scene)
    state = collect_trajectories(scene, 2, 3)["state"][:, -1]
    generator = torch.Generator().manual_seed(0)
    change = 0.01 * torch.randn(2, 7, 12, generator=generator, dtype=torch.float64) * bound.movable
    change[..., 3:6] = change[..., 9:] = 0
    projected = project(bound, state, change)
    shared = change[:, 1:, [0, 1, 6, 7]].mean(1, keepdim=True).expand(-1, 6, -1)
    torch.testing.assert_close(projected[:, 1:, [0, 1, 6, 7]], shared, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", CONSTRAINED)
def test_the_jacobian_is_the_derivative_of_positions(make_model, name):
    """How rotations move joined bodies, against differences."""
    scene = zoo.load(name)
    bound = make_model(scene).bind(scene)
    state = collect_trajectories(scene, 2, 5)["state"][:, -1]
    generator = torch.Generator().manual_seed(0)
    movable = torch.as_tensor(scene.movable)
    turn = torch.randn(2, scene.num_nodes, 3, generator=generator, dtype=torch.float64) * movable[:, 9:12]
    still = torch.zeros_like(turn)

    projection, matrices = bound.projection, bound.canonicalizer.matrices(state)
    offsets = projection.offsets(matrices, bound.scene_parameters)

    root = torch.as_tensor(scene.joint_anchors.root)
    together = (root[:, None] == root).double()
    mean, root_moves = together / together.sum(1, keepdim=True), movable[root, :3]

    def apart(turn):
        places = projection.forward_kinematics(state, offsets, turn, still)[1][:, 0].view_as(turn)
        return places - torch.where(root_moves, mean @ places, still)

    moved = torch.zeros_like(turn).flatten(1)
    turned = turn.flatten(1)[:, projection.rotating].unsqueeze(-1)
    moved[:, projection.moved_rows] = (projection.jacobian(offsets) @ turned).squeeze(-1)
    moved = moved.view_as(turn)
    torch.testing.assert_close((apart(1e-6 * turn) - apart(-1e-6 * turn)) / 2e-6, moved, rtol=1e-6, atol=1e-8)


def test_what_bodies_disagree_on_is_settled_by_least_squares(make_model):
    """No other projected change is nearer to the network's, in units of each component's spread."""
    scene = load_scene("swimmer6")
    bound = make_model(scene).bind(scene)
    state = collect_trajectories(scene, 2, 5)["state"][:, -1]
    generator = torch.Generator().manual_seed(0)
    raw = 1e-5 * torch.randn(2, 7, 12, generator=generator, dtype=torch.float64) * bound.movable
    projected = project(bound, state, raw)
    std = bound.model.delta_normalizer.std
    v, w = std[6:9].norm(), std[9:].norm()

    def distance(delta):
        return ((delta - raw)[..., 6:9] / v).square().sum() + ((delta - raw)[..., 9:] / w).square().sum()

    nearest = distance(projected)
    assert nearest < distance(torch.zeros_like(raw))
    for seed in range(5):
        other = (
            torch.randn(2, 7, 12, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * bound.movable
        )
        assert distance(project(bound, state, projected + 1e-6 * other)) > nearest * (1 - 1e-6)


@pytest.mark.slow
def test_what_damping_locks_stays_in_rollouts(make_model):
    """A base on locked slides and a wrist that is locked, under predictions of random weights."""
    text = """<mujoco><worldbody><body name="base"><joint type="slide" axis="1 0 0" damping="1e11"/>
      <joint type="slide" axis="0 1 0" damping="1e11"/><geom size=".1" mass="80"/>
      <body name="upper" pos="0 0 .2"><joint axis="0 1 0" damping="1"/><geom size=".1" pos=".3 0 0"/>
      <body name="lower" pos=".6 0 0"><joint axis="0 0 1" damping="1"/><geom size=".1" pos=".3 0 0"/>
      <body name="hand" pos=".6 0 0"><joint axis="1 1 0" damping="{}"/><geom size=".1" pos=".3 .1 0"/>
      </body></body></body></body></worldbody></mujoco>"""
    turned = {}
    for damping in ("1e11", "1"):
        scene = load_scene(text.format(damping))
        bound = make_model(scene).bind(scene)
        states = bound.rollout(bound.reference_state, torch.zeros(20, 0, dtype=torch.float64))[0].detach()
        torch.testing.assert_close(states[:, 1], states[:1, 1].expand(21, -1), rtol=0, atol=0)
        lower, hand = (states[:, node, 3:7] for node in (3, 4))
        wrist = quaternion.product(quaternion.conjugate(lower), hand)
        turned[damping] = float(wrist.diff(dim=0).abs().max())
        assert float(lower.diff(dim=0).abs().max()) > 1e-3
    assert turned["1e11"] < 1e-9 < 1e-4 < turned["1"]
