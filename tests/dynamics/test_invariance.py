"""Predictions move and turn with the scene."""

from __future__ import annotations

from dataclasses import asdict

import pytest
import torch

from torchrl_gn.dynamics import BodyState, Canonicalizer, Contacts, Controls, JointAxes, Predictor, specialize
from torchrl_gn.dynamics.bound import dynamic_graph
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.features.contacts import BoundContacts
from torchrl_gn.dynamics.features.feature import StepInputs
from torchrl_gn.maths import BODY_STATE, quaternion
from torchrl_gn.scenes import load_scene

from .. import zoo


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["swimmer6", "cheetah", "falling", "crawler"])
def test_predictions_do_not_depend_on_the_place(scenes, make_model, random_states, random_actions, name, dtype):
    """A thousand kilometres away, along axes without landmarks, the same change is predicted."""
    scene = scenes.get(name) or zoo.load(name)
    bound = make_model(scene).to(dtype).bind(scene)
    state, action = random_states(scene, 10, seed=3), random_actions(scene, 10)
    delta = bound.delta(state, action)
    axes = torch.as_tensor(scene.translation_invariant, dtype=torch.float64)
    assert axes.any()
    far = state.clone()
    far[:, 1:, :3] += 1e6 * axes
    assert (bound.delta(far, action) - delta).norm() < 1e-6 * delta.norm()
    # Near places to the last digits: the float32 input is the same up to float64's rounding.
    near = state.clone()
    near[:, 1:, :3] += axes
    assert (bound.delta(near, action) - delta).norm() < 1e-7 * delta.norm()


def test_place_matters_along_other_axes_and_without_recentring(scenes, make_model, random_states, random_actions):
    scene = scenes["cheetah"]
    state, action = random_states(scene, 10, seed=3), random_actions(scene, 10)
    up, along = state.clone(), state.clone()
    up[:, 1:, 2] += 1
    along[:, 1:, 0] += 1
    bound = make_model(scene).bind(scene)
    assert (bound.delta(up, action) - bound.delta(state, action)).norm() > 1e-3
    absolute = make_model(scene, canonicalizer=Canonicalizer(recenter=False)).bind(scene)
    assert (absolute.delta(along, action) - absolute.delta(state, action)).norm() > 1e-3


@pytest.mark.parametrize(("name", "hidden"), [("swimmer6", [0, 1]), ("cheetah", [0]), ("pendulum", [])])
def test_positions_along_invariant_axes_can_be_hidden(scenes, make_model, random_states, random_actions, name, hidden):
    """One body moves against its joint: the network's inputs change only if the axis is not hidden."""
    scene = scenes[name]
    features = (BodyState(positions=False), Controls(), JointAxes(), Contacts())
    absolute = {"project": False, "canonicalizer": Canonicalizer(recenter=False)}
    bound = make_model(scene, features=features, **absolute).bind(scene)
    state, action = random_states(scene, 10, seed=3), random_actions(scene, 10)
    seen = dynamic_graph(bound, state, action).nodes
    for axis in range(3):
        moved = state.clone()
        moved[:, 1, axis] += 0.5
        same = torch.equal(dynamic_graph(bound, moved, action).nodes, seen)
        assert same or axis not in hidden
        assert not same or axis in hidden or not scene.movable[:, axis].any()
    default = make_model(scene, **absolute).bind(scene)
    for axis in hidden:
        moved = state.clone()
        moved[:, 1, axis] += 0.5
        shown, before = (dynamic_graph(default, each, action).nodes for each in (moved, state))
        assert not torch.equal(shown, before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["swimmer6", "arm"])
def test_predictions_turn_with_the_scene(scenes, make_model, random_states, random_actions, name, dtype):
    """Turned by any angle about the axis of its yaw_frame, a scene changes in the same way, turned."""
    scene = zoo.load("arm") if name == "arm" else scenes[name]
    yaw_frame = scene.yaw_frame
    assert yaw_frame is not None
    bound = make_model(scene).to(dtype).bind(scene)
    state, action = random_states(scene, 10, seed=3), random_actions(scene, 10)
    # The root's orientation is a turn about the axis, as its joint allows.
    spin = torch.zeros(10, 3, dtype=state.dtype)
    spin[:, yaw_frame.axis] = torch.linspace(-3, 3, 10)
    rest = torch.as_tensor(yaw_frame.rest).expand(10, 4)
    state[:, yaw_frame.node, 3:7] = quaternion.product(quaternion.exp(spin), rest)
    delta = bound.delta(state, action)
    for angle in (1e-8, 0.8, torch.pi, -2.0):
        turn = quaternion.exp(angle * torch.eye(3, dtype=state.dtype)[yaw_frame.axis]).expand(10, 4)
        pivot = torch.zeros(13, dtype=state.dtype)
        pivot[:3] = torch.as_tensor(yaw_frame.pivot)
        turned = torch.cat((state[:, :1], (BODY_STATE.rotate(state - pivot, turn) + pivot)[:, 1:]), 1)
        error = bound.delta(turned, action) - BODY_STATE.rotate_delta(delta, turn)
        assert error.norm() < (1e-12 if dtype == torch.float64 else 1e-5) * delta.norm()
    plain = make_model(scene, canonicalizer=Canonicalizer(yaw=False)).bind(scene)
    error = plain.delta(turned, action) - BODY_STATE.rotate_delta(plain.delta(state, action), turn)
    assert error.norm() > 1e-3 * delta.norm()


@pytest.mark.parametrize("integrate", [True, False])
def test_predictions_turn_with_free_roots(make_model, random_states, random_actions, integrate):
    """Rotated and shifted, two free trees on the ground change in the same way, rotated, however they are tilted."""
    scene = zoo.load("crawler")
    bound = make_model(scene, integrate=integrate).double().bind(scene)
    state, action = random_states(scene, 30, seed=3), random_actions(scene, 30)
    delta = bound.delta(state, action)
    for angle in (1e-8, 0.8, torch.pi, -2.0):
        turn = quaternion.exp(angle * torch.eye(3, dtype=state.dtype)[2]).expand(30, 4)
        turned = torch.cat((state[:, :1], BODY_STATE.rotate(state, turn)[:, 1:]), 1)
        turned[:, 1:, :2] += torch.tensor([30.0, -50])
        error = bound.delta(turned, action) - BODY_STATE.rotate_delta(delta, turn)
        assert error.norm() < 1e-10 * delta.norm()
    plain = make_model(scene, canonicalizer=Canonicalizer(yaw=False)).double().bind(scene)
    error = plain.delta(turned, action) - BODY_STATE.rotate_delta(plain.delta(state, action), turn)
    assert error.norm() > 1e-3 * delta.norm()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_predictions_rotate_with_scenes_without_gravity(make_model, random_states, random_actions, dtype):
    """Rotated about any axis, a fish in water without gravity changes in the same way, rotated; natively, too."""
    scene = load_scene("suite:fish/swim")
    assert scene.yaw_frame is not None and scene.yaw_frame.axis is None
    bound = make_model(scene).to(dtype).bind(scene)
    native = specialize(bound)
    state, action = random_states(scene, 20, seed=3), random_actions(scene, 20)
    delta, scale = bound.delta(state, action), 1e-10 if dtype == torch.float64 else 1e-4
    assert (native.delta(state, action) - delta).norm() < scale * delta.norm()
    rotations = quaternion.normalize(torch.randn(20, 4, generator=torch.Generator().manual_seed(0)).double())
    rotated = torch.cat((state[:, :1], scene.layout.rotate(state, rotations)[:, 1:]), 1)
    rotated[:, 1:, :3] += torch.tensor([3.0, -5, 7])
    wanted = scene.layout.rotate_delta(delta, rotations)
    for model in (bound, native):
        assert (model.delta(rotated, action) - wanted).norm() < scale * delta.norm()
    only_yaw = make_model(scene, canonicalizer=Canonicalizer(full_rotation=False)).to(dtype).bind(scene)
    assert only_yaw.canonicalizer.yaw_frame is not None and only_yaw.canonicalizer.yaw_frame.axis == 2
    delta = only_yaw.delta(state, action)
    assert (only_yaw.delta(rotated, action) - scene.layout.rotate_delta(delta, rotations)).norm() > 1e-3 * delta.norm()
    yaw = quaternion.normalize(rotations * torch.tensor([1.0, 0, 0, 1]))
    rotated = torch.cat((state[:, :1], scene.layout.rotate(state, yaw)[:, 1:]), 1)
    wanted = scene.layout.rotate_delta(delta, yaw)
    assert (only_yaw.delta(rotated, action) - wanted).norm() < scale * delta.norm()


def test_descriptions_of_older_models_have_no_full_rotation():
    assert Canonicalizer.from_description({"recenter": True, "yaw": True}) == Canonicalizer(full_rotation=False)
    assert Canonicalizer.from_description(asdict(Canonicalizer())) == Canonicalizer()


def test_contacts_with_the_ground_do_not_show_the_yaw(make_model, random_states):
    """Heights and approach speeds of contact points are in the world frame, their velocities rotated."""
    scene = zoo.load("crawler")
    bound, plain = (make_model(scene, canonicalizer=Canonicalizer(yaw=yaw)).bind(scene) for yaw in (True, False))
    state = random_states(scene, 10, seed=3)
    canonical, world = (each.canonicalizer(state, each.scene_parameters) for each in (bound, plain))
    controls = torch.zeros(10, scene.num_edges, 1, dtype=state.dtype)
    seen, true = (
        BoundContacts(scene)(StepInputs(each, controls, bound.scene_parameters)).unflatten(-1, (-1, 6))
        for each in (canonical, world)
    )
    torch.testing.assert_close(seen[..., :3], true[..., :3])
    back = canonical.rotation.matrix.mT[:, None, None]
    torch.testing.assert_close(seen[..., 3:], (back @ true[..., 3:, None]).squeeze(-1))
    assert true[..., 0].abs().max() > 0.1


TILTS = (0.0, 1e-300, 1e-30, 1e-9, 1e-7, 1e-5, 1e-3)  # from upside down, radians


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("executor", ["eager", "native"])
def test_upside_down_all_is_finite(make_model, random_states, random_actions, executor, dtype):
    """Values and gradients stay finite at the yaw's jump, and other samples keep theirs."""
    scene = zoo.load("crawler")
    bound = make_model(scene).to(dtype).requires_grad_(False).bind(scene)
    predictor = specialize(bound, executor=executor)
    assert scene.yaw_frame is not None
    for across in ([1.0, 0, 0], [0, 1.0, 0], [0.6, 0.8, 0]):
        state = random_states(scene, 2 * len(TILTS), seed=3)
        rest = torch.as_tensor(scene.yaw_frame.rest)
        over = torch.tensor([0.0, *across], dtype=torch.float64)
        tilt = torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64) * torch.tensor(TILTS, dtype=torch.float64)[:, None]
        state[: len(TILTS), scene.yaw_frame.node, 3:7] = quaternion.product(quaternion.normalize(over + tilt), rest)
        state, action = state.to(dtype).requires_grad_(), random_actions(scene, len(state), 3).to(dtype)
        states = predictor.rollout(state, action)[0]
        gradient = torch.autograd.grad(states.square().sum(), state)[0]
        assert states.isfinite().all() and gradient.isfinite().all()
        assert gradient.abs().max() < 1e9
        alone = state[len(TILTS) :].detach().requires_grad_()
        others = predictor.rollout(alone, action[len(TILTS) :])[0]
        # In float32, products of other sizes round otherwise.
        assert (others - states[len(TILTS) :]).norm() < 5e-6 * others.norm()
        own = torch.autograd.grad(others.square().sum(), alone)[0]
        most = 1e-5 if dtype == torch.float64 else 1e-3  # a ReLU's mask may flip
        assert (own - gradient[len(TILTS) :]).norm() < most * own.norm()


def test_the_yaw_of_a_free_root(make_model, random_states):
    """The yaw is 0 if the root tilts about a horizontal axis; a rotation about the vertical adds its angle."""
    scene = zoo.load("crawler")
    bound = make_model(scene).bind(scene)
    assert scene.yaw_frame is not None
    rest = torch.as_tensor(scene.yaw_frame.rest)
    generator = torch.Generator().manual_seed(0)
    horizontal = torch.randn(20, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 1, 0])
    angle = 3.1 * torch.rand(20, 1, generator=generator, dtype=torch.float64)
    tilt = quaternion.exp(angle * horizontal / horizontal.norm(dim=-1, keepdim=True))
    turn = quaternion.exp(torch.linspace(-3, 3, 20, dtype=torch.float64)[:, None] * torch.eye(3).double()[2])
    state = random_states(scene, 20)
    state[:, scene.yaw_frame.node, 3:7] = quaternion.product(turn, quaternion.product(tilt, rest))
    found = bound.canonicalizer.yaw_rotation(state, bound.scene_parameters).quaternion
    torch.testing.assert_close(found, turn)


def test_where_the_world_can_be_touched_it_shows_the_heading(make_model, random_states):
    scene = zoo.load("arm", ("<worldbody>", '<worldbody><geom type="plane" size="1 1 1"/>'))
    bound = make_model(scene).bind(scene)
    assert scene.yaw_frame is not None and not scene.yaw_frame.exact
    state = random_states(scene, 5)
    seen = bound.canonicalizer(state, bound.scene_parameters).state
    rest = torch.as_tensor(scene.yaw_frame.rest).expand(5, 4)
    turn = bound.canonicalizer.yaw_rotation(state, bound.scene_parameters).quaternion
    assert turn is not None
    torch.testing.assert_close(seen[:, 0, 3:7], quaternion.product(quaternion.conjugate(turn), state[:, 0, 3:7]))
    unmoved = make_model(zoo.load("arm")).bind(zoo.load("arm"))
    free = unmoved.canonicalizer(state, unmoved.scene_parameters).state
    assert torch.equal(free[:, 0], state[:, 0])
    assert torch.equal(free[:, 1:], seen[:, 1:])
    state[:, 1, 3:7] = rest
    torch.testing.assert_close(bound.canonicalizer(state, bound.scene_parameters).state, state, rtol=0, atol=1e-12)


def edge_features(bound: Predictor, state, action):
    program = bound.program()
    return eager.features(program, program.canonicalizer(state, program.parameters), action)[1]


def test_joint_axes_turn_with_the_scene(make_model, random_states, random_actions):
    scene = load_scene("jaco")
    bound = make_model(scene).bind(scene)
    state, action = random_states(scene, 5), random_actions(scene, 5)
    features = edge_features(bound, state, action)
    assert features.shape == (5, scene.num_edges, 20)
    axes, pushes = features[..., 1:4], features[..., 4:7]
    torch.testing.assert_close(axes.norm(dim=-1), torch.ones(5, scene.num_edges, dtype=axes.dtype))
    torch.testing.assert_close(pushes, features[..., :1] * axes)
    # With the place and yaw_frame as they are, every body turned by one rotation turns every axis.
    bound = make_model(scene, canonicalizer=Canonicalizer(yaw=False)).bind(scene)
    axes = edge_features(bound, state, action)[..., 1:4]
    turn = quaternion.exp(torch.tensor([0.3, -0.5, 0.8], dtype=state.dtype))
    turned = state.clone()
    turned[..., 3:7] = quaternion.product(turn, state[..., 3:7])
    matrix = quaternion.to_matrix(turn).reshape(3, 3)
    torch.testing.assert_close(edge_features(bound, turned, action)[..., 1:4], axes @ matrix.T)
