"""The inference model: a recurrent GN block, online use, and nothing of the true parameters."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchrl_gn.data import collect_trajectories, open_tensors
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import update_dynamic_normalizers
from torchrl_gn.envs import ModelEnv
from torchrl_gn.identification import IdentifyingModel, InferenceModel
from torchrl_gn.networks import GNBlock, GraphSize, graph_concat
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene, sample_variants

from ..sizes import SMALL

EDGES = torch.tensor([[0, 1, 0, 2], [1, 0, 1, 2]])


@pytest.fixture
def make_identifying(fit):
    """Both models, small and with random weights, and the scene they know."""

    def make(name: str = "pendulum", readout: str = "mean"):
        torch.manual_seed(0)
        scene = load_scene(name)
        forward_model = ForwardModel.for_scene(scene, parameters="inferred", inferred=(4, 3, 2), **SMALL)
        model = IdentifyingModel(
            forward_model.double(), edge_hidden=(8,), node_hidden=(8,), global_hidden=(8,), readout=readout
        ).double()
        bound, _ = model.bind(scene)
        data = collect_trajectories(scene, 20, 5)
        state, action = data["state"], data["action"]
        update_dynamic_normalizers(bound, state[:, 0], action[:, 0], state[:, 1])
        return model, scene

    return make


def sequence_of(data: TensorDict, steps: int) -> dict:
    """The first transitions of trajectories, laid out as TorchRL's are."""
    state, action = data["state"], data["action"]
    return {"state": state[:, :steps], "action": action[:, :steps], "next": {"state": state[:, 1 : steps + 1]}}


@pytest.mark.parametrize("readout", ["mean", "last"])
def test_a_step_is_a_gn_block_over_both_graphs(readout, random_graph):
    torch.manual_seed(0)
    size, inferred, hidden_state = GraphSize(3, 2, 1), GraphSize(4, 5, 6), GraphSize(7, 8, 9)
    model = InferenceModel(size, inferred=(4, 5, 6), hidden_state=(7, 8, 9), readout=readout).double()
    assert isinstance(model.block, GNBlock)
    dynamic, hidden = random_graph(size, EDGES, 3, 2), random_graph(hidden_state, EDGES, 3, 2, seed=1)
    told, after = model(dynamic, hidden)
    out = model.block(graph_concat(dynamic, hidden))
    for part in ("nodes", "edges", "globals_"):
        first, last = getattr(inferred, part), getattr(hidden_state, part)
        features = getattr(out, part)
        assert features.shape[-1] == first + last
        assert torch.equal(getattr(told, part), features[..., :first])
        assert torch.equal(getattr(after, part), features[..., -last:].tanh())
    assert all((value == 0).all() for value in (model.start(dynamic).nodes, model.start(dynamic).globals_))


def test_observations_one_by_one_are_the_sequence(make_identifying):
    model, scene = make_identifying("swimmer3")
    _, inference = model.bind(scene)
    data = collect_trajectories(scene, 4, 9, seed=1)
    sequence = data["state"][:, :9], data["action"], data["state"][:, 1:]
    whole = inference.infer(*sequence)
    context = None
    for step in range(9):
        known = inference.infer(*(part[:, step : step + 1] for part in sequence), context)
        context = known.context
    for key in ("nodes", "edges", "globals_"):
        torch.testing.assert_close(known.parameters[key], whole.parameters[key])
    every = list(inference.infer_each(*sequence))
    assert len(every) == 9 and torch.equal(every[-1].parameters["nodes"], whole.parameters["nodes"])
    assert not torch.equal(every[0].parameters["nodes"], whole.parameters["nodes"])
    with pytest.raises(ValueError, match="at least one transition"):
        inference.infer(*(part[:, :0] for part in sequence))


@pytest.mark.parametrize("readout", ["mean", "last"])
def test_what_is_inferred_is_the_mean_of_what_each_observation_tells(readout, make_identifying):
    model, scene = make_identifying("swimmer3", readout=readout)
    _, inference = model.bind(scene)
    data = collect_trajectories(scene, 4, 6, seed=1)
    each = []
    model.inference.register_forward_hook(lambda module, inputs, output: each.append(output))
    known = [
        known.parameters for known in inference.infer_each(data["state"][:, :6], data["action"], data["state"][:, 1:])
    ]
    for count in (1, 2, 6):
        for key in ("nodes", "edges", "globals_"):
            told = torch.stack([getattr(step[0], key) for step in each[:count]])
            expected = told[-1] if readout == "last" else told.mean(0)
            torch.testing.assert_close(known[count - 1][key], expected)
    with pytest.raises(ValueError, match="readout must be 'mean' or 'last', got 'first'"):
        InferenceModel(GraphSize(3, 2, 1), readout="first")


def test_as_tensordict_modules_they_chain(make_identifying):
    model, scene = make_identifying()
    bound, inference = model.bind(scene)
    data = collect_trajectories(scene, 3, 6, seed=1)
    td = TensorDict(
        {
            "identification": sequence_of(data, 5),
            "state": data["state"][:, 5],
            "action": data["action"][:, 5],
        },
        batch_size=[3],
    )
    with pytest.raises(KeyError, match="physical parameters at 'parameters'"):
        bound(td.clone())
    bound(inference(td))
    parameters = inference.infer(data["state"][:, :5], data["action"][:, :5], data["state"][:, 1:6]).parameters
    assert torch.equal(td["next", "state"], bound.step(data["state"][:, 5], data["action"][:, 5], parameters)[0])
    with pytest.raises(KeyError, match="identification"):
        inference(TensorDict({"state": td["state"]}, [3]))


def test_an_inferred_graph_is_kept_and_used_again(make_identifying, tmp_path):
    model, scene = make_identifying()
    bound, inference = model.bind(scene)
    data = collect_trajectories(scene, 3, 6, seed=1)
    parameters = inference.infer(data["state"][:, :5], data["action"][:, :5], data["state"][:, 1:6]).parameters.detach()
    parameters.memmap(str(tmp_path))
    again = open_tensors(tmp_path)
    start, actions = data["state"][:, 2], data["action"][:, 2:]
    expected, _ = bound.rollout(start, actions, parameters)
    assert torch.equal(bound.rollout(start, actions, again)[0], expected)
    torch.testing.assert_close(specialize(bound).rollout(start, actions, again)[0], expected, rtol=1e-9, atol=1e-12)
    env = ModelEnv(bound, make_reward("balance", scene))
    assert (env.reset()["parameters", "nodes"] == 0).all()  # nothing is known
    reset = env.reset(TensorDict({"state": start, "parameters": again}, [3]), set_state=True)
    for action in actions.unbind(1):
        reset = step_mdp(env.step(reset.set("action", action.to(env.action_spec.dtype))))
    torch.testing.assert_close(reset["state"], expected[:, -1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("system", ["pendulum", "cartpole", "swimmer3", "cheetah", "jaco"])
@pytest.mark.parametrize("parameters", ["none", "inferred"])
def test_true_parameters_cannot_leak(system, parameters):
    """Predictions are functions of states and actions: true parameters change nothing and get no gradient."""
    torch.manual_seed(0)
    scene, variants = load_scene(system), sample_variants(system, 3, rng=0)
    model = ForwardModel.for_scene(scene, parameters=parameters, inferred=(4, 3, 2), **SMALL).double()
    data = collect_trajectories(variants, 3, 6, seed=0)
    bound = model.bind(scene, parameters_key="parameters")
    update_dynamic_normalizers(bound, data["state"][:, 0], data["action"][:, 0], data["state"][:, 1])
    sample = TensorDict({"state": data["state"][:, 2], "action": data["action"][:, 2]}, [3])
    modules = [bound]
    if parameters == "inferred":
        with pytest.raises(ValueError, match="Physical parameter 'nodes' must be|true parameters"):
            bound(sample.clone().set("parameters", data["parameters"]))
        identifying = IdentifyingModel(model, edge_hidden=(8,), node_hidden=(8,), global_hidden=(8,)).double()
        bound, inference = identifying.bind(scene)
        sample["identification"] = TensorDict(sequence_of(data, 6), [3])
        modules = [inference, bound]
    predicted = []
    for true in (data["parameters"], data["parameters"].apply(torch.zeros_like), data["parameters"] * torch.nan):
        true = true.clone().apply(lambda value: value.double().requires_grad_())
        td = sample.clone().set("parameters", true)
        for module in modules:
            td = module(td)
        predicted.append(td["next", "state"])
        gradients = torch.autograd.grad(predicted[-1].sum(), list(true.values()), allow_unused=True)
        assert all(gradient is None for gradient in gradients)
    assert torch.equal(predicted[0], predicted[1]) and torch.equal(predicted[0], predicted[2])
    # Bodies would be projected by a variant's own lengths, and their joint anchors looked for near there.
    with pytest.raises(ValueError, match="is a variant, whose joint anchors would show its lengths"):
        model.bind(variants[1])


def test_the_forward_model_must_read_what_is_inferred():
    scene = load_scene("pendulum")
    with pytest.raises(ValueError, match="reads parameters='scene'; build it with 'inferred'"):
        IdentifyingModel(ForwardModel.for_scene(scene, **SMALL))


def test_a_description_builds_the_same_models(make_identifying):
    model, scene = make_identifying()
    again = IdentifyingModel.from_description(model.description()).double()
    again.load_state_dict(model.state_dict())
    data = collect_trajectories(scene, 3, 6, seed=1)
    sequence = data["state"][:, :6], data["action"], data["state"][:, 1:]
    found = [each.bind(scene)[1].infer(*sequence).parameters for each in (model, again)]
    assert torch.equal(found[0]["nodes"], found[1]["nodes"])
