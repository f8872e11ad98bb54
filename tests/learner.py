"""Points that learn to stand still, in milliseconds a step."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.objectives import ValueEstimators

from torchrl_gn.objectives import ObservationModelLoss, SVGLoss
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training import OffPolicyTrainer, mean_return


class Point(EnvBase):
    """Points on a line that actions push; the reward is minus the squared distance from 0, or ``pay``."""

    def __init__(self, num: int = 4, steps: int | tuple[int, ...] = 20, pay: Callable | None = None) -> None:
        super().__init__(batch_size=[num])
        flags = {name: Binary(1, (num, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.observation_spec = Composite(observation=Unbounded((num, 1)), shape=(num,))
        self.action_spec, self.reward_spec = Bounded(-1, 1, (num, 1)), Unbounded((num, 1))
        self.done_spec = Composite(flags, shape=(num,))
        self.generator, self.pay = torch.Generator().manual_seed(0), pay
        self.length = torch.tensor(steps).expand(num).view(num, 1)
        self.place, self.count = torch.zeros(num, 1), torch.zeros(num, 1, dtype=torch.long)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDict:
        start = 2 * torch.rand(*self.place.shape, generator=self.generator) - 1
        begins = None if tensordict is None else tensordict.get("_reset", None)
        begins = torch.ones_like(self.count, dtype=torch.bool) if begins is None else begins.view(-1, 1)
        self.place, self.count = torch.where(begins, start, self.place), torch.where(begins, 0, self.count)
        return TensorDict({"observation": self.place}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.place, self.count = self.place + 0.2 * tensordict["action"], self.count + 1
        over = self.count >= self.length
        reward = -self.place.square() if self.pay is None else self.pay(self.count)
        ends = {"done": over, "truncated": over, "terminated": torch.zeros_like(over)}
        return TensorDict({"observation": self.place, "reward": reward, **ends}, self.batch_size)


@pytest.fixture
def point_env() -> type[Point]:
    """Fast environments."""
    return Point


@pytest.fixture
def make_learner() -> Callable[..., OffPolicyTrainer]:
    """SVG(1) of points on a line, with a small model and from the same seeds; or of the agent given."""
    graph = ObservationGraph(
        "point",
        {"place": 1},
        {"line": (), "point": ("place",)},
        {("line", "point"): ()},
        actions={("line", "point"): (0,)},
    )

    def make(agent: Agent | None = None, *, seed: int = 0, lr: float = 1e-2, **options) -> OffPolicyTrainer:
        torch.manual_seed(seed)
        sizes = {"model": "mlp", "model_options": {"mlp_hidden": [16]}}
        agent = agent or Agent(graph, hidden=(16,), **sizes)
        loss = SVGLoss(agent.policy, agent.value, agent.model, lambda x, u, after: -after.square(), delay_actor=True)
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
        losses = [loss, ObservationModelLoss(agent.model)]
        weights = [weight for each in losses for weight in each.parameters()]
        evaluation = Point(8)
        small = {"frames": 200, "batch_size": 32, "frames_per_batch": 20, "random_frames": 100, "evaluate_frames": 100}
        small |= {"target_interval": 4}
        optimizer = torch.optim.Adam(weights, lr=lr)

        def evaluate() -> float:
            return mean_return(evaluation, agent.policy, 20)

        return OffPolicyTrainer(agent, losses, Point(), agent.policy, evaluate, optimizer, **(small | options))

    return make
