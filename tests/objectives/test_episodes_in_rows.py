"""Losses over rows of collected steps in which episodes end, against the episodes on their own."""

from __future__ import annotations

from typing import cast

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_gn.data import trajectory_buffer
from torchrl_gn.envs import SceneEnv, batched
from torchrl_gn.objectives import ForwardModelLoss, SeveralScenesLoss
from torchrl_gn.objectives.episodes_in_rows import starts_of

STEPS, ROWS = 9, 3


@pytest.fixture
def rows(scenes) -> TensorDictBase:
    """Rows ``[3, 9]`` of made-up ends; every episode starts somewhere else."""
    played = []
    for seed in range(3):
        env = batched(SceneEnv(scenes["pendulum"], seed=seed), ROWS)
        played.append(env.rollout(STEPS))
    row = cast(TensorDictBase, torch.stack(played)).clone()
    ends = torch.zeros(ROWS, STEPS, 1, dtype=torch.bool)
    ends[0, 3] = ends[1, 2] = ends[1, 3] = ends[2, 8] = True
    out = row[0].clone()
    out[0, 4:], out[1, 3], out[1, 4:] = row[1, 0, 4:], row[1, 1, 3], row[2, 1, 4:]
    out["next", "done"] = ends
    return out


def pieces(rows: TensorDictBase) -> list[TensorDictBase]:
    """The episodes in the rows, ``[1, h]`` each."""
    found = []
    for row in rows.unbind(0):
        first = 0
        for step in range(STEPS):
            if row["next", "done"][step] or step == STEPS - 1:
                found.append(row[first : step + 1].unsqueeze(0).exclude(("next", "done")))
                first = step + 1
    return found


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"core": "recurrent", "hidden_state": [4, 4, 4]}])
@pytest.mark.parametrize("forced", [1, 2])
def test_the_loss_is_that_of_the_episodes(scenes, make_model, rows, options, forced):
    scene = scenes["pendulum"]
    loss = ForwardModelLoss(make_model(scene, **options).bind(scene), teacher_forced_steps=forced)
    parts = pieces(rows)
    assert [part.shape[1] for part in parts] == [4, 5, 3, 1, 5, 9]
    expected = sum(loss(part)["loss_forward_model"] * part.shape[1] for part in parts) / rows.numel()
    torch.testing.assert_close(loss(rows)["loss_forward_model"], expected, rtol=1e-6, atol=0)
    flat = rows.clone()
    flat["next", "done"] = flat["next", "done"].squeeze(-1)
    assert torch.equal(loss(flat)["loss_forward_model"], loss(rows)["loss_forward_model"])
    plain, unrolled = (loss(rows.exclude(("next", "done")))["loss_forward_model"], loss(rows)["loss_forward_model"])
    assert plain > 2 * unrolled or options
    assert not torch.equal(plain, unrolled)
    by_scene = SeveralScenesLoss([loss])([rows])["loss_forward_model"]
    torch.testing.assert_close(by_scene, loss(rows)["loss_forward_model"])


def test_gradients_are_those_of_the_episodes(scenes, make_model, rows):
    scene = scenes["pendulum"]
    loss = ForwardModelLoss(make_model(scene).bind(scene))
    weights = [weight for weight in loss.parameters() if weight.requires_grad]
    total = sum(loss(part)["loss_forward_model"] * part.shape[1] for part in pieces(rows)) / rows.numel()
    expected = torch.autograd.grad(total, weights, allow_unused=True, materialize_grads=True)
    found = torch.autograd.grad(loss(rows)["loss_forward_model"], weights, allow_unused=True, materialize_grads=True)
    scale = max(float(each.abs().max()) for each in expected)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5 * scale)


def test_rows_without_ends_are_whole_windows(scenes, make_model, rows):
    scene = scenes["pendulum"]
    loss = ForwardModelLoss(make_model(scene).bind(scene))
    rows["next", "done"][:, :-1] = False
    assert torch.equal(loss(rows)["loss_forward_model"], loss(rows.exclude(("next", "done")))["loss_forward_model"])
    assert starts_of(rows["next", "done"], STEPS, 2) == starts_of(None, STEPS, 2)
    loss.set_keys(done="over")
    rows["next", "over"] = torch.rand(ROWS, STEPS, 1) < 0.5
    assert not torch.equal(loss(rows)["loss_forward_model"], loss(rows.exclude(("next", "over")))["loss_forward_model"])


def test_parameters_that_change_with_the_episode_are_refused(scenes, make_model, rows):
    scene = scenes["pendulum"]
    bound = make_model(scene).bind(scene, parameters_key="parameters")
    loss = ForwardModelLoss(bound)
    own = bound.own_parameters().expand(ROWS, STEPS).clone()
    loss(rows.set("parameters", own))
    own["nodes"][1, 5] *= 2
    with pytest.raises(ValueError, match="'parameters' of the batch: 'nodes' change where an episode of a row ends"):
        loss(rows.set("parameters", own))


def test_trajectories_with_ends_inside_are_refused(rows):
    state = torch.cat((rows["state"], rows["next", "state"][:, -1:]), dim=1)
    given = TensorDict({"state": state, "action": rows["action"], "next": {"done": rows["next", "done"]}}, [ROWS])
    with pytest.raises(ValueError, match=r"ends \('next', 'done'\) inside the trajectories"):
        trajectory_buffer(given, batch_size=2)
    given["next", "done"][:, :-1] = False
    trajectory_buffer(given, batch_size=2)
