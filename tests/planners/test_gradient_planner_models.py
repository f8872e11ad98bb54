"""What a gradient planner does with its model: weights, other variants and devices."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.modules import BoundForwardModel, FeatureSet, ForwardModel
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import Scene, load_scene
from torchrl_gn.scenes.scene_values import SceneValues


def trained(scene: Scene) -> BoundForwardModel:
    """A small model with random weights and true statistics."""
    torch.manual_seed(0)
    sizes = {"latent": 8, "edge_hidden": [8], "node_hidden": [8], "global_hidden": [8]}
    bound = ForwardModel(FeatureSet.of(scene), **sizes).bind(scene)
    seen = collect_trajectories(scene, 5, 20, seed=0)
    bound.update_static_normalizers()
    bound.update_dynamic_normalizers(seen["state"][:, :-1], seen["action"], seen["state"][:, 1:])
    return bound


def test_weights_get_no_gradients():
    """Not even computed: they are frozen while it plans, and only then."""
    bound = trained(load_scene("pendulum"))
    env = ModelEnv(bound, make_reward("balance", bound.scene))
    required, imagine = [], env.imagine

    def watched(*inputs):
        required.append(any(weight.requires_grad for weight in bound.parameters()))
        return imagine(*inputs)

    env.imagine = watched
    GradientPlanner(env, 3, 1, warm_up=2, samples=2, seed=0).planning(env.reset(TensorDict(batch_size=[2])))
    assert required and not any(required)
    assert all(weight.requires_grad and weight.grad is None for weight in bound.parameters())


def test_samples_of_other_variants_are_refused():
    bound = trained(load_scene("pendulum"))
    scene, other = bound.scene, load_scene("pendulum", timestep=0.04)
    planner = GradientPlanner(ModelEnv(bound, make_reward("balance", scene)), 3, 1, warm_up=1, samples=2, seed=0)
    start = planner.imagined.reset(TensorDict(batch_size=[2]))
    planner.planning(start.clone().set("static", bound.own_static().expand(2)))
    static = SceneValues.of(other).tensordict().expand(2)
    with pytest.raises(ValueError, match="other static 'globals_' than scene 'pendulum'"):
        planner.planning(start.set("static", static))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_model_on_a_gpu_plans_for_states_elsewhere():
    scene = load_scene("pendulum")
    bound = trained(scene).model.cuda().bind(scene)
    env = SceneEnv(scene, make_reward("balance", scene), seed=0)
    planner = GradientPlanner(ModelEnv(bound, make_reward("balance", scene)), 3, 1, warm_up=2, samples=3, seed=0)
    with torch.no_grad():
        played = env.rollout(3, planner)
    assert played["action"].device.type == played["plan", "actions"].device.type == "cpu"
