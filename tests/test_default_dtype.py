"""Networks are float64 if it is PyTorch's default dtype; other tensors keep the dtype of their spec."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

import torchrl_gn as gn
from torchrl_gn.policies import Agent, GraphStatePolicy, StatePolicy, StateValue
from torchrl_gn.training import fit_policy, fit_value, load_pretrained

SCENE = "pendulum"


@pytest.fixture(autouse=True)
def float64() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.fixture
def trajectories(float64) -> TensorDict:
    return gn.collect_trajectories(gn.load_scene(SCENE), 4, steps=10, seed=0)


def dtypes(tensordict: TensorDictBase) -> dict[str, torch.dtype]:
    """Return the dtypes of a step's entries, by the last part of their keys."""
    items = tensordict.items(include_nested=True, leaves_only=True)
    return {key if isinstance(key, str) else key[-1]: value.dtype for key, value in items}


def check_rollout(tensordict: TensorDictBase) -> None:
    wanted = {"state": torch.float64, "action": torch.float32, "reward": torch.float32}
    found = dtypes(tensordict)
    assert {key: found[key] for key in wanted} == wanted
    assert found.get("discount", torch.float32) == torch.float32


@pytest.mark.slow
@pytest.mark.parametrize("core", ["gn", *(pytest.param(core, marks=pytest.mark.slow) for core in ("mlp", "recurrent"))])
def test_forward_models(trajectories, core, tmp_path):
    scene = gn.load_scene(SCENE)
    bound = gn.ForwardModel.for_scene(scene, core=core, hidden=4, layers=1).bind(scene)
    gn.fit(bound, trajectories, steps=2, progress=False)
    assert bound.dtype == torch.float64
    state, action = trajectories["state"][:, 0], trajectories["action"]
    wanted = bound.rollout(state, action)[0]
    assert wanted.dtype == torch.float64
    assert bound.step(state.float(), action[:, 0])[0].dtype == torch.float32
    torch.testing.assert_close(gn.specialize(bound).rollout(state, action)[0], wanted, rtol=1e-12, atol=1e-12)
    check_env_specs(env := gn.ModelEnv(gn.specialize(bound), gn.make_reward("balance", scene), seed=0))
    check_rollout(env.rollout(2))
    gn.evaluate_errors(bound, trajectories, horizons=(1, 2))
    torch.set_default_dtype(torch.float32)
    gn.save_checkpoint(path := tmp_path / "model.safetensors", bound.model)
    kept = load_pretrained(path).bind(scene)
    assert kept.dtype == torch.float64
    torch.testing.assert_close(kept.rollout(state, action)[0], wanted, rtol=0, atol=0)


@pytest.mark.slow
def test_planners_and_terminal_values():
    scene = gn.load_scene(SCENE)
    model, reward = gn.specialize(load_pretrained(SCENE).bind(scene)), gn.make_reward("balance", scene)
    episodes = gn.SceneEnv(scene, reward, seed=0).rollout(10).unsqueeze(0)
    value, policy = StateValue(scene, discount=0.9, hidden=[4]), StatePolicy(scene, hidden=[4])
    fit_value(value, episodes, steps=2)
    fit_policy(policy, episodes, steps=2)
    for terminal in (None, value):
        env = gn.ModelEnv(model, reward, terminal=terminal)
        real = gn.SceneEnv(scene, reward, terminal=terminal, seed=0)
        check_env_specs(env)
        check_env_specs(real)
        for planner in (
            gn.GradientPlanner(env, horizon=2, iterations=1, warm_up=1, candidates=2, proposal=policy, seed=0),
            gn.ILQGPlanner(env, horizon=2, iterations=1, proposal=policy),
        ):
            check_rollout(TransformedEnv(real, planner.make_tensordict_primer()).rollout(2, planner))


def test_gradient_planner():
    scene = gn.load_scene(SCENE)
    reward = gn.make_reward("balance", scene)
    env = gn.ModelEnv(gn.specialize(load_pretrained(SCENE).bind(scene)), reward)
    check_rollout(gn.SceneEnv(scene, reward, seed=0).rollout(2, gn.GradientPlanner(env, 2, 1, warm_up=1, seed=0)))


@pytest.mark.parametrize("kind", [StatePolicy, GraphStatePolicy])
def test_policies_of_states(trajectories, kind):
    scene = gn.load_scene(SCENE)
    env = gn.ModelEnv(gn.specialize(load_pretrained(SCENE).bind(scene)), gn.make_reward("balance", scene))
    policy, value = kind(scene, hidden=[4]), StateValue(scene, discount=0.9, hidden=[4])
    loss = gn.SHACLoss(policy, value, env, steps=2)
    loss.fit_normalizers(trajectories["state"], torch.rand(10, 1))
    out = loss(TensorDict({"state": trajectories["state"][:, 0]}, [4]))
    sum(out[name] for name in ("loss_actor", "loss_value", "loss_alpha")).backward()
    assert all(weight.dtype == weight.grad.dtype == torch.float64 for weight in loss.parameters())
    check_rollout(gn.SceneEnv(scene, seed=0).rollout(2, policy))
    check_rollout(gn.SceneEnv(scene, seed=0).rollout(2, policy.double()))  # as loading does, bounds and all


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("policy", ["mlp", "graph"])
def test_agents_of_float32_observations(observation_graphs, transitions, policy):
    graph = observation_graphs["swimmer3"]
    options = {"latent": 4, "hidden": (4,)}
    more = {"policy_options": options} if policy == "graph" else {}
    agent = Agent(graph, policy=policy, hidden=[4], model="gn", model_options=options, learned_reward=True, **more)
    observation, action, after = (each.float() for each in transitions(graph, 8))
    agent.update_normalizers(observation, action, after)
    batch = TensorDict({"observation": observation, "action": action}, [8])
    assert dtypes(agent.policy(batch.clone()))["action"] == torch.float32
    assert dtypes(agent.value(batch.clone()))["state_action_value"] == torch.float32
    ends = {name: torch.zeros(8, 1, dtype=torch.bool) for name in ("done", "terminated")}
    batch["next"] = TensorDict({"observation": after, "reward": torch.rand(8, 1, dtype=torch.float32), **ends}, [8])
    loss = gn.SVGLoss(agent.policy, agent.value, agent.model, agent.reward, steps=1)
    out = loss(batch)
    (out["loss_actor"] + out["loss_value"]).backward()
    assert all(weight.dtype == torch.float64 for weight in agent.parameters())


def test_identification(trajectories):
    scene = gn.load_scene(SCENE)
    forward = gn.ForwardModel.for_scene(scene, parameters="inferred", hidden=4, layers=1)
    loss = gn.IdentificationLoss(gn.IdentifyingModel(forward, node_hidden=[4]), scene, context_length=2)
    loss.fit_normalizers(gn.trajectory_buffer(trajectories, batch_size=20, seed=0).sample())
    out = loss(gn.trajectory_buffer(trajectories, batch_size=4, window=4, seed=0).sample())
    out["loss_forward_model"].backward()
    assert out["loss_forward_model"].isfinite()
