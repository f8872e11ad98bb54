"""The loss of a forward model of observations: its scale, counted entries, and TorchRL's contract."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.objectives import ObservationModelLoss
from torchrl_gn.policies import LearnedReward, ObservationModel
from torchrl_gn.scenes import ObservationGraph

GRAPH = ObservationGraph.swimmer(3)


def transitions(*batch: int, seed: int = 0, unit: float = 1.0) -> TensorDict:
    """Random float64 steps; angles and targets are measured in ``unit``."""
    generator = torch.Generator().manual_seed(seed)
    scale = torch.ones(GRAPH.num_observations, dtype=torch.float64)
    scale[:4] = unit

    def draw(size: int) -> torch.Tensor:
        return torch.randn(*batch, size, generator=generator, dtype=torch.float64)

    observation, action = draw(GRAPH.num_observations), draw(GRAPH.num_actions)
    after = observation + 0.1 * draw(GRAPH.num_observations) + 0.02
    after = {"observation": scale * after, "reward": draw(1)}
    return TensorDict({"observation": scale * observation, "action": action, "next": after}, batch)


@pytest.fixture
def make_loss() -> Callable[..., ObservationModelLoss]:
    def make(*, rewarded: bool = False, unit: float = 1.0, change: slice | None = None) -> ObservationModelLoss:
        torch.manual_seed(0)
        model = ObservationModel(GRAPH, latent=4, hidden=(8,)).double()
        reward = LearnedReward(13, 2, hidden=(8,)).double() if rewarded else None
        loss, seen = ObservationModelLoss(model, reward), transitions(200, unit=unit)
        if change is not None:
            seen["next", "observation"][:, change] = seen["observation"][:, change]
        model.update_normalizers(seen["observation"], seen["action"], seen["next", "observation"])
        return loss

    return make


def test_a_perfect_model_costs_nothing(make_loss):
    loss, batch = make_loss(), transitions(9, seed=1)
    batch["next", "observation"] = loss.model.step(batch["observation"], batch["action"]).detach()
    assert loss(batch)["loss_model"] < 1e-24


def test_padding_and_several_steps_are_refused(make_loss):
    loss, batch = make_loss(), transitions(9, seed=1)
    with pytest.raises(ValueError, match=r"ObservationModelLoss: the batch has padding"):
        loss(batch.clone().set(("collector", "mask"), torch.arange(9) < 5))
    with pytest.raises(ValueError, match="needs transitions of one step, the batch has some of 2"):
        loss(batch.clone().set("steps_to_next_obs", torch.arange(9) % 2 + 1))


def test_the_value_is_the_mean_error_in_the_spread_of_changes(make_loss):
    loss, batch = make_loss(), transitions(9, seed=1)
    error = (loss.model(batch.clone())["next", "observation"] - batch["next", "observation"]) / loss.model.change_std
    torch.testing.assert_close(loss(batch)["loss_model"], error.square().mean(), rtol=1e-10, atol=0)
    shaped = loss(transitions(9, seed=1).reshape(3, 3))
    torch.testing.assert_close(shaped["loss_model"], error.square().mean(), rtol=1e-10, atol=0)


def test_units_do_not_matter(make_loss):
    values = [make_loss(unit=unit)(transitions(9, seed=1, unit=unit))["loss_model"] for unit in (1.0, 57.3, 1e-3)]
    torch.testing.assert_close(values[1:], [values[0]] * 2, rtol=1e-8, atol=0)


def test_numbers_that_never_varied_do_not_count(make_loss):
    """The target never moved in the data: its changes cost nothing, and the mean is over the other entries."""
    loss, batch = make_loss(change=slice(2, 4)), transitions(9, seed=1)
    assert (loss.model.change_std == 0).nonzero().flatten().tolist() == [2, 3]
    before = loss(batch)["loss_model"]
    batch["next", "observation"][:, 2:4] += 100
    assert torch.equal(loss(batch)["loss_model"], before)
    counted = [index for index in range(13) if index not in (2, 3)]
    error = loss.model(batch.clone())["next", "observation"] - batch["next", "observation"]
    scaled = error[:, counted] / loss.model.change_std[counted]
    torch.testing.assert_close(before, scaled.square().mean(), rtol=1e-10, atol=0)


def test_rewards_are_compared_as_they_are(make_loss):
    loss, batch = make_loss(rewarded=True), transitions(9, seed=1)
    assert loss.reward is not None
    predicted = loss.reward(batch["observation"], batch["action"], batch["next", "observation"])
    out = loss(batch)
    expected = (predicted - batch["next", "reward"]).square().mean()
    torch.testing.assert_close(out["loss_reward"], expected, rtol=1e-12, atol=0)
    assert torch.equal(out["loss_model"], make_loss()(batch)["loss_model"])
    loss.set_keys(reward=("task", "score"))
    batch["next", "task"] = TensorDict({"score": batch["next"].pop("reward")}, batch.batch_size)
    assert torch.equal(loss(batch)["loss_reward"], out["loss_reward"])


def test_each_loss_trains_its_own_network(make_loss):
    loss, batch = make_loss(rewarded=True), transitions(9, seed=1)
    for name, network in (("loss_model", loss.model), ("loss_reward", loss.reward)):
        loss.zero_grad(set_to_none=True)
        loss(batch)[name].backward()
        reached = {weight for weight in loss.parameters() if weight.grad is not None}
        assert reached == set(network.parameters())
        assert all(weight.grad.abs().sum() > 0 for weight in reached if weight.grad is not None)


def test_entries_may_be_given_one_by_one_and_are_left_alone(make_loss):
    loss, batch = make_loss(rewarded=True), transitions(9, seed=1)
    before, expected = batch.clone(), loss(batch)
    assert (batch == before).all() and set(batch.keys(True)) == set(before.keys(True))
    named = {"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss.in_keys}
    assert all(torch.equal(value, expected[key]) for key, value in zip(loss.out_keys, loss(**named), strict=True))


def test_what_is_missing_or_not_finite_is_named_and_changes_nothing(make_loss):
    loss = make_loss(rewarded=True)
    before = {name: value.clone() for name, value in loss.state_dict().items()}
    for key in loss.in_keys:
        missing, broken = transitions(9).exclude(key), transitions(9)
        broken[key][4, 0] = torch.nan
        with pytest.raises(KeyError) as caught:
            loss(missing)
        assert f"ObservationModelLoss needs {key!r}, the batch has" in str(caught.value.args[0])
        with pytest.raises(ValueError, match="has nan at index") as refused:
            loss(broken)
        assert str(refused.value).startswith(f"{key!r} of the batch has nan at index (4, 0)")
    assert all(torch.equal(value, before[name]) for name, value in loss.state_dict().items())


def test_an_empty_batch_is_refused(make_loss):
    with pytest.raises(ValueError, match=r"ObservationModelLoss: the batch \[0\] is empty"):
        make_loss()(transitions(9)[:0])


def test_rewards_of_another_shape_are_refused(make_loss):
    """Broadcasting would compare every reward with every other."""
    loss, batch = make_loss(rewarded=True), transitions(9)
    batch["next", "reward"] = batch["next", "reward"].squeeze(-1)
    with pytest.raises(ValueError, match=r"\('next', 'reward'\) must be \[9, 1\] as the predicted rewards, got \[9\]"):
        loss(batch)
