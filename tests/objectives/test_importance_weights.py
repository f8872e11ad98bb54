"""Importance weights of prioritised samplers: weighted means, and priorities for the next draws.

The samplers themselves need TorchRL's compiled extension, which not every machine has.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.envs import ModelEnv
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.objectives import (
    ForwardModelLoss,
    IdentificationLoss,
    ObservationModelLoss,
    SeveralScenesLoss,
    SHACLoss,
)
from torchrl_gn.policies import LearnedReward, ObservationModel, StatePolicy, StateValue
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import ObservationGraph, load_scene
from torchrl_gn.training import load_pretrained

from ..sizes import SMALL

WEIGHTS = torch.tensor([3.0, 0.5, 0.0, 2.0])


@pytest.fixture(scope="module")
def data():
    return collect_trajectories(load_scene("pendulum"), 8, 12, seed=0)


@pytest.fixture(scope="module")
def loss(data) -> ForwardModelLoss:
    torch.manual_seed(0)
    made = ForwardModelLoss(ForwardModel.for_scene("pendulum", **SMALL).bind("pendulum"), size_floor=0.2)
    made.fit_normalizers(trajectory_buffer(data, batch_size=90, seed=0).sample())
    return made


def windows(data, window: int = 1) -> TensorDict:
    return trajectory_buffer(data, batch_size=len(WEIGHTS), window=window, seed=1).sample().clone()


def per_step(batch: TensorDict, weights: torch.Tensor) -> torch.Tensor:
    return weights.view(-1, *[1] * (batch.ndim - 1)).expand(*batch.shape)


@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("shape", ["rows", "column", "steps"])
def test_means_are_weighted_and_each_step_gets_its_loss(data, loss, window, shape):
    batch = windows(data, window)
    each = torch.stack([loss(batch[i : i + 1])["loss_forward_model"] for i in range(len(WEIGHTS))])
    plain, expected = loss(batch)["loss_forward_model"], (WEIGHTS * each).sum() / WEIGHTS.sum()
    assert "td_error" not in batch.keys() and abs(plain - expected) > 0.01 * plain
    steps, each_step = per_step(batch, WEIGHTS), (*batch.shape, 1)
    if shape == "rows":
        batch.batch_size = batch.batch_size[:1]
    batch["priority_weight"] = {"rows": WEIGHTS, "column": steps.unsqueeze(-1), "steps": steps}[shape]
    out = loss(batch)
    torch.testing.assert_close(out["loss_forward_model"], expected)
    errors = [float(out[name]) for name in out.keys() if name.startswith("error_")]
    assert sum(errors) / sum(error > 0 for error in errors) == pytest.approx(expected.item())
    assert batch["td_error"].shape == each_step and not batch["td_error"].requires_grad
    counts = WEIGHTS > 0
    torch.testing.assert_close(batch["td_error"].flatten(1).mean(1)[counts], each[counts].detach())
    loss.use_prioritized_weights = False
    torch.testing.assert_close(loss(batch)["loss_forward_model"], plain)
    loss.use_prioritized_weights = "auto"


@pytest.mark.parametrize("names", [("surprise", "importance"), (("own", "surprise"), ("own", "importance"))])
def test_weighted_gradients_and_keys_of_ones_own(data, loss, names):
    batch, weights = windows(data, 3), list(loss.trained.parameters())
    parts = [loss(batch[i : i + 1])["loss_forward_model"] for i in range(len(WEIGHTS))]
    expected = torch.autograd.grad(
        sum(w * part for w, part in zip(WEIGHTS, parts, strict=True)) / WEIGHTS.sum(), weights
    )
    loss.set_keys(priority=names[0], priority_weight=names[1])
    try:
        batch[names[1]] = per_step(batch, WEIGHTS)
        found = torch.autograd.grad(loss(batch)["loss_forward_model"], weights)
    finally:
        loss.set_keys(priority="td_error", priority_weight="priority_weight")
    torch.testing.assert_close(found, expected)
    assert names[0] in batch.keys(True) and "td_error" not in batch.keys()


def test_padding_has_neither_weight_nor_priority(data, loss):
    batch = windows(data, 3)
    mask = torch.ones(4, 3, dtype=torch.bool)
    mask[1, 2] = mask[3, 1:] = False
    mask[2] = False
    batch["priority_weight"] = per_step(batch, torch.tensor([1.0, 2.0, 5.0, 3.0]))
    parts = [loss(batch[i : i + 1, :count])["loss_forward_model"] for i, count in ((0, 3), (1, 2), (3, 1))]
    expected = (3 * parts[0] + 2 * 2 * parts[1] + 3 * parts[2]) / (3 + 4 + 3)
    batch["collector", "mask"] = mask
    torch.testing.assert_close(loss(batch)["loss_forward_model"], expected)
    assert torch.equal(batch["td_error"].squeeze(-1) > 0, mask)


def test_weights_are_left_out_if_asked(data, loss):
    batch = windows(data)
    expected = loss(batch)["loss_forward_model"]
    loss.use_prioritized_weights = False
    try:
        batch["priority_weight"] = WEIGHTS
        assert torch.equal(loss(batch)["loss_forward_model"], expected) and "td_error" not in batch.keys()
    finally:
        loss.use_prioritized_weights = "auto"


def test_several_scenes_weigh_each_their_own(data, loss):
    batch = windows(data)
    batch["priority_weight"] = WEIGHTS
    expected = loss(batch.clone())["loss_forward_model"]
    both = torch.stack([batch])
    torch.testing.assert_close(SeveralScenesLoss([loss])(both)["loss_forward_model"], expected)
    assert both["td_error"].shape == (1, len(WEIGHTS), 1)


def test_an_estimate_counts_by_its_sequences_weight(data):
    torch.manual_seed(0)
    forward_model = ForwardModel.for_scene("pendulum", parameters="inferred", **SMALL)
    loss = IdentificationLoss(IdentifyingModel(forward_model), load_scene("pendulum"), context_length=3, num_queries=2)
    loss.fit_normalizers(trajectory_buffer(data, batch_size=90, seed=0).sample())
    batch = trajectory_buffer(data, batch_size=4, window=3, query_windows=(2, 2), seed=0).sample().clone()
    each = torch.stack([loss(batch[i : i + 1])["loss_forward_model"] for i in range(4)])
    batch["priority_weight"] = per_step(batch, WEIGHTS)
    torch.testing.assert_close(loss(batch)["loss_forward_model"], (WEIGHTS * each).sum() / WEIGHTS.sum())
    assert batch["td_error"].shape == (4, 7, 1)
    torch.testing.assert_close(batch["td_error"][[0, 1, 3], 0, 0], each[[0, 1, 3]].detach())
    renamed = batch.exclude("td_error", "priority_weight").set(("own", "weight"), batch["priority_weight"])
    loss.prediction.set_keys(priority="surprise", priority_weight=("own", "weight"))
    torch.testing.assert_close(loss(renamed)["loss_forward_model"], (WEIGHTS * each).sum() / WEIGHTS.sum())
    assert torch.equal(renamed["surprise"], batch["td_error"])


def test_observations_and_rewards_are_weighted():
    graph = ObservationGraph.swimmer(3)
    torch.manual_seed(0)
    model, reward = ObservationModel(graph, latent=4, hidden=(8,)), LearnedReward(13, 2, hidden=(8,))
    seen, after = (torch.randn(9, graph.num_observations) for _ in range(2))
    action = torch.randn(9, graph.num_actions)
    model.update_normalizers(seen, action, after)
    steps = {"observation": seen, "action": action, "next": {"observation": after, "reward": torch.randn(9, 1)}}
    batch, loss = TensorDict(steps, [9])[:4], ObservationModelLoss(model, reward)
    each = torch.stack([torch.stack(list(loss(batch[i : i + 1]).values())) for i in range(4)])
    batch["priority_weight"] = WEIGHTS
    out = loss(batch)
    expected = (WEIGHTS[:, None] * each).sum(0) / WEIGHTS.sum()
    torch.testing.assert_close(torch.stack([out["loss_model"], out["loss_reward"]]), expected)
    torch.testing.assert_close(batch["td_error"].squeeze(-1), each.sum(1).detach())


def test_imagined_trajectories_count_by_their_starts_weight(data, monkeypatch):
    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)  # equal states get equal actions
    scene = load_scene("pendulum")
    torch.manual_seed(0)
    model = load_pretrained("pendulum").bind(scene)
    policy, value = StatePolicy(scene, hidden=(16,)), StateValue(scene, discount=0.9, hidden=(16,))
    loss = SHACLoss(policy, value, ModelEnv(model, make_reward("balance", scene)), steps=3)
    loss.fit_normalizers(data["state"].flatten(0, 1), -3 * torch.rand(100, 1))
    state = data["state"][:3, 0]
    copies = torch.tensor([0, 0, 1, 2, 2, 2])  # a weight counts as copies
    found = {}
    for name, rows, weights in (("weighted", [0, 1, 2], [2.0, 1.0, 3.0]), ("copied", copies, [1.0] * 6)):
        batch = TensorDict({"state": state[rows], "priority_weight": torch.tensor(weights)}, [len(rows)])
        found[name] = loss(batch)
    for name in ("loss_actor", "loss_value", "reward", "entropy"):
        torch.testing.assert_close(found["weighted"][name], found["copied"][name])
