"""Updates of an actor-critic recorded as one CUDA graph; without a GPU, played where they would be replayed."""

from __future__ import annotations

import copy

import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.actor_critic import ActorCritic, ActorCriticTask, optimizer
from torchrl_gn.training.recorded_update import UpdateGraph

pytestmark = pytest.mark.slow


class Played(UpdateGraph):
    """Runs the update at every call."""

    def __init__(self, update, parameters, optimizers):
        self._update, self._parameters = update, parameters
        self._changed = [each.data for each in parameters]
        self._changed += [value for each in optimizers for state in each.state.values() for value in state.values()]

    @classmethod
    def or_none(cls, *arguments):
        return cls(*arguments)

    def __call__(self):
        self._before = [each.clone() for each in self._changed]
        for each in self._parameters:
            each.grad = None
        return self._update().tolist()


@pytest.fixture(
    params=[
        "cpu",
        pytest.param(
            "cuda",
            marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")],
        ),
    ]
)
def learners(request, monkeypatch, small):
    """Two that learn alike: the second without a graph."""
    options = small(device=request.param, value_lr=1e-2)
    scene, made = gn.load_scene("pendulum"), []
    reward = gn.make_reward("balance", scene)
    for _ in range(2):
        torch.manual_seed(0)
        task = ActorCriticTask(scene, options, reward)
        made.append(ActorCritic([task], options))
        task.collect()
        task.learn_model(0)
    if request.param == "cpu":
        monkeypatch.setattr(optimizer, "UpdateGraph", Played)
        made[0].optimizer._by_torch = 2
    made[1].optimizer._by_torch = 10**6
    return made


def update(learner, seed: int, states: torch.Tensor | None = None):
    torch.manual_seed(seed)
    given = learner.tasks[0].starts()(8) if states is None else states
    torch.manual_seed(seed)
    return learner.optimizer.learn([lambda count: given], updates=1, batch_size=8, desc="learning")


def weights(learner) -> torch.Tensor:
    return torch.cat([each.detach().flatten() for of in learner.optimizer.clipped for each in of])


def test_recorded_updates_are_those_of_torch(learners):
    for seed in range(5):
        before, found = weights(learners[1]), [update(each, seed) for each in learners]
        changed = weights(learners[1]) - before
        assert found[0] == pytest.approx(found[1], rel=1e-4, abs=1e-4)
        assert (weights(learners[0]) - weights(learners[1])).norm() < 1e-2 * changed.norm()
    assert learners[0].optimizer._graph is not None and learners[1].optimizer._graph is None
    for learner in learners:  # as between two rounds: the graph reads what is refreshed in place
        learner.tasks[0].learn_model(1)
    before, found = weights(learners[1]), [update(each, 5) for each in learners]
    assert found[0] == pytest.approx(found[1], rel=1e-3, abs=1e-3)


def test_a_gradient_that_is_not_finite_changes_nothing(learners):
    recorded = learners[0]
    for seed in range(3):
        update(recorded, seed)
    optimizer = recorded.optimizer
    before, adam = weights(recorded), copy.deepcopy(optimizer.state_dict()["adam"]["state"])
    scale = recorded.tasks[0].value.normalizer.std
    kept = scale.clone()
    scale.fill_(torch.nan)
    with pytest.raises(FloatingPointError, match="not finite at update 0; lower"):
        update(recorded, 3)
    scale.copy_(kept)
    assert torch.equal(weights(recorded), before)
    for index, state in optimizer.state_dict()["adam"]["state"].items():
        assert all(torch.equal(value, adam[index][name]) for name, value in state.items())
    update(recorded, 4)
    assert not torch.equal(weights(recorded), before) and bool(weights(recorded).isfinite().all())


def test_its_optimiser_goes_on_anywhere(learners):
    for seed in range(3):
        update(learners[0], seed)
    learners[1].optimizer.load_state_dict(learners[0].optimizer.state_dict())
    assert not any(group["capturable"] for group in learners[1].optimizer.optimizer.param_groups)
    update(learners[1], 3)


def test_values_learn_on_while_the_policy_waits(small):
    scene, found = gn.load_scene("pendulum"), {}
    for steps in (0, 20):
        torch.manual_seed(0)
        options = small(value_steps=steps, value_lr=1e-2)
        task = ActorCriticTask(scene, options, gn.make_reward("balance", scene))
        learner = ActorCritic([task], options)
        task.collect()
        task.learn_model(0)
        update(learner, 0)
        torch.manual_seed(1)
        loss = task.loss(task.starts()(64))["loss_value"]
        found[steps] = [each.detach().clone() for each in learner.policy.parameters()], float(loss.detach())
    torch.testing.assert_close(found[0][0], found[20][0], rtol=0, atol=0)
    assert found[20][1] < 0.7 * found[0][1]
