"""torch.compile takes steps of specialised models as operators: whole graphs, gradients, present weights."""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDict

from torchrl_gn.dynamics import specialize


def compiled(function):
    return torch.compile(function, fullgraph=True, backend="aot_eager")


def test_a_compiled_function_steps_and_differentiates(scenes, make_model, random_states, random_actions):
    scene = scenes["swimmer6"]
    quick = specialize(make_model(scene).bind(scene))
    state, actions = random_states(scene, 3), random_actions(scene, 3, 4).requires_grad_()

    def step(state, actions):
        return quick.step(state, actions[:, 0])[0].square()

    def rollout(state, actions):
        return quick.rollout(state, actions)[0].square()

    for function in (step, rollout):
        results = []
        for way in (function, compiled(function)):
            out = way(state, actions)
            results.append((out, *torch.autograd.grad(out.sum(), actions)))
        for expected, found in zip(*results, strict=True):
            torch.testing.assert_close(found, expected)


def test_a_compiled_model_follows_its_weights(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    model = make_model(scene)
    quick = specialize(model.bind(scene))
    inputs = TensorDict({"state": random_states(scene, 2), "action": random_actions(scene, 2)}, [2])
    run = compiled(quick)
    before = run(inputs.clone())["next", "state"]
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(1.5)
    after = run(inputs.clone())["next", "state"]
    assert not torch.equal(before, after)
    assert torch.equal(after, quick(inputs.clone())["next", "state"])


def test_operators_pass_torchs_own_checks(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    quick = copy.deepcopy(specialize(make_model(scene).bind(scene)))
    state, action = random_states(scene, 2).requires_grad_(), random_actions(scene, 2).requires_grad_()
    # Not that of gradients under dispatch modes: torch operations run there, and differ in components that cannot move.
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    inputs = (state, action, quick.number, False)
    torch.library.opcheck(torch.ops.torchrl_gn.rollout.default, inputs, test_utils=checks)
