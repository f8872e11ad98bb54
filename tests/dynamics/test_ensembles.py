"""Ensembles: models of equal shape whose weights are stacked, and called at once by ``torch.vmap``."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torch.func import functional_call, grad, stack_module_state

from torchrl_gn.dynamics import specialize
from torchrl_gn.objectives import ForwardModelLoss

COUNT, BATCH = 3, 4


@pytest.fixture
def members(scenes, make_model):
    def make(name: str = "cheetah", **options):
        models = [make_model(scenes[name], seed=seed).double() for seed in range(COUNT)]
        return [model.bind(scenes[name], **options) for model in models]

    return make


@pytest.fixture
def inputs(random_states, random_actions):
    def draw(predictor, *batch: int):
        return random_states(predictor.scene, *batch), random_actions(predictor.scene, *batch)

    return draw


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize("name", ["swimmer6", "cheetah"])
def test_stacked_members_predict_what_each_does(members, inputs, name, reference):
    made = members(name, reference=reference)
    state, action = inputs(made[0], BATCH)
    shape = copy.deepcopy(made[0]).to("meta")  # holds no numbers

    def step(weights, buffers, state):
        return functional_call(shape, (weights, buffers), (state, action))

    states = torch.stack(COUNT * [state])
    found = torch.vmap(step, in_dims=(0, 0, 0))(*stack_module_state(made), states)
    expected = torch.stack([member.step(state, action)[0] for member in made])
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    assert float(found.detach().std(0).max()) > 1e-3


def test_rollouts_under_exchanged_weights(members, inputs):
    made = members()
    state, _ = inputs(made[0], BATCH)
    actions = torch.stack([inputs(made[0], BATCH)[1]] * 3, 1)
    expected = torch.stack([member.rollout(state, actions)[0] for member in made])
    member = copy.deepcopy(made[0])

    def rollout(weights):
        with weights.to_module(member):
            return member.rollout(state, actions)[0]

    found = torch.vmap(rollout)(TensorDict.from_modules(*made))
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_losses_and_their_gradients_in_weights(members, inputs):
    made = members()
    state, action = inputs(made[0], BATCH)
    after = made[0].step(state, action)[0].detach() + 0.01 * torch.as_tensor(made[0].scene.movable[:, :1])
    batch = TensorDict({"state": state, "action": action, "next": {"state": after}}, [BATCH])
    cores = TensorDict.from_modules(*(copy.deepcopy(member.model.core) for member in made))
    loss = ForwardModelLoss(made[0])
    expected = [ForwardModelLoss(member)(batch)["loss_forward_model"] for member in made]
    gradients = [
        torch.autograd.grad(value, list(one.model.core.parameters())) for value, one in zip(expected, made, strict=True)
    ]

    def value(weights):
        with weights.to_module(made[0].model.core):
            return loss(batch)["loss_forward_model"]

    torch.testing.assert_close(torch.vmap(value)(cores), torch.stack(expected), rtol=1e-9, atol=1e-12)
    found = torch.vmap(grad(value))(cores)
    for index, (name, _) in enumerate(made[0].model.core.named_parameters()):
        wanted = torch.stack([of[index] for of in gradients])
        torch.testing.assert_close(found[tuple(name.split("."))], wanted, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_jacobians_of_a_bound_model(members, inputs):
    predictor = members("swimmer6")[0]
    state, action = inputs(predictor)

    def step(action):
        return predictor.step(state, action)[0]

    forward, reverse = torch.func.jacfwd(step)(action), torch.func.jacrev(step)(action)
    torch.testing.assert_close(forward, reverse)
    torch.testing.assert_close(torch.autograd.functional.jacobian(step, action), reverse)


@pytest.mark.slow
@pytest.mark.parametrize("executor", ["native", "eager"])
def test_specialised_members(members, inputs, executor):
    made = [specialize(member, executor=executor) for member in members()]
    state, action = inputs(made[0], BATCH)
    call = torch.vmap(lambda weights, buffers: functional_call(made[0], (weights, buffers), (state, action)))
    found = call(*stack_module_state(made))
    for each, member in zip(found, made, strict=True):
        torch.testing.assert_close(each, member.step(state, action)[0])
