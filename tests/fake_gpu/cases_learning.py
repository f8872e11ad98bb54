"""Policies, actor-critic and off-policy training with weights on the device and environments beside it."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector

import torchrl_gn as gn
from torchrl_gn.objectives import ObservationModelLoss
from torchrl_gn.policies import Agent, GraphStatePolicy, StatePolicy, StateValue
from torchrl_gn.training import fit_policy, load_pretrained, mean_return

from ..learner import make_learner as make_learner
from ..learner import point_env as point_env
from .conftest import SYSTEMS, close, task
from .device import waits, without_waits

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")
NAMES = ("loss_actor", "loss_value", "loss_alpha")


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("kind", [StatePolicy, GraphStatePolicy])
def test_short_horizon_actor_critic(gpu, systems, data, pair, tmp_path, name, kind):
    scene, states = systems[name], data[name]["state"]
    torch.manual_seed(0)
    policy, value = kind(scene, hidden=[4]), StateValue(scene, discount=0.9, hidden=[4])
    found = []
    for model, device in zip(pair(scene), ("cpu", gpu), strict=True):
        env = gn.ModelEnv(gn.specialize(model.bind(scene), executor="eager"), task, seed=0)
        loss = gn.SHACLoss(copy.deepcopy(policy).to(device), copy.deepcopy(value).to(device), env, steps=2).to(device)
        loss.fit_normalizers(states.to(device), torch.linspace(-1, 1, 10).unsqueeze(1).to(device))
        torch.manual_seed(1)
        out = loss(TensorDict({"state": states[:, 0].to(device)}, [4]))
        weights = [weight for weight in loss.parameters() if weight.requires_grad]
        total = torch.stack([out[each].squeeze() for each in NAMES]).sum()
        found.append([*(out[each] for each in NAMES), *torch.autograd.grad(total, weights, materialize_grads=True)])
        gn.save_checkpoint(path := tmp_path / "policy.safetensors", loss.policy)
        assert next(load_pretrained(path).policy.parameters()).is_cpu
        for place in ("cpu", gpu):  # who plays may be elsewhere than who is played with
            played = gn.collect_trajectories(scene, 1, steps=2, seed=0, policy=copy.deepcopy(loss.policy).to(place))
            assert played["state"].is_cpu
    for here, there in zip(*found, strict=True):
        close(there, here, tolerance=1e-4)


@pytest.mark.parametrize("kind", [StatePolicy, GraphStatePolicy])
def test_policies_built_there(gpu, systems, data, kind):
    scene, states = systems["cheetah"], data["cheetah"]["state"][:, 0]
    torch.manual_seed(0)
    here = kind(scene, hidden=[4])
    here.features.update(states)
    with torch.device(gpu):
        there = kind(scene, hidden=[4])
    there.load_state_dict(here.state_dict())
    close(there.act(states.to(gpu)), here.act(states), tolerance=1e-6)
    other = there.for_scene(systems["cheetah"])
    assert {tensor.device for tensor in other.state_dict().values()} == {gpu}
    far = states.to(gpu)
    with without_waits(), torch.no_grad():
        there.act(far)


def test_imitation_of_episodes_elsewhere(gpu, systems):
    scene, losses = systems["swimmer6"], []
    episodes = gn.SceneEnv(scene, task, seed=0).rollout(8).unsqueeze(0)
    for device, given in (("cpu", episodes), (gpu, episodes), (gpu, episodes.to(gpu))):
        torch.manual_seed(0)
        losses.append(fit_policy(StatePolicy(scene, hidden=[4]).to(device), given, steps=3).losses)
    assert losses[1] == pytest.approx(losses[0], rel=1e-4) and losses[2] == pytest.approx(losses[0], rel=1e-4)


@pytest.mark.parametrize("policy", ["mlp", "graph"])
def test_stochastic_value_gradients(gpu, observation_graphs, transitions, policy):
    graph, sizes = observation_graphs["branching"], {"latent": 4, "hidden": (4,)}
    torch.manual_seed(0)
    more = {"policy_options": sizes} if policy == "graph" else {}
    agent = Agent(graph, policy=policy, hidden=[4], model="gn", model_options=sizes, learned_reward=True, **more)
    observation, action, after = (each.float() for each in transitions(graph, 8))
    ends = {name: torch.zeros(8, 1, dtype=torch.bool) for name in ("done", "terminated")}
    batch = TensorDict({"observation": observation, "action": action}, [8])
    batch["next"] = TensorDict({"observation": after, "reward": observation[:, :1], **ends}, [8])
    found = []
    for device in ("cpu", gpu):
        own = copy.deepcopy(agent).to(device)
        own.update_normalizers(*(each.to(device) for each in (observation, action, after)))
        loss = gn.SVGLoss(own.policy, own.value, own.model, own.reward, steps=2)
        torch.manual_seed(1)
        out = loss(batch.to(device))
        (out["loss_actor"] + out["loss_value"]).backward()
        models = ObservationModelLoss(own.model, own.reward)(batch.to(device))
        found.append([out["loss_actor"], out["loss_value"], models["loss_model"], models["loss_reward"]])
    for here, there in zip(*found, strict=True):
        close(there, here, tolerance=1e-4)


def test_off_policy_training_beside_its_environments(gpu, make_learner, point_env, monkeypatch, tmp_path):
    # TorchRL's collectors know how to wait for devices by their names.
    monkeypatch.setattr(Collector, "_get_sync_fn", lambda self, device: lambda: None)
    make = point_env.__init__
    monkeypatch.setattr(
        point_env, "__init__", lambda self, *args, **options: (make(self, *args, **options), self.to("cpu"))[0]
    )
    found = []
    for device in ("cpu", gpu):
        trainer = make_learner(make_learner().agent.to(device))
        last = [*trainer.run()][-1]
        gn.save_checkpoint(path := tmp_path / "agent.safetensors", trainer.agent, training=trainer.state_dict())
        resumed = make_learner(load_pretrained(path).agent.to(device), frames=240)
        resumed.load_state_dict(load_pretrained(path).training)
        found.append({**last.losses, "return": last.evaluation, "more": [*resumed.run()][-1].losses["loss_model"]})
        assert len(trainer.buffer) == 200 and trainer.buffer[:]["observation"].is_cpu
    assert found[1] == pytest.approx(found[0], rel=1e-3)
    assert mean_return(point_env(8), trainer.agent.policy, 5) == mean_return(point_env(8), trainer.agent.policy, 5)


def test_an_actor_critic_asks_once_whether_it_has_data(gpu, systems, data, pair):
    scene, states, counts = systems["swimmer6"], data["swimmer6"]["state"].to(gpu), []
    env = gn.ModelEnv(gn.specialize(pair(scene)[1].bind(scene), executor="eager"), task, seed=0)
    policy, value = StatePolicy(scene, hidden=[4]).to(gpu), StateValue(scene, discount=0.9, hidden=[4]).to(gpu)
    loss = gn.SHACLoss(policy, value, env, steps=2)
    with pytest.raises(RuntimeError, match="have seen no data"):
        loss(TensorDict({"state": states[:, 0]}, [4]))
    loss.fit_normalizers(states, torch.linspace(-1, 1, 10, device=gpu).unsqueeze(1))
    loss(TensorDict({"state": states[:, 0]}, [4]))  # constants go there once
    for fitted in (False, True):
        loss._fitted, before = fitted, waits()
        loss(TensorDict({"state": states[:, 0]}, [4]))
        counts.append(waits() - before)
    assert counts[0] == counts[1] + 2
