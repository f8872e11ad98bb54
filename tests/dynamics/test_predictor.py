"""Predictors of one scene: fixed components, dtypes, shapes, and the TensorDict contract."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential

from torchrl_gn.dynamics import (
    BodyState,
    BoundPredictor,
    Canonicalizer,
    Contacts,
    Controls,
    JointAxes,
    specialize,
)
from torchrl_gn.maths import BODY_STATE
from torchrl_gn.scenes import load_scene

ALL = ("pendulum", "swimmer6", "cheetah", "joints", "falling")
QUATERNIONS = (BodyState(encoding="quaternion"), Controls(), JointAxes(), Contacts())


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"features": (BodyState(), Controls(), Contacts())},
        {"features": QUATERNIONS, "integrate": False, "canonicalizer": Canonicalizer(recenter=False)},
    ],
)
def test_what_cannot_move_stays_exactly(scenes, make_model, random_states, random_actions, name, options):
    scene = scenes[name]
    bound = make_model(scene, **options).bind(scene)
    state, action = random_states(scene, 20, seed=3), random_actions(scene, 20)
    dead = ~torch.as_tensor(scene.movable)
    delta = bound.delta(state, action)
    assert (delta[:, dead] == 0).all()
    assert (delta[:, ~dead] != 0).any(0).all()
    after = bound.step(state, action)[0]
    assert torch.equal(after[:, 0], state[:, 0])
    for component in ("position", "linear_velocity", "angular_velocity"):
        where, changes = BODY_STATE.slices[component], BODY_STATE.delta_slices[component]
        still = dead[:, changes]
        assert torch.equal(after[..., where][:, still], state[..., where][:, still])
    turns = BODY_STATE.delta_slices["orientation"]
    no_turn = dead[:, turns].all(1)
    where = BODY_STATE.slices["orientation"]
    torch.testing.assert_close(after[:, no_turn, where], state[:, no_turn, where], rtol=0, atol=1e-15)
    torch.testing.assert_close(BODY_STATE.delta(state, after), delta, rtol=0, atol=1e-14)


def test_planar_bodies_never_leave_their_plane(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene).bind(scene)
    state = random_states(scene, 4, scale=0.1)
    height = state[..., 2].clone()
    for step in range(50):
        state = bound.step(state, random_actions(scene, 4, seed=step))[0].detach()
    assert torch.equal(state[..., 2], height)
    assert (state[..., 4:6] == 0).all()  # turned about z only


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("network", [torch.float32, torch.float64])
def test_the_next_state_has_the_states_dtype(scenes, make_model, random_states, random_actions, network, dtype):
    scene = scenes["swimmer6"]
    bound = make_model(scene).to(network).bind(scene)
    state, action = random_states(scene, 5), random_actions(scene, 5)
    reference = make_model(scene).double().bind(scene).delta(state, action)
    for predictor in (bound, specialize(bound)):
        for action_dtype in (torch.float32, torch.float64):
            assert predictor.step(state.to(dtype), action.to(action_dtype))[0].dtype == dtype
        error = (predictor.delta(state.to(dtype), action).double() - reference).norm() / reference.norm()
        assert error < (1e-12 if dtype == network == torch.float64 else 1e-5)


@pytest.mark.parametrize("batch", [(), (3,), (3, 4), (0,), (2, 1, 2)])
@pytest.mark.parametrize("name", ["swimmer6", "falling"])
def test_every_item_of_a_batch_is_predicted_alone(scenes, make_model, random_states, random_actions, name, batch):
    scene = scenes[name]
    bound = make_model(scene).double().bind(scene)
    state, action = random_states(scene, *batch), random_actions(scene, *batch)
    after = bound.step(state, action)[0]
    assert after.shape == state.shape
    count = torch.Size(batch).numel()
    flat = (state.reshape(count, scene.num_nodes, 13), action.reshape(count, scene.num_actions))
    alone = [bound.step(one, act)[0] for one, act in zip(*flat, strict=True)]
    if alone:
        torch.testing.assert_close(after.reshape(-1, scene.num_nodes, 13), torch.stack(alone), rtol=0, atol=1e-13)


def test_wrong_shapes_name_the_scene_and_what_fits(scenes, make_model):
    bound = make_model(scenes["pendulum"]).bind(scenes["pendulum"])
    ok = torch.zeros(5, 2, 13)
    for shape in ((5, 3, 13), (5, 2, 12), (13,)):
        with pytest.raises(ValueError, match=r"State of scene 'pendulum' must be \[\*B, 2, 13\], got"):
            bound.step(torch.zeros(shape), torch.zeros(5, 1))
    for shape in ((5, 2), (4, 1), (1,), (5, 5, 1)):
        with pytest.raises(ValueError, match=r"Action of scene 'pendulum' must be \[5, 1\] .* got"):
            bound.step(ok, torch.zeros(shape))


@pytest.mark.parametrize("name", ALL)
def test_gradients_are_the_finite_differences(scenes, make_model, random_states, random_actions, name):
    scene = scenes[name]
    bound = make_model(scene).double().bind(scene)
    state, action = (
        random_states(scene, 2, seed=3).requires_grad_(),
        random_actions(scene, 2).requires_grad_(),
    )
    assert torch.autograd.gradcheck(lambda *inputs: bound.step(*inputs)[0], (state, action), fast_mode=True)


def transitions(scene, random_states, random_actions, *batch: int, robot: bool = False) -> TensorDict:
    entries = {"state": random_states(scene, *batch), "action": random_actions(scene, *batch)}
    tensordict = TensorDict(entries, list(batch))
    return TensorDict({"robot": tensordict}, list(batch)) if robot else tensordict


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_tensordict_contract(scenes, make_model, random_states, random_actions, batch):
    scene = scenes["swimmer6"]
    bound = make_model(scene).bind(scene)
    assert bound.in_keys == ["state", "action"]
    assert bound.out_keys == [("next", "state")]
    tensordict = transitions(scene, random_states, random_actions, *batch)
    before = tensordict.clone()
    assert bound(tensordict) is tensordict
    assert (tensordict.exclude("next") == before).all()
    expected = bound.step(before["state"], before["action"])[0]
    assert torch.equal(tensordict["next", "state"], expected)
    assert tensordict["next"].batch_size == tensordict.batch_size
    # Dispatch: the same with tensors.
    assert torch.equal(bound(before["state"], before["action"]), expected)
    assert torch.equal(bound(state=before["state"], action=before["action"]), expected)


def test_nested_keys(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    model = make_model(scene)
    bound = BoundPredictor(model, scene, state_key=("robot", "state"), action_key=("robot", "action"))
    assert bound.out_keys == [("next", "robot", "state")]
    tensordict = bound(transitions(scene, random_states, random_actions, 4, robot=True))
    robot = tensordict["robot"]
    assert torch.equal(tensordict["next", "robot", "state"], model.bind(scene).step(robot["state"], robot["action"])[0])


def test_missing_entries_are_named(scenes, make_model):
    bound = make_model(scenes["pendulum"]).bind(scenes["pendulum"])
    with pytest.raises(KeyError, match='"action" not found'):
        bound(TensorDict({"state": torch.zeros(3, 2, 13)}, [3]))


def test_models_chain_with_other_modules(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound = make_model(scene).bind(scene)
    policy = TensorDictModule(lambda state: state[..., 1:, 12].tanh()[..., : scene.num_actions], ["state"], ["action"])
    height = TensorDictModule(lambda state: state[..., 1, 2:3], [("next", "state")], ["height"])
    chain = TensorDictSequential(policy, bound, height)
    assert chain.in_keys == ["state"]
    assert set(chain.out_keys) == {"action", ("next", "state"), "height"}
    out = chain(TensorDict({"state": random_states(scene, 5)}, [5]))
    assert torch.equal(out["next", "state"], bound.step(out["state"], out["action"])[0])


def test_actions_beyond_the_limits_do_what_those_at_the_limits_do(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound, state = make_model(scene).bind(scene), random_states(scene, 5)
    action = 3 * random_actions(scene, 5)
    low, high = torch.as_tensor(scene.action_low), torch.as_tensor(scene.action_high)
    cut = torch.minimum(torch.maximum(action, low), high)
    assert not torch.equal(action, cut)
    for model in (bound, specialize(bound)):
        found, expected = (model.step(state, each)[0] - state for each in (action, cut))
        assert (found - expected).norm() < 1e-5 * expected.norm()


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["eager", "native"])
def test_actions_at_their_limits_have_gradients_whatever_their_rounding(
    make_model, random_states, random_actions, executor
):
    """JACO's limits, in single precision, lie a little outside of those in double precision."""
    scene = load_scene("jaco")
    predictor = specialize(make_model(scene).float().bind(scene), executor=executor)
    state, actions = random_states(scene, 5), random_actions(scene, 5, 4).float()
    limits = [torch.as_tensor(each).float() for each in (scene.action_low, scene.action_high)]
    rounded = [torch.nextafter(each, to * torch.inf) for each, to in zip(limits, limits, strict=True)]
    for at in (*limits, *rounded):
        gradients = []
        for size in (1.0, 0.9999):
            action = (size * at).expand_as(actions).clone().requires_grad_()
            after = predictor.rollout(state, action)[0]
            gradients += torch.autograd.grad(
                (after * torch.linspace(-1, 1, after[0].numel()).view_as(after[0])).sum(), action
            )
        found, inside = gradients
        assert (found != 0).all()
        assert (found - inside).norm() < 0.01 * inside.norm()


def test_binds_on_the_meta_device(scenes, make_model):
    expected = make_model(scenes["cheetah"]).bind(scenes["cheetah"])
    made = [make_model(scenes["cheetah"]).to("meta").bind(scenes["cheetah"])]
    with torch.device("meta"):
        made.append(make_model(scenes["cheetah"], fitted=False).bind(scenes["cheetah"]))
    for predictor in made:
        assert all(each.is_meta for each in (*predictor.parameters(), *predictor.buffers()))
        shapes = {name: each.shape for name, each in predictor.state_dict().items()}
        assert shapes == {name: each.shape for name, each in expected.state_dict().items()}
        state, action = torch.empty(3, 8, 13, device="meta"), torch.empty(3, 6, device="meta")
        assert predictor.step(state, action)[0].shape == (3, 8, 13)


@pytest.mark.slow
@pytest.mark.parametrize("strict", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_torch_export_takes_a_bound_model(scenes, make_model, random_states, random_actions, strict):
    predictor = make_model(scenes["swimmer6"]).bind(scenes["swimmer6"]).requires_grad_(False)
    inputs = random_states(predictor.scene, 3), random_actions(predictor.scene, 3)
    exported = torch.export.export(predictor, inputs, strict=strict).module()
    torch.testing.assert_close(exported(*inputs), predictor.step(*inputs)[0])
