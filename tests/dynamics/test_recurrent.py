"""The recurrent forward model: its hidden state as TensorDict entries, and training on windows."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, Predictor
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.envs import ModelEnv
from torchrl_gn.evaluation import evaluate_errors, guarded_rollout
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene


@pytest.fixture
def bound(make_model) -> Predictor:
    scene = load_scene("swimmer3")
    model = make_model(scene, core="recurrent", hidden_state=(3, 4, 5)).double()
    # GRUs begin with small weights; larger ones make what is remembered visible.
    with torch.no_grad():
        for cell in (model.core.nodes, model.core.edges, model.core.globals_):
            for weight in cell.parameters():
                weight.mul_(3)
    bound = model.bind(scene)
    assert isinstance(bound, Predictor)
    return bound


@pytest.fixture(scope="module")
def trajectories() -> TensorDict:
    return collect_trajectories(load_scene("swimmer3"), 6, 12, seed=0)


def test_the_past_counts_and_nothing_else_is_forgotten(bound, trajectories):
    state, action = trajectories["state"][:, :8], trajectories["action"][:, :8]
    predicted, hidden_state = bound.teacher_forced(state, action)
    alone = bound.step(state[:, 7], action[:, 7])[0]
    assert torch.equal(bound.teacher_forced(state[:, 7:], action[:, 7:])[0][:, 0], alone)
    assert not torch.allclose(predicted[:, 7], alone, rtol=0, atol=1e-9)
    half = bound.teacher_forced(state[:, :4], action[:, :4])[1]
    for step in range(4, 8):
        after, half = bound.step(state[:, step], action[:, step], hidden_state=half)
    torch.testing.assert_close(after, predicted[:, 7])
    for key in ("nodes", "edges", "globals_"):
        torch.testing.assert_close(half[key], hidden_state[key])
    with pytest.raises(ValueError, match="no state to predict from"):
        bound.teacher_forced(state[:, :0], action[:, :0])


def test_wrong_shapes_are_named(bound, trajectories):
    state, action = trajectories["state"][:, :3], trajectories["action"][:, :3]
    wrong = action[..., :1]  # one action, which would be that of both motors
    with pytest.raises(ValueError, match=r"Action of scene 'swimmer3' must be \[6, 2\]"):
        bound.step(state[:, 0], wrong[:, 0])
    with pytest.raises(ValueError, match="Action of scene"):
        bound.teacher_forced(state, wrong)
    with pytest.raises(ValueError, match="State of scene"):
        bound.teacher_forced(state[..., :12], action)
    variants = bound.model.bind(bound.scene, parameters_key="parameters")
    sample = {"state": state[:, 0], "action": action[:, 0], "parameters": variants.own_parameters().expand(1)}
    with pytest.raises(ValueError, match=r"no batch or that of the state, \[6\], got \[1\]"):
        variants(TensorDict({**sample}))
    with pytest.raises(ValueError, match="Physical parameters must have"):
        variants.teacher_forced(state, action, sample["parameters"])


def test_folded_and_plain_are_the_same(bound, trajectories):
    plain = bound.model.bind(bound.scene, reference=True)
    state, action = trajectories["state"][:, :5], trajectories["action"][:, :5]
    found, expected = bound.teacher_forced(state, action), plain.teacher_forced(state, action)
    torch.testing.assert_close(found[0], expected[0], rtol=1e-10, atol=1e-12)
    gradients = [
        torch.autograd.grad(out[0].square().sum(), [p for p in bound.model.core.parameters() if p.ndim == 2])
        for out in (found, expected)
    ]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-9)


def test_environments_and_rollouts_carry_the_hidden_state(bound, trajectories):
    start, actions = trajectories["state"][:, 4], trajectories["action"][:, 4:]
    hidden_state = bound.teacher_forced(trajectories["state"][:, :4], trajectories["action"][:, :4])[1].detach()
    expected = bound.rollout(start, actions, hidden_state=hidden_state)[0]
    assert not torch.allclose(expected, bound.rollout(start, actions)[0], rtol=0, atol=1e-9)
    guarded = guarded_rollout(bound, start, actions, hidden_state=hidden_state, every=3)
    torch.testing.assert_close(guarded.states, expected)
    env = ModelEnv(bound)
    td = env.reset(TensorDict({"state": start, "hidden_state": hidden_state}, [6]), set_state=True)
    for action in actions.unbind(1):
        td = step_mdp(env.step(td.set("action", action.to(env.action_spec.dtype))))
    torch.testing.assert_close(td["state"], expected[:, -1], rtol=1e-5, atol=1e-6)
    assert (env.reset()["hidden_state", "nodes"] == 0).all()
    entries = bound(TensorDict({"state": start, "action": actions[:, 0]}, [6]))  # remembers nothing yet
    assert torch.equal(entries["next", "state"], bound.step(start, actions[:, 0])[0])
    assert entries["next", "hidden_state", "edges"].shape == (6, bound.scene.num_edges, 4)


@pytest.mark.slow
def test_errors_begin_behind_the_burn_in(bound, trajectories):
    table = evaluate_errors(bound, trajectories, horizons=(5,), burn_in=4, keep=6)
    hidden_state = bound.teacher_forced(trajectories["state"][:, :4], trajectories["action"][:, :4])[1]
    expected = bound.rollout(trajectories["state"][:, 4], trajectories["action"][:, 4:9], hidden_state=hidden_state)[0]
    torch.testing.assert_close(table.rollouts, expected.detach())
    cold = evaluate_errors(bound, trajectories[:, :].clone(), horizons=(5,), burn_in=0)
    assert table["one_step_error"].total != cold["one_step_error"].total
    with pytest.raises(ValueError, match="rollout of 16 steps"):
        evaluate_errors(bound, trajectories, horizons=(12,), burn_in=4)


@pytest.mark.parametrize("forced", [1, 3, 9])
def test_teacher_forcing_feeds_true_states_first(bound, trajectories, forced):
    loss = ForwardModelLoss(bound, teacher_forced_steps=forced)
    batch = trajectory_buffer(trajectories, batch_size=4, window=5, seed=0).sample()
    loss.fit_normalizers(trajectory_buffer(trajectories, batch_size=50, seed=0).sample())
    state, action, target = batch["state"], batch["action"], batch["next", "state"]
    hidden_state, current, errors, program = None, state[:, 0], [], bound.program()
    for step in range(5):
        delta, hidden_state = eager.delta(program, current, action[:, step], hidden_state)
        errors.append(loss.component_errors(delta, bound.layout.delta(current, target[:, step])))
        following = state[:, step + 1] if step + 1 < min(forced, 5) else bound.layout.apply(current, delta)
        current = following
    expected = torch.stack(errors).mean(0).sum() / 4
    torch.testing.assert_close(loss(batch)["loss_forward_model"], expected)
    loss(batch)["loss_forward_model"].backward()
    core = bound.model.core
    assert all(cell.weight_hh.grad.abs().sum() > 0 for cell in (core.nodes, core.edges, core.globals_))
    with pytest.raises(ValueError, match="teacher_forced_steps=0"):
        ForwardModelLoss(bound, teacher_forced_steps=0)


def test_truncated_gradients_stop_at_the_hidden_state(bound, trajectories):
    """The gradient of one step reaches no weight of the hidden state before it."""
    batch = trajectory_buffer(trajectories, batch_size=4, window=5, seed=0).sample()
    found = {}
    for steps in (None, 5, 1):
        loss = ForwardModelLoss(bound, teacher_forced_steps=5, bptt_steps=steps)
        loss.fit_scales(trajectory_buffer(trajectories, batch_size=50, seed=0).sample())
        bound.zero_grad()
        out = loss(batch)["loss_forward_model"]
        out.backward()
        found[steps] = out.item(), bound.model.core.nodes.weight_hh.grad.clone()
    assert found[None][0] == found[1][0]
    assert torch.equal(found[None][1], found[5][1]) and not torch.allclose(found[None][1], found[1][1])
    state, action, target = batch["state"], batch["action"], batch["next", "state"]
    hidden_state, errors, program = None, [], bound.program()
    bound.zero_grad()
    for step in range(5):
        delta, hidden_state = eager.delta(program, state[:, step], action[:, step], hidden_state)
        errors.append(loss.component_errors(delta, bound.layout.delta(state[:, step], target[:, step])))
        assert hidden_state is not None
        hidden_state = hidden_state.detach()
    (torch.stack(errors).mean(0).sum() / 4).backward()
    torch.testing.assert_close(bound.model.core.nodes.weight_hh.grad, found[1][1])


@pytest.mark.slow
def test_it_learns_what_a_state_does_not_say():
    """A pendulum whose motor acts a step late: only a model with memory can predict it."""
    torch.manual_seed(0)
    scene = load_scene("pendulum")
    data = collect_trajectories(scene, 60, 30, seed=0, knot_interval=0.5)
    # What is logged at a step is the control that acts in the next one.
    late = TensorDict({"state": data["state"][:, :-1], "action": data["action"][:, 1:]}, [60])
    errors = {}
    for core in ("gn", "recurrent"):
        torch.manual_seed(0)
        memory = {"hidden_state": (8, 8, 8)} if core == "recurrent" else {}
        model = ForwardModel.for_scene(scene, core=core, hidden=(16,), **memory)
        bound = model.bind(scene)
        loss = ForwardModelLoss(bound, teacher_forced_steps=6)
        loss.fit_normalizers(trajectory_buffer(late, batch_size=500, seed=0).sample())
        optimizer = torch.optim.Adam(model.core.parameters(), 1e-2)
        buffer = trajectory_buffer(late, batch_size=32, window=6, seed=0)
        for _ in range(140):
            optimizer.zero_grad()
            loss(buffer.sample())["loss_forward_model"].backward()
            optimizer.step()
        errors[core] = evaluate_errors(bound, late, horizons=(), burn_in=5)["one_step_error"].total
    assert errors["recurrent"] < 0.5 * errors["gn"]
