"""Forward models: inputs from scenes, descriptions, copies, dtypes and devices."""

from __future__ import annotations

import copy
import json
import pickle
import warnings

import pytest
import torch

from torchrl_gn.dynamics import (
    BodyState,
    Canonicalizer,
    Contacts,
    Controls,
    ForwardModel,
    JointAxes,
    Predictor,
    UnseenParameterWarning,
)
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.maths import Component, StateLayout
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import ParameterNames

QUATERNIONS = (BodyState(encoding="quaternion"), Controls(), JointAxes(), Contacts())


def test_an_untrained_model_predicts_what_the_rates_alone_do(scenes, make_model, random_states, random_actions):
    """The residual is exactly zero without statistics, so bodies coast."""
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
    before = bound[1].step(random_states(scenes["cheetah"]), random_actions(scenes["cheetah"]))[0]
    with torch.no_grad():
        for parameter in bound[0].parameters():
            parameter.mul_(1.5)
    assert not torch.equal(
        bound[1].step(random_states(scenes["cheetah"]), random_actions(scenes["cheetah"]))[0], before
    )


def test_parameters_are_read_by_name(scenes, make_model, random_states, random_actions):
    """A model whose parameters are listed in another order sees its own columns."""
    scene = scenes["swimmer6"]
    names = ParameterNames.of(scene)
    model = ForwardModel(ParameterNames(("mass",), tuple(reversed(names.edges)), ("timestep",)))
    bound = model.bind(scene)
    assert torch.equal(
        bound.scene_parameters.nodes[:, 0], torch.as_tensor(scene.static.nodes[:, names.nodes.index("mass")])
    )
    assert torch.equal(bound.scene_parameters.edges, torch.as_tensor(scene.static.edges[:, ::-1].copy()))
    assert bound.scene_parameters.globals_.tolist() == [scene.timestep]
    with pytest.raises(ValueError, match=r"'swimmer6' lacks the static features \['charm'\]"):
        ForwardModel(ParameterNames(nodes=("mass", "charm"))).bind(scene)


def test_types_and_flags_of_another_mujoco_are_off(scenes):
    scene = scenes["swimmer6"]
    names = ParameterNames(("mass",), ("actuator_gaintype[NEW]", "direction"), ("enableflags[NEW]",))
    bound = ForwardModel(names).bind(scene)
    direction = scene.static.edge_names.index("direction")
    assert torch.equal(bound.scene_parameters.edges[:, 0], torch.zeros(scene.num_edges, dtype=torch.float64))
    assert torch.equal(bound.scene_parameters.edges[:, 1], torch.as_tensor(scene.static.edges[:, direction]))
    assert bound.scene_parameters.globals_.tolist() == [0]


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"parameters": "none", "features": QUATERNIONS, "integrate": False, "latent": 3},
        {"canonicalizer": Canonicalizer(recenter=False)},
        {"edge_hidden": (4, 5, 6), "node_hidden": (3,), "global_hidden": (2, 2)},
        {"layout": StateLayout((Component("position", 3), Component("angle", 2, "circle")))},
        {"core": "mlp", "counts": (7, 16), "hidden": (8, 8)},
        {"core": "recurrent", "hidden_state": (3, 4, 5)},
    ],
)
def test_a_description_builds_the_same_model(scenes, options):
    model = ForwardModel(ParameterNames.of(scenes["swimmer6"]), **options)
    again = ForwardModel.from_description(json.loads(json.dumps(model.description())))
    again.load_state_dict(model.state_dict())
    assert again.description() == model.description()
    assert (again.layout, again.features, again.parameter_names) == (
        model.layout,
        model.features,
        model.parameter_names,
    )
    assert again.canonicalizer == model.canonicalizer
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
    before = bound.step(state, action)[0]
    assert torch.equal(again.step(state, action)[0], before)
    with torch.no_grad():
        for parameter in again.parameters():
            parameter.zero_()
    assert torch.equal(bound.step(state, action)[0], before)


def test_a_bound_models_state_is_the_models(scenes, make_model):
    bound = make_model(scenes["swimmer6"]).bind(scenes["swimmer6"])
    assert {f"model.{name}" for name in bound.model.state_dict()} == set(bound.state_dict())


def test_casting_the_network_leaves_the_scenes_numbers(scenes, make_model):
    bound = make_model(scenes["cheetah"]).bind(scenes["cheetah"])
    before = {name: buffer.clone() for name, buffer in bound.named_buffers()}
    for cast in (torch.float16, torch.float32, torch.float64):
        bound.to(cast)
        assert bound.dtype == cast
        for name, buffer in bound.named_buffers():
            assert buffer.dtype == before[name].dtype and torch.equal(buffer, before[name]), name


def test_what_binding_makes_lies_where_the_model_is(scenes, make_model):
    """Tensors are there before values are compared, which fails on the meta device; it stands in for a GPU."""
    scene = scenes["cheetah"]
    reading, inferred = (make_model(scene, parameters=source).to("meta") for source in ("scene", "inferred"))
    bound = reading.bind(scene)
    for module in (bound, ForwardModelLoss(inferred.bind(scene)), IdentifyingModel(inferred).bind(scene)[1]):
        assert {tensor.device.type for tensor in module.buffers()} == {"meta"}


def test_unknown_choices_are_named():
    with pytest.raises(ValueError, match="parameters='inferred!' is not known; use one of"):
        ForwardModel(ParameterNames(), parameters="inferred!")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="encoding='euler' is not known; use one of"):
        BodyState(encoding="euler")  # pyright: ignore[reportArgumentType]
