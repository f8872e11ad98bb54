"""Losses over rows of collected steps in which episodes end, against the episodes on their own."""

from __future__ import annotations

from typing import cast

import pytest
import torch
from tensordict import TensorDict, TensorDictBase, lazy_stack
from torchrl.collectors.utils import split_trajectories
from torchrl.data import MultiStep

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


@pytest.mark.parametrize("options", [{}, {"core": "recurrent", "hidden_state": [4, 4, 4]}])
def test_padding_does_not_count(scenes, make_model, rows, options):
    scene = scenes["pendulum"]
    loss = ForwardModelLoss(make_model(scene, **options).bind(scene))
    expected, padded = loss(rows), split_trajectories(rows, done_key="done")
    padded = cast(TensorDictBase, torch.cat((padded, torch.zeros_like(padded[:1]))))  # a row without any step
    assert padded.shape == (7, 9) and not padded["mask"].all()
    given = padded.clone()
    for key, value in loss(padded).items():
        torch.testing.assert_close(value, expected[key], rtol=1e-6, atol=0)
    assert (given == padded).all()
    for dim in (0, 1):
        stacked = lazy_stack([part.clone() for part in padded.unbind(dim)], dim)
        for key, value in loss(stacked).items():
            torch.testing.assert_close(value, expected[key], rtol=1e-6, atol=0)
        assert set(stacked.keys(True)) == set(padded.keys(True)) and (stacked == padded).all()
    within = rows.clone()
    within["state"][0, 5] = within["next", "state"][0, 5] = 0.0
    within["collector", "mask"] = torch.ones(ROWS, STEPS, dtype=torch.bool)
    within["collector", "mask"][0, 5] = False
    parts = pieces(rows)
    parts[1:2] = [parts[1][:, :1], parts[1][:, 2:]]
    wanted = sum(loss(part)["loss_forward_model"] * part.shape[1] for part in parts) / (rows.numel() - 1)
    torch.testing.assert_close(loss(within)["loss_forward_model"], wanted, rtol=1e-6, atol=0)
    flat, mask = padded.reshape(-1), padded["mask"].reshape(-1)
    assert torch.equal(loss(flat)["loss_forward_model"], loss(flat[mask].exclude("mask"))["loss_forward_model"])


def test_normalisers_are_not_fitted_to_padding(scenes, make_model, rows):
    padded, found = split_trajectories(rows, done_key="done"), []
    for batch in (padded, padded[padded["mask"]].exclude("mask")):
        loss = ForwardModelLoss(make_model(scenes["pendulum"]).bind(scenes["pendulum"]), noise=0.1)
        loss.fit_normalizers(batch)
        found.append((loss.noise_scale, loss.error_weight, loss.trained.node_normalizer.mean))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other)


def test_transitions_over_several_steps_are_refused(scenes, make_model, rows):
    loss = ForwardModelLoss(make_model(scenes["pendulum"]).bind(scenes["pendulum"]))
    for steps, batch in ((1, rows), (3, rows), (3, rows.reshape(-1))):
        moved = MultiStep(0.9, steps)(batch.clone())
        if steps == 1:
            assert torch.equal(loss(moved)["loss_forward_model"], loss(batch)["loss_forward_model"])
            continue
        for call in (loss, loss.fit_scales):
            with pytest.raises(ValueError, match="needs transitions of one step, the batch has some of 3"):
                call(moved)


@pytest.mark.parametrize("mask", [False, True])
@pytest.mark.parametrize("names", [("terminated",), ("truncated",), ("done", "truncated")])
def test_every_flag_ends_an_episode(scenes, make_model, rows, names, mask):
    """Gymnasium has no done."""
    loss = ForwardModelLoss(make_model(scenes["pendulum"]).bind(scenes["pendulum"]))
    if mask:
        rows["mask"] = torch.ones(ROWS, STEPS, dtype=torch.bool)
        rows["mask"][2, 5:] = False
    expected, ends = loss(rows)["loss_forward_model"], rows["next", "done"]
    given = rows.exclude(*(("next", name) for name in ("done", "terminated", "truncated")))
    for index, name in enumerate(names):
        given["next", name] = ends & (torch.arange(ROWS).view(-1, 1, 1) % len(names) == index)
    assert torch.equal(loss(given)["loss_forward_model"], expected)


def test_rows_without_ends_are_whole_windows(scenes, make_model):
    scene = scenes["pendulum"]
    rows = batched(SceneEnv(scene, seed=0), ROWS).rollout(STEPS)
    loss = ForwardModelLoss(make_model(scene).bind(scene))
    rows["next", "done"][:, :-1] = False
    assert torch.equal(loss(rows)["loss_forward_model"], loss(rows.exclude(("next", "done")))["loss_forward_model"])
    assert starts_of(rows["next", "done"], STEPS, 2) == starts_of(None, STEPS, 2)
    loss.set_keys(done="over")
    rows["next", "over"] = torch.rand(ROWS, STEPS, 1) < 0.5
    assert not torch.equal(loss(rows)["loss_forward_model"], loss(rows.exclude(("next", "over")))["loss_forward_model"])


@pytest.mark.parametrize("options", [{}, {"core": "recurrent", "hidden_state": [4, 4, 4]}])
def test_rows_that_go_on_elsewhere_without_an_end_are_refused(scenes, make_model, rows, options):
    scene = scenes["pendulum"]
    loss = ForwardModelLoss(make_model(scene, **options).bind(scene))
    loss(rows)
    with pytest.raises(ValueError, match="step 4 of row 0 does not start where step 3 ended"):
        loss(rows.exclude(("next", "done")))
    rows["next", "done"][0] = False
    with pytest.raises(ValueError, match="step 4 of row 0"):
        loss(rows)
    shuffled = batched(SceneEnv(scene, seed=0), ROWS).rollout(STEPS).exclude(("next", "done"))
    loss(shuffled)  # not yet
    noisy = shuffled.clone()
    noisy["state"][..., 1, :3] += 1e-4 * torch.randn(ROWS, STEPS, 3)
    loss(noisy)
    shuffled = cast(TensorDictBase, shuffled[:, torch.randperm(STEPS, generator=torch.Generator().manual_seed(1))])
    with pytest.raises(ValueError, match="consecutive"):
        loss(shuffled)
    forced = ForwardModelLoss(loss.model, teacher_forced_steps=STEPS)
    if not options:  # each step is one of its own
        expected = sum(loss(shuffled[:, t])["loss_forward_model"] for t in range(STEPS)) / STEPS
        torch.testing.assert_close(forced(shuffled)["loss_forward_model"], expected)


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
