"""Transforms of ``torch.func`` of a bound model, in its inputs and its weights, against finite differences."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, vmap

from torchrl_gn.dynamics import ForwardModel

STEPS = 2
pytestmark = pytest.mark.filterwarnings("ignore:There is a performance drop:UserWarning")  # vmap of a GRU


def differences(function: Callable[[Tensor], Tensor], at: Tensor, size: float = 1e-5) -> Tensor:
    """Central differences ``[*out, *in]``."""
    columns = []
    for index in range(at.numel()):
        change = torch.zeros_like(at).view(-1)
        change[index] = size
        change = change.view_as(at)
        columns.append((function(at + change) - function(at - change)).detach() / (2 * size))
    return torch.stack(columns, -1).unflatten(-1, at.shape)


class Rollout(torch.nn.Module):
    """The last state of a rollout, as a call."""

    def __init__(self, predictor) -> None:
        super().__init__()
        self.predictor = predictor

    def forward(self, state: Tensor, actions: Tensor) -> Tensor:
        return self.predictor.rollout(state, actions)[0][..., -1, :, :]


CASES = [("gn", "pendulum"), ("mlp", "pendulum"), ("recurrent", "pendulum")]
CASES.append(pytest.param(("gn", "swimmer6"), marks=pytest.mark.slow))


@pytest.fixture(params=CASES, ids=str)
def case(request, scenes, fit, random_states, random_actions):
    """A rollout, three start states and their actions."""
    core, name = request.param
    torch.manual_seed(0)
    model = fit(ForwardModel.for_scene(scenes[name], core=core, hidden=6, layers=1).double(), scenes[name])
    rollout = Rollout(model.bind(scenes[name]))
    return rollout, random_states(scenes[name], 3), random_actions(scenes[name], 3, STEPS)


def close(found: Tensor, wanted: Tensor) -> None:
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6 * float(wanted.detach().abs().max()))


@pytest.mark.slow
@pytest.mark.parametrize("transform", [jacfwd, jacrev])
def test_jacobians(case, transform):
    rollout, states, actions = case
    state, action = states[0], actions[0]
    close(transform(rollout, 0)(state, action), differences(lambda x: rollout(x, action), state))
    close(transform(rollout, 1)(state, action), differences(lambda x: rollout(state, x), action))
    each = vmap(transform(rollout, 1))(states, actions)
    close(each[0], transform(rollout, 1)(state, action))


def test_hessians(case):
    rollout, states, actions = case

    def cost(action: Tensor) -> Tensor:
        return rollout(states[0], action).square().sum()

    close(hessian(cost)(actions[0]), differences(grad(cost), actions[0]))


def test_samples_at_once(case):
    rollout, states, actions = case
    close(vmap(rollout)(states, actions), rollout(states, actions))


@pytest.mark.slow
def test_weights(case):
    rollout, states, actions = case
    weights = dict(rollout.named_parameters())
    name = next(name for name in weights if "node_mlp.2.bias" in name or "mlp.2.bias" in name)

    def of_all(weights: dict[str, Tensor]) -> Tensor:
        return functional_call(rollout, weights, (states, actions)).square().sum()

    def of_one(weight: Tensor) -> Tensor:
        return functional_call(rollout, {name: weight}, (states, actions)).square().sum()

    plain = torch.autograd.grad(rollout(states, actions).square().sum(), list(weights.values()), materialize_grads=True)
    for found, wanted in zip(grad(of_all)(weights).values(), plain, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)
    one = weights[name].detach()
    for transform in (jacfwd, jacrev):
        close(transform(of_one)(one), differences(of_one, one))
    close(hessian(of_one)(one), differences(grad(of_one), one))
    stacked = {name: torch.stack((each, 1.1 * each)).detach() for name, each in weights.items()}
    found = vmap(of_all)(stacked)
    for index in range(2):
        close(found[index], of_all({name: each[index] for name, each in stacked.items()}))


FIRST = """
import torch, torchrl_gn as gn
from torch.func import hessian
scene = gn.load_scene("swimmer3")
model = gn.ForwardModel.for_scene(scene, hidden=4, layers=1).double().bind(scene)
state = torch.eye(13, dtype=torch.float64)[3].expand(4, 13)
cost = lambda action: model.step(state, action)[0].square().sum()
action = torch.full((2,), 0.1, dtype=torch.float64)
first = hessian(cost)(action)
model.step(state, action)
assert torch.equal(hessian(cost)(action), first)
"""


@pytest.mark.slow
def test_as_the_first_call_of_a_process():
    """Nothing that is kept for later calls comes from inside the transform."""
    subprocess.run([sys.executable, "-c", FIRST], check=True)
