"""Bound forward models: what never changes, dtypes, shapes, and the TensorDict contract."""

from __future__ import annotations

import copy
import json
import pickle
import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential

from torchrl_gn.dynamics import ForwardModel, Predictor, UnseenParameterWarning, specialize
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.maths import BODY_STATE, Component, StateLayout
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import ParameterNames, load_scene
from torchrl_gn.scenes.systems import find_system

ALL = ("pendulum", "swimmer6", "cheetah", "joints", "falling")


def thick_swimmer():
    """Swimmer6 in a medium of another viscosity."""
    spec = find_system("swimmer6").build()
    spec.option.viscosity = 0.5
    return load_scene(spec, timestep=0.02, name="thick")


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize(
    "options", [{}, {"joint_axes": False}, {"encoding": "quaternion", "integrate": False, "recenter": False}]
)
def test_what_cannot_move_stays_exactly(scenes, make_model, random_states, random_actions, name, options):
    scene = scenes[name]
    bound = make_model(scene, **options).bind(scene)
    state, action = random_states(scene, 20, seed=3), random_actions(scene, 20)
    dead = ~torch.as_tensor(scene.movable)
    delta = bound.delta(state, action)
    assert (delta[:, dead] == 0).all()
    assert (delta[:, ~dead] != 0).any(0).all()
    after = bound.step(state, action)
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
        state = bound.step(state, random_actions(scene, 4, seed=step)).detach()
    assert torch.equal(state[..., 2], height)
    assert (state[..., 4:6] == 0).all()  # turned about z only


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("network", [torch.float32, torch.float64])
def test_the_next_state_has_the_states_dtype(scenes, make_model, random_states, random_actions, network, dtype):
    scene = scenes["swimmer6"]
    bound = make_model(scene).to(network).bind(scene)
    state, action = random_states(scene, 5), random_actions(scene, 5)
    for action_dtype in (torch.float32, torch.float64):
        assert bound.step(state.to(dtype), action.to(action_dtype)).dtype == dtype
    reference = make_model(scene).double().bind(scene).delta(state, action)
    error = (bound.delta(state.to(dtype), action).double() - reference).norm() / reference.norm()
    assert error < (1e-12 if dtype == network == torch.float64 else 1e-5)


@pytest.mark.parametrize("batch", [(), (3,), (3, 4), (0,), (2, 1, 2)])
@pytest.mark.parametrize("name", ["swimmer6", "falling"])
def test_every_item_of_a_batch_is_predicted_alone(scenes, make_model, random_states, random_actions, name, batch):
    scene = scenes[name]
    bound = make_model(scene).double().bind(scene)
    state, action = random_states(scene, *batch), random_actions(scene, *batch)
    after = bound.step(state, action)
    assert after.shape == state.shape
    count = torch.Size(batch).numel()
    flat = (state.reshape(count, scene.num_nodes, 13), action.reshape(count, scene.num_actions))
    alone = [bound.step(one, act) for one, act in zip(*flat, strict=True)]
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
    assert torch.autograd.gradcheck(bound.step, (state, action), fast_mode=True)


def test_an_untrained_model_predicts_what_the_rates_alone_do(scenes, make_model, random_states, random_actions):
    """Without statistics the residual is exactly zero: bodies coast."""
    scene = scenes["falling"]
    bound = make_model(scene, fitted=False).bind(scene)
    state = random_states(scene, 3)
    delta = bound.delta(state, random_actions(scene, 3))
    torch.testing.assert_close(delta[..., :6], scene.timestep * state[..., 7:], rtol=1e-15, atol=0)
    assert torch.equal(delta[..., 6:], torch.zeros_like(delta[..., 6:]))


def test_scenes_share_the_weights(scenes, make_model, random_states, random_actions):
    model = make_model(scenes["swimmer6"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnseenParameterWarning)
        bound = [model.bind(scenes[name]) for name in ("swimmer6", "cheetah", "joints")]
    for one in bound[1:]:
        assert one.model is model
        assert all(a is b for a, b in zip(one.parameters(), bound[0].parameters(), strict=True))
    before = bound[1].step(random_states(scenes["cheetah"]), random_actions(scenes["cheetah"]))
    with torch.no_grad():
        for parameter in bound[0].parameters():
            parameter.mul_(1.5)
    assert not torch.equal(bound[1].step(random_states(scenes["cheetah"]), random_actions(scenes["cheetah"])), before)


def test_values_that_training_never_saw_are_named(scenes, make_model):
    scene = scenes["swimmer6"]
    model = make_model(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UnseenParameterWarning)
        model.bind(scene)
        model.bind(scene, strict=True)
        make_model(scene, fitted=False).bind(thick_swimmer())  # no training yet, nothing to compare
    with pytest.warns(UnseenParameterWarning, match="'thick' has values that the model never saw.*viscosity") as caught:
        model.bind(thick_swimmer())
    assert caught[0].filename == __file__
    assert "density" not in str(caught[0].message)
    with pytest.raises(ValueError, match="viscosity"):
        model.bind(thick_swimmer(), strict=True)
    with pytest.warns(UnseenParameterWarning, match=r"jnt_type\[FREE\].*density.*state change 2"):
        model.bind(scenes["falling"])


def test_variants_with_values_that_training_never_saw_are_named(scenes, make_model, fit):
    model = make_model(scenes["swimmer6"])
    bound, strict = (
        model.bind(scenes["swimmer6"], strict=strict, parameters_key="parameters") for strict in (False, True)
    )
    for module in (bound, specialize(bound)):
        with pytest.warns(UnseenParameterWarning, match="'thick' has values .*viscosity") as caught:
            module.parameters_of(thick_swimmer())
        assert caught[0].filename == __file__
    for module in (strict, specialize(strict)):
        with pytest.raises(ValueError, match="viscosity"):
            module.parameters_of(thick_swimmer())
        module.parameters_of(scenes["swimmer6"])
    with pytest.warns(UnseenParameterWarning):
        fit(model, thick_swimmer())
    strict.parameters_of(thick_swimmer())


def test_a_feature_that_varied_in_training_is_not_unseen(scenes, make_model, fit):
    model = make_model(scenes["swimmer6"])
    with pytest.warns(UnseenParameterWarning):
        fit(model, thick_swimmer())
    model.bind(scenes["swimmer6"], strict=True)
    model.bind(thick_swimmer(), strict=True)


def test_a_model_without_statics_reads_none(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    model = make_model(scene, parameters="none")
    state, action = random_states(scene, 5), random_actions(scene, 5)
    assert model.features == ParameterNames()
    thick = model.bind(thick_swimmer(), strict=True)
    assert torch.equal(thick.step(state, action), model.bind(scene).step(state, action))
    informed = make_model(scene)
    parameters = informed.bind(scene).static_graph()
    assert parameters.nodes.shape[-1] == len(informed.features.nodes) > 0
    assert model.bind(scene).static_graph().nodes.shape[-1] == 0


def test_statics_are_read_by_name(scenes, make_model, random_states, random_actions):
    """A model whose features are listed in another order sees its own columns."""
    scene = scenes["swimmer6"]
    names = ParameterNames.of(scene)
    model = ForwardModel(ParameterNames(("mass",), tuple(reversed(names.edges)), ("timestep",)))
    bound = model.bind(scene)
    assert torch.equal(bound.values.nodes[:, 0], torch.as_tensor(scene.static.nodes[:, names.nodes.index("mass")]))
    assert torch.equal(bound.values.edges, torch.as_tensor(scene.static.edges[:, ::-1].copy()))
    assert bound.values.globals_.tolist() == [scene.timestep]
    with pytest.raises(ValueError, match=r"'swimmer6' lacks the static features \['charm'\]"):
        ForwardModel(ParameterNames(nodes=("mass", "charm"))).bind(scene)


def test_types_and_flags_of_another_mujoco_are_off(scenes):
    scene = scenes["swimmer6"]
    features = ParameterNames(("mass",), ("actuator_gaintype[NEW]", "direction"), ("enableflags[NEW]",))
    bound = ForwardModel(features).bind(scene)
    direction = scene.static.edge_names.index("direction")
    assert torch.equal(bound.values.edges[:, 0], torch.zeros(scene.num_edges, dtype=torch.float64))
    assert torch.equal(bound.values.edges[:, 1], torch.as_tensor(scene.static.edges[:, direction]))
    assert bound.values.globals_.tolist() == [0]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"parameters": "none", "encoding": "quaternion", "integrate": False, "recenter": False, "latent": 3},
        {"edge_hidden": (4, 5, 6), "node_hidden": (3,), "global_hidden": (2, 2)},
        {"layout": StateLayout((Component("position", 3), Component("angle", 2, "circle")))},
    ],
)
def test_a_description_builds_the_same_model(scenes, make_model, options):
    model = make_model(scenes["swimmer6"], fitted=False, **options)
    again = ForwardModel.from_description(json.loads(json.dumps(model.description())))
    again.load_state_dict(model.state_dict())
    assert again.description() == model.description()
    assert (again.layout, again.features) == (model.layout, model.features)
    assert repr(again) == repr(model)


def copies(bound: Predictor) -> dict[str, Predictor]:
    model = ForwardModel.from_description(bound.model.description())
    model.load_state_dict(bound.model.state_dict())
    pickled = pickle.loads(pickle.dumps(bound.model))
    return {
        "deepcopy": copy.deepcopy(bound),
        "state_dict": model.bind(bound.scene),
        "pickle": pickled.bind(bound.scene),
    }


@pytest.mark.parametrize("kind", ["deepcopy", "state_dict", "pickle"])
def test_copies_predict_alike_and_share_nothing(scenes, make_model, random_states, random_actions, kind):
    scene = scenes["swimmer6"]
    bound = make_model(scene).bind(scene)
    again = copies(bound)[kind]
    state, action = random_states(scene, 5), random_actions(scene, 5)
    before = bound.step(state, action)
    assert torch.equal(again.step(state, action), before)
    with torch.no_grad():
        for parameter in again.parameters():
            parameter.zero_()
    assert torch.equal(bound.step(state, action), before)


def test_a_bound_models_state_is_the_models(scenes, make_model):
    bound = make_model(scenes["swimmer6"]).bind(scenes["swimmer6"])
    assert {f"model.{name}" for name in bound.model.state_dict()} == set(bound.state_dict())


def test_casting_the_network_leaves_the_scenes_numbers(scenes, make_model):
    bound = make_model(scenes["cheetah"]).bind(scenes["cheetah"])
    before = {name: buffer.clone() for name, buffer in bound.named_buffers()}
    for cast in (torch.float16, torch.float32, torch.float64):
        bound.to(cast)
        assert bound.network_dtype == cast
        for name, buffer in bound.named_buffers():
            assert buffer.dtype == before[name].dtype and torch.equal(buffer, before[name]), name


def test_what_binding_makes_lies_where_the_model_is(scenes, make_model, monkeypatch):
    """Before its numbers are compared with the model's. A device without numbers stands in for a GPU."""
    model, places = make_model(scenes["cheetah"], parameters="inferred").to("meta"), set()

    def look(bound: Predictor, *_, **__) -> None:
        places.update(tensor.device.type for tensor in bound.buffers())

    monkeypatch.setattr("torchrl_gn.dynamics.predictor.check_seen", look)
    bound = model.bind(scenes["cheetah"])
    specialize(bound)
    for module in (ForwardModelLoss(bound), IdentifyingModel(model).bind(bound.scene)[1]):
        places.update(tensor.device.type for tensor in module.buffers())
    assert places == {"meta"}


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
    expected = bound.step(before["state"], before["action"])
    assert torch.equal(tensordict["next", "state"], expected)
    assert tensordict["next"].batch_size == tensordict.batch_size
    # Dispatch: the same with tensors.
    assert torch.equal(bound(before["state"], before["action"]), expected)
    assert torch.equal(bound(state=before["state"], action=before["action"]), expected)


def test_nested_keys(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    model = make_model(scene)
    bound = Predictor(model, scene, state_key=("robot", "state"), action_key=("robot", "action"))
    assert bound.out_keys == [("next", "robot", "state")]
    tensordict = bound(transitions(scene, random_states, random_actions, 4, robot=True))
    robot = tensordict["robot"]
    assert torch.equal(tensordict["next", "robot", "state"], model.bind(scene).step(robot["state"], robot["action"]))


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
    assert torch.equal(out["next", "state"], bound.step(out["state"], out["action"]))


@pytest.mark.parametrize(("name", "value"), [("parameters", "inferred!"), ("encoding", "euler")])
def test_unknown_choices_are_named(name, value):
    with pytest.raises(ValueError, match=f"{name}='{value}' is not known; use one of"):
        ForwardModel(ParameterNames(), **{name: value})


def test_actions_beyond_the_limits_do_what_those_at_the_limits_do(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    bound, state = make_model(scene).bind(scene), random_states(scene, 5)
    action = 3 * random_actions(scene, 5)
    low, high = torch.as_tensor(scene.action_low), torch.as_tensor(scene.action_high)
    cut = torch.minimum(torch.maximum(action, low), high)
    assert not torch.equal(action, cut)
    for model in (bound, specialize(bound)):
        assert torch.equal(model.step(state, action), model.step(state, cut))
