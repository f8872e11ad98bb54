"""Learning from a replay buffer: that it learns, when it updates, and that it goes on as if never stopped."""

from __future__ import annotations

import copy
import functools
import gc
import math

import pytest
import torch
import torchrl
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from torchrl_gn.envs import SceneEnv, batched
from torchrl_gn.policies import Agent
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import OffPolicyTrainer, load_pretrained, mean_return, save_checkpoint

from ..compiling import NEW_TORCH, compiles, no_compiler


def spend(trainer) -> list:
    return list(trainer.run())


def same(first: dict, second: dict) -> bool:
    return first.keys() == second.keys() and all(torch.equal(value, second[key]) for key, value in first.items())


def contents(trainer) -> torch.Tensor:
    """Everything remembered, in the order that it was learned."""
    state = trainer.state_dict()["buffer"]
    keys = ("observation", "action", "next.observation", "next.reward")
    return torch.cat([state[key] for key in keys], -1)


def test_the_points_are_an_environment(point_env):
    check_env_specs(point_env())


@pytest.mark.slow
def test_svg_learns_to_hold_a_point(make_learner):
    trainer = make_learner(frames=400, updates_per_frame=0.3, target_interval=10, lr=2e-2)
    progress = spend(trainer)
    first, *_, last = trainer.curve.returns
    assert first < -10 and last > -1  # staying where it starts gives -20 / 3
    assert progress[-1].evaluation == last and progress[-1].losses["loss_model"] < 0.05


@pytest.mark.slow
def test_updates_come_at_the_stated_ratio_and_evaluations_where_they_are_due(make_learner):
    trainer = make_learner(frames=200, random_frames=60, updates_per_frame=1 / 32, evaluate_frames=50)
    progress = spend(trainer)
    assert [each.frames for each in progress] == list(range(20, 201, 20))
    assert [each.updates for each in progress] == [0, 0, 0, 0, 1, 1, 2, 3, 3, 4]  # 0.625 every 20 frames from 60 on
    assert [bool(each.losses) for each in progress] == [False] * 4 + [True, False, True, True, False, True]
    assert trainer.curve.frames == [0, 60, 100, 160, 200]
    assert trainer.curve.updates == [0, 0, 1, 3, 4]
    assert all(each.evaluation is not None for each in progress if each.frames in trainer.curve.frames)


@pytest.mark.slow
@pytest.mark.skipif(not NEW_TORCH, reason="torch is too old to compile")
def test_compiled_updates_are_the_same(make_learner, monkeypatch):
    # An environment that another test left behind would set the number of threads when it goes, amid the compilation.
    gc.collect()
    # Inductor would take a minute and draw other numbers; that all is one graph is shown all the same.
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="aot_eager"))
    found = []
    for compiled in (False, True):
        first = make_learner()
        agent = Agent(first.agent.graph, hidden=(16,), model="gn", model_options={"latent": 4, "hidden": [8]})
        agent.load_state_dict(found[0][1] if found else agent.state_dict())
        start = copy.deepcopy(agent.state_dict())
        trainer = make_learner(agent, frames=100, compile=compiled)  # all of them random
        spend(trainer)
        torch.manual_seed(1)
        losses = [trainer.update() for _ in range(2)]  # once as it is, once compiled
        with torch.compiler.set_stance("fail_on_recompile"):
            losses += [trainer.update() for _ in range(4)]
        found.append((losses, start))
    for plain, quick in zip(found[0][0], found[1][0], strict=True):
        assert plain == pytest.approx(quick, rel=1e-4)


@compiles
def test_updates_are_compiled_only_where_there_is_a_compiler(make_learner):
    with no_compiler():
        assert spend(make_learner(frames=100, random_frames=60, compile=None))[-1].updates
        with pytest.raises(FileNotFoundError, match="needs a C"):
            make_learner(compile=True)
    plain, chosen, asked = (make_learner(compile=compile)._loss.__name__ for compile in (False, None, True))
    assert chosen == asked != plain


def test_targets_are_copied_after_their_interval(make_learner):
    trainer = make_learner(frames=100)  # all of them random
    spend(trainer)
    loss = trainer.losses[0]
    first = loss.target_value_network_params.clone()
    for updates in range(1, 9):
        trainer.update()
        copied = (loss.target_value_network_params == loss.value_network_params).all()
        assert bool(copied) == (updates in (4, 8))
        assert bool((loss.target_value_network_params == first).all()) == (updates < 4)


def test_every_transition_is_remembered_and_counted_once(make_learner):
    trainer = make_learner(frames=120, capacity=80)
    spend(trainer)
    assert len(trainer.buffer) == 80 and trainer.frames == 120
    assert trainer.agent.model.change_normalizer.count[0] == 120
    kept = contents(trainer)
    torch.testing.assert_close(kept[:, 2], kept[:, 0] + 0.2 * kept[:, 1])
    torch.testing.assert_close(kept[:, 3], -kept[:, 2].square())


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [1000, 90])
def test_a_stopped_run_goes_on_where_it_was(make_learner, tmp_path, capacity):
    trainer = make_learner(frames=300, capacity=capacity)
    for progress in trainer.run():
        if progress.frames == 160:
            break
    save_checkpoint(tmp_path / "c.safetensors", trainer.agent, training=trainer.state_dict())
    saved = load_pretrained(tmp_path / "c.safetensors")
    again = make_learner(saved.agent, seed=1, frames=300, capacity=capacity)
    again.load_state_dict(saved.training)
    assert (again.frames, again.updates, again.owed, again.seconds) == (160, 6, trainer.owed, trainer.seconds)
    assert vars(again.curve) == vars(trainer.curve) and again.target.counter == trainer.target.counter
    assert torch.equal(contents(again), contents(trainer))
    for loss, other in zip(trainer.losses, again.losses, strict=True):
        assert same(loss.state_dict(), other.state_dict())
    assert same(trainer.agent.state_dict(), again.agent.state_dict())
    trained = [*again.agent.policy.parameters(), *again.agent.value.parameters()]
    assert all(weight is own for weight, own in zip(again.losses[0].parameters(), trained, strict=True))
    rest = spend(again)
    assert [each.frames for each in rest] == list(range(180, 301, 20))
    assert again.curve.frames == [0, 100, 200, 300] and rest[-1].updates == again.updates


@pytest.mark.slow
def test_a_run_that_goes_on_begins_other_episodes(make_learner):
    trainer = make_learner(frames=100)
    spend(trainer)
    state = trainer.state_dict()
    starts = [contents(trainer)[:20:5, 0]]  # four points, five steps of each in a batch
    for _ in range(2):
        again = make_learner(frames=200)
        again.load_state_dict(state)
        spend(again)
        starts.append(contents(again)[100:120:5, 0])
    assert not (starts[0] == starts[1]).any() and torch.equal(starts[1], starts[2])


@pytest.mark.slow
def test_the_last_updates_have_no_other_threads_than_the_first(make_learner, point_env, monkeypatch, calls):
    """Closing TorchRL's SerialEnv, which its collector does with the last batch, would give torch all it began with."""
    monkeypatch.setattr(torchrl, "_THREAD_POOL_INIT", 4)
    trainer, before = make_learner(frames=100, random_frames=20), torch.get_num_threads()
    trainer.env = SerialEnv(2, [functools.partial(point_env, 2)] * 2)
    seen = calls(trainer, "update", torch.get_num_threads)
    torch.set_num_threads(2)
    try:
        spend(trainer)
        assert trainer.env.is_closed and {*seen, torch.get_num_threads()} == {2} and len(seen) > 1
    finally:
        torch.set_num_threads(before)


@pytest.mark.slow
@pytest.mark.parametrize("leave", ["break", "raise"])
def test_a_run_that_is_left_leaves_the_environment_open(make_learner, ctrl_c, leave):
    trainer = make_learner(frames=100)
    trainer.env.is_closed = False  # as those that can be closed say
    if leave == "break":
        for _ in trainer.run():
            break
    else:
        ctrl_c(trainer, "remember", 1)
        with pytest.raises(KeyboardInterrupt):
            spend(trainer)
    gc.collect()
    assert not trainer.env.is_closed
    assert spend(trainer)[-1].frames == 100


@pytest.mark.slow
def test_the_next_update_after_a_stop_is_the_one_that_would_have_been(make_learner):
    trainer = make_learner(frames=200)
    spend(trainer)
    state = copy.deepcopy(trainer.state_dict())
    again = make_learner(seed=1, frames=400)
    again.load_state_dict(state)
    torch.set_rng_state(state["generators"]["global"])
    expected = [trainer.update() for _ in range(3)]
    torch.set_rng_state(state["generators"]["global"])
    assert [again.update() for _ in range(3)] == expected
    assert same(trainer.agent.state_dict(), again.agent.state_dict())


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [1000, 90])
def test_a_finished_run_goes_on_with_more_frames(make_learner, capacity):
    """The buffer of a finished run is full: new transitions come last, or replace the oldest."""
    trainer = make_learner(frames=200, capacity=capacity)
    spend(trainer)
    again = make_learner(trainer.agent, frames=260, capacity=capacity)
    again.load_state_dict(trainer.state_dict())
    spend(again)
    before, after = contents(trainer), contents(again)
    assert (len(before), len(after)) == ((200, 260) if capacity == 1000 else (90, 90))
    assert torch.equal(before[-30:], after[-90:-60])
    torch.testing.assert_close(after[:, 2], after[:, 0] + 0.2 * after[:, 1])
    assert again.curve.frames[: len(trainer.curve.frames)] == trainer.curve.frames


@pytest.mark.slow
def test_a_run_asked_for_fewer_frames_than_it_has_is_refused_and_forgets_nothing(make_learner):
    trainer = make_learner(frames=200)
    spend(trainer)
    fewer = make_learner(trainer.agent, frames=100)
    before = copy.deepcopy(fewer.state_dict())
    with pytest.raises(ValueError, match="The checkpoint has 200 frames already; pass frames=200 or more to resume"):
        fewer.load_state_dict(trainer.state_dict())
    assert fewer.frames == len(fewer.buffer) == 0 and same(fewer.losses[0].state_dict(), before["losses"][0])
    again = make_learner(trainer.agent, frames=190)  # the last batch went beyond
    again.load_state_dict(trainer.state_dict())
    assert spend(again) == [] and torch.equal(contents(again), contents(trainer))


@pytest.mark.parametrize("part", ["optimizer", "buffer"])
def test_a_state_that_is_refused_changes_nothing(make_learner, part):
    saved = make_learner(frames=200)
    spend(saved)
    wrong = copy.deepcopy(saved.state_dict())
    if part == "optimizer":
        next(iter(wrong["optimizer"]["state"].values()))["exp_avg"] = torch.zeros(1)
    else:
        wrong["buffer"]["next.reward"] = wrong["buffer"]["next.reward"][:3]
    trainer = make_learner(frames=200)
    before = copy.deepcopy(trainer.state_dict())
    with pytest.raises(ValueError, match=f"training.{part}"):
        trainer.load_state_dict(wrong)
    after = trainer.state_dict()
    assert all(same(one, other) for one, other in zip(before["losses"], after["losses"], strict=True))
    assert str(before["optimizer"]) == str(after["optimizer"]) and not len(trainer.buffer)
    assert before["progress"] == after["progress"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "at", ["first evaluation", "first batch", "update", "evaluation", "last update", "last evaluation"]
)
def test_an_interrupt_costs_no_update_and_no_point_of_the_curve(make_learner, at):
    """After an interrupt at any time, the resumed run has the updates and points of an uninterrupted run."""
    whole = make_learner(frames=200, random_frames=20)
    spend(whole)
    trainer = make_learner(frames=200, random_frames=20)
    name, when = {
        "first evaluation": ("evaluate", lambda: True),
        "first batch": ("remember", lambda: True),
        "update": ("update", lambda: trainer.updates == 5),
        "evaluation": ("evaluate", lambda: trainer.frames == 100),
        "last update": ("update", lambda: trainer.frames == 200),
        "last evaluation": ("evaluate", lambda: trainer.frames == 200),
    }[at]
    original = getattr(trainer, name)

    def interrupt(*inputs):
        if when():
            raise KeyboardInterrupt
        return original(*inputs)

    setattr(trainer, name, interrupt)
    with pytest.raises(KeyboardInterrupt):
        spend(trainer)
    again = make_learner(trainer.agent, frames=200, random_frames=20)
    again.load_state_dict(trainer.state_dict())
    spend(again)
    assert again.curve.frames == whole.curve.frames == [0, 100, 200]
    assert (again.frames, again.updates, again.owed) == (200, whole.updates, whole.owed)
    assert again.curve.updates == whole.curve.updates


@pytest.mark.slow
@pytest.mark.parametrize(("owner", "name"), [(torch.optim.Adam, "step"), (TensorDictReplayBuffer, "extend")])
def test_an_interrupt_comes_between_changes(make_learner, ctrl_c, owner, name):
    whole, trainer = (make_learner(frames=100, random_frames=20) for _ in range(2))
    spend(whole)
    ctrl_c(owner, name, 3)
    with pytest.raises(KeyboardInterrupt):
        spend(trainer)
    assert trainer.frames == len(trainer.buffer)
    assert trainer.updates + trainer.owed == pytest.approx(0.1 * (trainer.frames - 20))
    assert trainer.updates == 3 if name == "step" else trainer.frames == 60
    assert trainer.target.counter == trainer.updates % 4
    again = make_learner(trainer.agent, frames=100, random_frames=20)
    again.load_state_dict(trainer.state_dict())
    spend(again)
    assert (again.frames, again.updates, again.owed) == (whole.frames, whole.updates, whole.owed)


@pytest.mark.parametrize("option", ["updates_per_frame", "max_norm"])
def test_numbers_that_are_not_positive_are_named(make_learner, option):
    for value in (0, -1):
        with pytest.raises(ValueError, match=f"{option}={value} must be positive"):
            make_learner(**{option: value})


@pytest.mark.parametrize(
    "option",
    ["frames", "batch_size", "frames_per_batch", "random_frames", "evaluate_frames", "capacity", "target_interval"],
)
def test_numbers_of_frames_and_updates_are_whole(make_learner, option):
    for value in (-1, 1.5, True):
        with pytest.raises(ValueError, match=f"{option}={value} must be a whole number"):
            make_learner(**{option: value})


def test_an_optimiser_of_another_agent_is_refused(make_learner):
    trainer, other = make_learner(), make_learner()
    parts = trainer.agent, trainer.losses, trainer.env, trainer.exploration_policy, trainer.evaluate
    with pytest.raises(ValueError, match="optimizer has no weight of the SVGLoss that is trained"):
        OffPolicyTrainer(*parts, torch.optim.Adam(other.agent.parameters()), frames=200, frames_per_batch=20)
    assert OffPolicyTrainer(*parts, torch.optim.Adam(trainer.agent.policy.parameters()), frames=200).total == 200


@pytest.mark.parametrize("key", ["observation", ("next", "observation"), ("next", "reward")])
def test_experience_that_is_not_finite_is_refused_before_it_is_remembered(make_learner, point_env, key):
    trainer = make_learner(frames=100)
    trainer.agent.model = None  # which would look itself
    batch = point_env().rollout(5)
    batch[key][1, 3] = math.nan
    with pytest.raises(ValueError, match="Experience .* has nan at index"):
        trainer.remember(batch)
    assert len(trainer.buffer) == trainer.frames == 0


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_weights_on_a_gpu_learn_from_experience_elsewhere(make_learner, point_env):
    trainer = make_learner(make_learner().agent.cuda())
    trainer.remember(point_env().rollout(20))
    assert all(math.isfinite(value) for value in trainer.update().values())


@pytest.mark.slow
@pytest.mark.parametrize("broken", ["loss", "gradient"])
def test_what_is_not_finite_stops_before_any_weight_is_touched(make_learner, broken):
    trainer = make_learner()
    spend(trainer)
    before = {name: weight.clone() for name, weight in trainer.agent.named_parameters()}
    moments = [moment["exp_avg"].clone() for moment in trainer.optimizer.state.values()]
    if broken == "loss":
        object.__setattr__(trainer.losses[0], "reward", lambda x, u, after: after * math.nan)
        message = r"Losses are \{'loss_actor': nan, .* at update 10; lower the learning rate"
    else:  # the root's slope at 0
        object.__setattr__(trainer.losses[0], "reward", lambda x, u, after: (after * 0).sqrt())
        message = "The gradient is not finite at update 10"
    with pytest.raises(FloatingPointError, match=message):
        trainer.update()
    assert all(torch.equal(weight, before[name]) for name, weight in trainer.agent.named_parameters())
    after = [moment["exp_avg"] for moment in trainer.optimizer.state.values()]
    assert all(map(torch.equal, moments, after)) and trainer.updates == 10


def test_batches_must_fill_the_environments(make_learner):
    for wrong in (30, 0, 2):
        with pytest.raises(ValueError, match=f"frames_per_batch={wrong} must be a multiple of 4 environments"):
            make_learner(frames_per_batch=wrong)


def test_a_return_ends_with_its_episode(point_env):
    """Rewards are the number of the step: 1 + 2 + ... to the end of each episode."""
    still = TensorDictModule(nn.Identity(), ["observation"], ["action"])
    env = point_env(3, (2, 5, 7), pay=lambda count: count.float())
    assert mean_return(env, still, 7) == pytest.approx((3 + 15 + 28) / 3)
    assert mean_return(env, still, 7) == pytest.approx((3 + 15 + 28) / 3)
    assert mean_return(env, still, 4) == pytest.approx((3 + 10 + 10) / 3)


@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (1, 2, 3)])
def test_returns_are_sums_over_time_in_every_batch(batch):
    scene = load_scene("pendulum")
    env = SceneEnv(scene, lambda state, action, next_state, task: next_state[..., 1, 11:12].abs() + 1, seed=0)
    env = (batched(env, *batch) if batch else TransformedEnv(env)).append_transform(StepCounter(4))
    push = TensorDictModule(lambda state: torch.ones(*state.shape[:-2], 1), ["state"], ["action"])
    value = mean_return(env, push, 10)
    env.set_seed(0)
    now, total = env.reset(), torch.zeros(*batch, 1)
    for _ in range(4):
        now = env.step(push(now))
        total, now = total + now["next", "reward"], step_mdp(now)
    assert now["done"].all() and value > 4
    assert value == pytest.approx(float(total.mean()), rel=1e-6)
    with pytest.raises(ValueError, match="steps=0 must be a whole number"):
        mean_return(env, push, 0)


def test_evaluation_plays_the_same_episodes_and_does_not_explore(make_learner, point_env):
    policy, env = make_learner().agent.policy, point_env(5)
    first, same, other = (mean_return(env, policy, 20, seed=seed) for seed in (1, 1, 2))
    assert first == same != other
