"""A gradient planner and its model: weights, other variants and devices."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel, Predictor, specialize
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.envs import ModelEnv, SceneEnv, batched
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

from ..sizes import SMALL


def trained(scene: Scene, **options) -> Predictor:
    """A small model with random weights and true statistics."""
    torch.manual_seed(0)
    bound = ForwardModel.for_scene(scene, **SMALL, **options).bind(scene)
    seen = collect_trajectories(scene, 5, 20, seed=0)
    update_parameter_normalizers(bound)
    update_dynamic_normalizers(bound, seen["state"][:, :-1], seen["action"], seen["state"][:, 1:])
    return bound


def test_weights_get_no_gradients():
    """Weights are frozen during planning only, so their gradients are not even computed."""
    bound = trained(load_scene("pendulum"))
    env = ModelEnv(bound, make_reward("balance", bound.scene))
    required, imagine = [], env.imagine_steps

    def watched(*inputs):
        required.append(any(weight.requires_grad for weight in bound.parameters()))
        return imagine(*inputs)

    env.imagine_steps = watched
    GradientPlanner(env, 3, 1, warm_up=2, samples=2, seed=0)(env.reset(TensorDict(batch_size=[2])))
    assert required and not any(required)
    assert all(weight.requires_grad and weight.grad is None for weight in bound.parameters())


def test_samples_of_other_variants_are_refused():
    bound = trained(load_scene("pendulum"))
    scene, other = bound.scene, load_scene("pendulum", timestep=0.04)
    planner = GradientPlanner(ModelEnv(bound, make_reward("balance", scene)), 3, 1, warm_up=1, samples=2, seed=0)
    start = planner.imagined.reset(TensorDict(batch_size=[2]))
    planner(start.clone().set("parameters", bound.own_parameters().expand(2)))
    parameters = PhysicalParameters.of(other).tensordict().expand(2)
    with pytest.raises(ValueError, match="other parameters 'globals_' than scene 'pendulum'"):
        planner(start.set("parameters", parameters))


def test_a_recurrent_model_remembers_what_was_played():
    scene = load_scene("pendulum")
    bound = trained(scene, core="recurrent", hidden_state=[4, 4, 4])
    reward = make_reward("balance", scene)
    planner = GradientPlanner(ModelEnv(bound, reward), 3, 1, warm_up=2, samples=3, candidates=2, seed=0)
    acted = SceneEnv(scene, reward, seed=0)
    start = acted.reset(TensorDict(batch_size=[2]))
    with pytest.raises(KeyError, match="make_tensordict_primer"):
        acted.rollout(2, planner, tensordict=start.clone(), auto_reset=False)
    primed = batched(acted, 2).append_transform(planner.make_tensordict_primer())
    executed = primed.rollout(4, planner)
    _, hidden_state = bound.teacher_forced(executed["state"], executed["action"])
    for key, value in hidden_state.items():
        torch.testing.assert_close(executed["next", "hidden_state", key][:, -1], value)
        assert (executed["hidden_state", key][:, 0] == 0).all()


def test_what_an_inference_model_wrote_is_planned_with(folds):
    scene = load_scene("pendulum")
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, parameters="inferred", inferred=[3, 3, 3], project=False, **SMALL).double()
    bound = model.bind(scene, parameters_key="parameters")
    seen = collect_trajectories(scene, 5, 20, seed=0)
    update_dynamic_normalizers(bound, seen["state"][:, :-1], seen["action"], seen["state"][:, 1:])
    reward = make_reward("balance", scene)
    special = specialize(bound)
    planner = GradientPlanner(ModelEnv(special, reward), 3, 1, warm_up=2, samples=3, candidates=2, seed=0)
    start = SceneEnv(scene, reward, seed=0).reset(TensorDict(batch_size=[2]))
    parameters = bound.own_parameters().expand(2).apply(torch.randn_like)
    start["parameters"] = parameters
    planner(start)
    total = planner.predicted_returns(start.select("state", "parameters"), torch.zeros(2, 1, 3, 1))
    for row in range(2):
        other = parameters.clone()
        other["nodes"][1 - row] += 1
        changed = planner.predicted_returns(start.select("state").set("parameters", other), torch.zeros(2, 1, 3, 1))
        assert changed[row] == pytest.approx(total[row].item(), rel=1e-6)
        assert changed[1 - row] != pytest.approx(total[1 - row].item(), rel=1e-6)
    folds.clear()
    planner(start)
    assert len(folds) <= 2  # of the candidates' values, not of every iteration's


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_model_on_a_gpu_plans_for_states_elsewhere():
    scene = load_scene("pendulum")
    bound = trained(scene).model.cuda().bind(scene)
    env = SceneEnv(scene, make_reward("balance", scene), seed=0)
    planner = GradientPlanner(ModelEnv(bound, make_reward("balance", scene)), 3, 1, warm_up=2, samples=3, seed=0)
    with torch.no_grad():
        executed = env.rollout(3, planner)
    assert executed["action"].device.type == executed["plan", "actions"].device.type == "cpu"
