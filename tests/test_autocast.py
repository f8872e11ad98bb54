"""Results within ``torch.autocast`` equal results outside of it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_gn import training
from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.envs import ModelEnv
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.objectives import ForwardModelLoss, SHACLoss
from torchrl_gn.planners import GradientPlanner, ILQGPlanner
from torchrl_gn.policies import Agent, GraphStatePolicy, StatePolicy, StateValue
from torchrl_gn.rewards import make_reward


def check(function, atol: float = 0) -> None:
    """Compare tensors, or gradients of a number that is pulled back outside, as PyTorch asks."""
    results = []
    for enabled in (False, True):
        torch.manual_seed(0)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            out = function()
        results.append(out() if callable(out) else out)
    torch.testing.assert_close(*results, rtol=0, atol=atol)


def test_the_decorator_is_for_one_call():
    a = torch.randn(3, 3)
    product = without_autocast(torch.matmul)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert product(a, a).dtype == torch.float32
        assert (a @ a).dtype == torch.bfloat16


@pytest.mark.parametrize("options", [{}, {"reference": True}, {"executor": "native"}, {"executor": "eager"}], ids=str)
@pytest.mark.parametrize("core", ["gn", "mlp", "recurrent"])
def test_predictions(scenes, fit, random_states, random_actions, core, options):
    """States are float32; autocast would round them to 8 bits."""
    scene = scenes["cheetah"]
    model = fit(ForwardModel.for_scene(scene, core=core, hidden=8, layers=1), scene)
    predictor = specialize(model.bind(scene), **options) if "executor" in options else model.bind(scene, **options)
    states, actions = random_states(scene, 3, 4).float(), random_actions(scene, 3, 4).float()
    state, action = states[:, 0].requires_grad_(), actions[:, 0]
    check(lambda: predictor.step(state, action)[0].detach())
    check(lambda: predictor.rollout(state, actions)[0].detach())
    check(lambda: predictor.teacher_forced(states, actions)[0].detach())
    check(lambda: predictor.delta(state, action).detach())
    check(lambda: predictor(TensorDict({"state": state, "action": action}, [3]))["next", "state"].detach())

    def gradient():
        total = predictor.rollout(state, actions)[0].sum()
        return lambda: torch.autograd.grad(total, state)[0]

    check(gradient)


@pytest.mark.parametrize("core", ["gn", "recurrent"])
def test_losses_of_forward_models(scenes, make_model, random_states, random_actions, core):
    scene = scenes["cheetah"]
    model = make_model(scene, core=core)
    loss = ForwardModelLoss(model.bind(scene))
    state, after = random_states(scene, 20).float(), random_states(scene, 20, seed=1).float()
    batch = TensorDict({"state": state, "action": random_actions(scene, 20), "next": {"state": after}}, [20])

    def statistics():
        loss.fit_normalizers(batch)
        return loss.noise_scale.clone()

    def gradients():
        value = loss(batch)["loss_forward_model"]
        return lambda: torch.autograd.grad(value, list(model.parameters()), allow_unused=True)

    check(statistics)
    check(gradients)


def test_inference(scenes, make_model, random_states, random_actions):
    scene = scenes["pendulum"]
    model = IdentifyingModel(make_model(scene, parameters="inferred"), node_hidden=[8])
    inference = model.bind(scene)[1]
    state, after = random_states(scene, 2, 5).float(), random_states(scene, 2, 5, seed=1).float()
    action = random_actions(scene, 2, 5).float()
    check(lambda: dict(inference.infer(state, action, after).parameters.detach().items()))


def test_planners(scenes, make_model, random_states):
    scene = scenes["pendulum"]
    env = ModelEnv(specialize(make_model(scene).bind(scene)), make_reward("balance", scene), seed=0)
    start = env.reset(TensorDict({"state": random_states(scene, 2)}, [2]), set_state=True)
    check(lambda: GradientPlanner(env, horizon=2, iterations=1, warm_up=1, seed=0)(start.clone())["action"])
    check(lambda: ILQGPlanner(env, horizon=2, iterations=1)(start[0].clone())["action"])


def test_policies_and_values(scenes, make_model, random_states):
    scene = scenes["cheetah"]
    env = ModelEnv(specialize(make_model(scene).bind(scene)), make_reward("run", scene), seed=0)
    states = random_states(scene, 8)
    policy, value = StatePolicy(scene, hidden=[8]), StateValue(scene, discount=0.9, hidden=[8])
    loss = SHACLoss(policy, value, env, steps=2)
    loss.fit_normalizers(states, torch.rand(8, 1))
    graph_policy = GraphStatePolicy(scene, hidden=[8])
    graph_policy.features.update(states)
    for each in (policy, graph_policy):
        check(lambda each=each: each.act(states.float()).detach())
    check(lambda: value(states.float()).detach())
    check(lambda: env.reward(states.float(), torch.zeros(8, 6), states.float()))
    check(lambda: dict(loss(TensorDict({"state": states}, [8])).detach().items()))


def test_policies_of_observations(observation_graphs, transitions):
    graph = observation_graphs["swimmer3"]
    observation, action, after = (each.float() for each in transitions(graph))
    options = {"latent": 4, "hidden": (8,)}
    agent = Agent(graph, policy="graph", policy_options=options, model="gn", model_options=options, hidden=[8])
    agent.update_normalizers(observation, action, after)
    assert agent.graph_policy is not None
    assert agent.model is not None
    check(lambda: [each.detach() for each in agent.graph_policy(observation)])
    check(lambda: agent.model.step(observation, action).detach())
    check(lambda: agent.value.module(observation, action).detach())


@pytest.mark.slow
def test_training(scenes, make_model):
    scene = scenes["pendulum"]
    trajectories = collect_trajectories(scene, 4, steps=10, seed=0)
    env = ModelEnv(make_model(scene).bind(scene), make_reward("balance", scene), seed=0)
    episodes = env.rollout(20, tensordict=TensorDict(batch_size=[2])).detach()

    def trained() -> list[Tensor]:
        model = make_model(scene)
        training.fit(model.bind(scene), trajectories, steps=2, progress=False)
        value, policy = StateValue(scene, discount=0.9, hidden=[8]), StatePolicy(scene, hidden=[8])
        training.fit_value(value, episodes, steps=2)
        training.fit_policy(policy, episodes, steps=2)
        return [weight.detach() for each in (model, value, policy) for weight in each.parameters()]

    check(trained, atol=1e-6)  # PyTorch's products promise no bits between two runs; autocast's rounding moves 1e-1
