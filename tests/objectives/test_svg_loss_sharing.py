"""The loss of stochastic value gradients shares statistics, and no weights, with its agent and its targets."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator
from torchrl.objectives import DDPGLoss, HardUpdate, ValueEstimators

from torchrl_gn.objectives import SVGLoss
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")


def test_statistics_of_a_graph_policy_count_in_the_loss_and_its_targets_at_once():
    """TorchRL's updaters copy weights only: targets must not be left with the statistics of the first hour."""
    torch.manual_seed(0)
    gamma, graph = 0.875, ObservationGraph.swimmer(3)
    agent = Agent(graph, policy="graph", hidden=(8,), policy_options={"latent": 4, "hidden": [8]})
    loss = SVGLoss(agent.policy, agent.value, steps=0, delay_actor=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)
    updater = HardUpdate(loss, value_network_update_interval=1)
    ended = torch.zeros(9, 1, dtype=torch.bool)
    after = {"observation": torch.randn(9, 13), "reward": torch.randn(9, 1), "done": ended, "terminated": ended}
    batch = TensorDict({"observation": torch.randn(9, 13), "action": torch.randn(9, 2), "next": after}, [9])

    def expected() -> tuple[Tensor, Tensor]:
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            torch.manual_seed(1)
            after = agent.value(agent.policy(batch["next"].select("observation")))["state_action_value"]
            now = agent.value(agent.policy(batch.select("observation")))["state_action_value"]
        return -now.mean(), (batch["next", "reward"] + gamma * after).squeeze(-1)

    for turn in range(2):
        agent.update_normalizers(3 * turn + torch.randn(20, 13), torch.rand(20, 2), torch.randn(20, 13))
        actor, target = expected()
        torch.manual_seed(1)
        out = loss(batch.clone())
        torch.testing.assert_close(out["target_value"], target)
        torch.testing.assert_close(out["loss_actor"].detach(), actor)
        for weight in agent.parameters():
            weight.data.mul_(1.1)
        torch.manual_seed(1)
        assert torch.equal(loss(batch.clone())["target_value"], out["target_value"])  # weights wait for the updater
        for _ in range(2):
            updater.step()
        torch.manual_seed(1)
        torch.testing.assert_close(loss(batch.clone())["target_value"], expected()[1])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16])
def test_a_loaded_or_cast_loss_still_shares_statistics(dtype):
    torch.manual_seed(0)
    graph = ObservationGraph.swimmer(3)
    agents = [Agent(graph, policy="graph", hidden=(8,), policy_options={"latent": 4, "hidden": [8]}) for _ in range(2)]
    losses = [SVGLoss(agent.policy, agent.value, steps=0, delay_actor=True) for agent in agents]
    agents[0].update_normalizers(torch.randn(20, 13), torch.rand(20, 2), torch.randn(20, 13))
    losses[1].load_state_dict({name: value.clone() for name, value in losses[0].state_dict().items()})
    losses[1].to(dtype)
    agents[1].update_normalizers(1 + torch.randn(20, 13), torch.rand(20, 2), torch.randn(20, 13))
    policy = agents[1].graph_policy
    assert policy is not None and policy.network.node_normalizer.count[0] == 120
    for parameters in (losses[1].actor_network_params, losses[1].target_actor_network_params):
        flat = parameters.flatten_keys(".")
        for name in ("mean", "std", "inverse_std"):
            key = next(key for key in flat.keys() if str(key).endswith(f"node_normalizer.{name}"))
            assert flat[key].dtype == torch.float64
            assert torch.equal(flat[key], getattr(policy.network.node_normalizer, name))
        assert all(weight.dtype == dtype for weight in flat.values() if weight.requires_grad)
    observation = torch.randn(3, 13, dtype=dtype)
    acted = agents[1].policy(TensorDict({"observation": observation}, [3]))
    assert acted["loc"].dtype == dtype and acted["loc"].isfinite().all()


def with_common_layer() -> tuple[TensorDictModule, ValueOperator, nn.Linear]:
    """Policy and value that see observations through the same layer."""
    torch.manual_seed(0)
    common = nn.Linear(3, 4).double()
    policy = TensorDictModule(nn.Sequential(common, nn.Linear(4, 2).double()), ["observation"], ["action"])
    return policy, ValueOperator(Shared(common), in_keys=["observation", "action"]), common


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda pair: pickle.loads(pickle.dumps(pair))], ids=["copy", "pickle"]
)
@pytest.mark.parametrize("separate", [False, True])
def test_a_copied_loss_trains_and_reads_the_networks_of_its_agent(copied, separate):
    torch.manual_seed(0)
    graph = ObservationGraph.swimmer(3)
    agent = Agent(graph, policy="graph", hidden=(8,), policy_options={"latent": 4, "hidden": [8]})
    agent.update_normalizers(torch.randn(20, 13), torch.rand(20, 2), torch.randn(20, 13))
    loss = SVGLoss(agent.policy, agent.value, steps=0, delay_actor=True, separate_losses=separate)
    ended = torch.zeros(9, 1, dtype=torch.bool)
    after = {"observation": torch.randn(9, 13), "reward": torch.randn(9, 1), "done": ended, "terminated": ended}
    batch = TensorDict({"observation": torch.randn(9, 13), "action": torch.randn(9, 2), "next": after}, [9])

    def losses(of: SVGLoss) -> Tensor:
        torch.manual_seed(1)
        out = of(batch.clone())
        return out["loss_actor"] + out["loss_value"]

    before, weights = losses(loss), [weight.clone() for weight in agent.parameters()]
    other, twin = copied((agent, loss))
    assert torch.equal(losses(twin), before)
    for _ in range(2):  # each with other statistics
        other.update_normalizers(3 + torch.randn(20, 13), torch.rand(20, 2), torch.randn(20, 13))
        fresh = SVGLoss(copy.deepcopy(other.policy), copy.deepcopy(other.value), steps=0, delay_actor=True)
        torch.testing.assert_close(losses(twin), losses(fresh))
        assert torch.equal(losses(loss), before)
    optimizer = torch.optim.SGD(twin.parameters(), lr=0.1)
    losses(twin).backward()
    optimizer.step()
    assert all(map(torch.equal, weights, agent.parameters()))
    trained = zip(agent.policy.parameters(), other.policy.parameters(), strict=True)
    assert not any(torch.equal(old, new) for old, new in trained if old.numel() > 1)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(1)
        now = other.value(other.policy(batch.select("observation")))["state_action_value"]
    torch.manual_seed(1)
    torch.testing.assert_close(twin.loss_actor(batch.clone())[0].detach(), -now.mean())


def test_targets_share_no_weights():
    """Policy and value may share weights, which TorchRL then holds as plain tensors."""
    policy, value, _ = with_common_layer()
    loss = SVGLoss(policy, value, steps=0, separate_losses=True, delay_actor=True)
    for name in ("actor_network_params", "value_network_params"):
        pairs = zip(
            getattr(loss, name).values(True, True), getattr(loss, f"target_{name}").values(True, True), strict=True
        )
        assert all(own.data_ptr() != target.data_ptr() for own, target in pairs)


@pytest.mark.parametrize("separate", [False, True])
def test_layers_that_policy_and_value_share_get_ddpgs_gradients(separate):
    ended = torch.zeros(5, 1, dtype=torch.bool)
    draw = torch.randn(5, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    after = {"observation": draw[:, 5:8], "reward": draw[:, 8:], "done": ended, "terminated": ended}
    batch = TensorDict({"observation": draw[:, :3], "action": draw[:, 3:5], "next": after}, [5])
    found = []
    for kind, options in ((DDPGLoss, {}), (SVGLoss, {"steps": 0})):
        policy, value, common = with_common_layer()
        loss = kind(policy, value, separate_losses=separate, **options)
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
        loss(batch.clone())["loss_actor"].backward()
        found.append(common.weight.grad)
    assert found[0].abs().sum() > 0
    torch.testing.assert_close(*found, rtol=1e-12, atol=1e-14)


class Shared(nn.Module):
    """A value that sees observations through a layer of someone else's."""

    def __init__(self, common: nn.Module) -> None:
        super().__init__()
        self.common, self.last = common, nn.Linear(6, 1).double()

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.last(torch.cat((self.common(observation), action), dim=-1))
