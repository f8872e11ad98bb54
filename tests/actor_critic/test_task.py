"""Tasks of an actor-critic: draws, resumed networks, and a subclass that plays elsewhere."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

import torchrl_gn as gn
from torchrl_gn.actor_critic import WINDOW, ActorCritic, ActorCriticTask, TargetSquares, colored_noise, windows
from torchrl_gn.actor_critic.trajectories import with_others


@pytest.fixture(scope="module")
def pendulum():
    return gn.load_scene("pendulum")


@pytest.fixture(scope="module")
def reward(pendulum):
    return gn.make_reward("balance", pendulum)


class Replayed(ActorCriticTask):
    """A task whose trajectories were recorded elsewhere, under one constant action each."""

    def play_at_random(self):
        return self.recorded(0.0)

    def play(self, policy, seed):
        return self.recorded(float(seed))

    def recorded(self, action):
        state = gn.collect_trajectories(self.scene, 2, steps=WINDOW, seed=3)["state"]
        return windows(state, torch.full((2, WINDOW, 1), action), torch.zeros(2, WINDOW, 1))


def test_a_subclass_plays_elsewhere(pendulum, reward, small):
    torch.manual_seed(0)
    task = Replayed(pendulum, options := small(), reward)
    learner = ActorCritic([task], options)
    task.collect()
    before = torch.cat([each.detach().flatten().clone() for each in learner.policy.parameters()])
    learner.learn(0)
    task.add(task.play(learner.playing(), seed=2))
    learner.learn(1)
    assert [float(data["action"].unique()) for data in task.data] == [0.0, 2.0]
    assert task.newest is task.data[1]
    after = torch.cat([each.detach().flatten() for each in learner.policy.parameters()])
    assert bool(after.isfinite().all()) and not torch.equal(before, after)


def test_draws_half_from_the_newest(pendulum, reward, small):
    task = ActorCriticTask(pendulum, small(), reward)
    task.collect()
    marked = task.newest.clone()
    marked["state"].fill_(7.0)
    marked["reward"].fill_(3.0)
    task.add(marked)
    drawn = task.starts()(1001)
    newest = (drawn["state"] == 7.0).flatten(1).all(1)
    assert drawn["state"].shape == (1001, *task.newest["state"].shape[2:])
    assert bool(newest[501:].all())  # the last 500; of the first 501, drawn from all, about half
    assert 150 < int(newest[:501].sum()) < 350
    assert torch.equal(drawn["reward"].squeeze(-1) == 3.0, newest)


def test_the_value_is_scaled_by_what_was_paid_where_imagination_begins(pendulum, reward, small):
    task = ActorCriticTask(pendulum, options := small(), reward)
    learner = ActorCritic([task], options)
    task.collect()
    for paid in (0.0, 0.0, 1.0):  # a third of all, and half of what is drawn are the newest
        task.add(task.data[0].clone())
        task.newest["reward"].fill_(paid)
    task.data[0]["reward"].zero_()
    learner.learn(0)
    share = 0.5 * 0.25 + 0.5
    assert float(task.value.normalizer.std) * (1 - options.discount) == pytest.approx(
        (share * (1 - share)) ** 0.5, rel=0.02
    )
    assert float(task.value.normalizer.mean) * (1 - options.discount) == pytest.approx(share, rel=0.04)


@pytest.mark.parametrize("color", [0.0, 1.0, 2.0])
def test_power_of_colored_noise_falls_with_the_frequency(color):
    torch.manual_seed(0)
    noise = colored_noise(512, (400, 2), color)
    assert noise.shape == (512, 400, 2)
    assert float(noise.var()) == pytest.approx(1.0, rel=0.15)
    power = torch.fft.rfft(noise, dim=0).abs().square().mean((1, 2))[1:-1]
    slope = ((power[99] / power[9]).log() / torch.tensor(10.0).log()).item()
    assert slope == pytest.approx(-color, abs=0.25)
    assert colored_noise(1, (3,), color).shape == (1, 3)


def test_explores_by_colored_noise(pendulum, reward, small):
    torch.manual_seed(0)
    learner = ActorCritic([ActorCriticTask(pendulum, options := small(steps=200), reward)], options)
    learner.policy.features.fit(torch.rand(20, 2, 13).double())
    rest = {}
    for color in (0.0, 2.0):
        task = ActorCriticTask(pendulum, small(steps=200, noise_color=color), reward)
        action = task.play(learner.playing(), seed=0)["action"]
        change = (action[:, 1:] - action[:, :-1]).square().mean()
        rest[color] = float(change / action.var())
    assert rest[0.0] > 1.0 > 0.3 > rest[2.0]


def test_the_first_episode_of_early_rounds_leads_to_novel_states(pendulum, reward, small):
    played = {}
    for rounds in (0, 1):
        torch.manual_seed(0)
        task = ActorCriticTask(pendulum, options := small(steps=100, episodes=3, novelty_rounds=rounds), reward)
        learner = ActorCritic([task], options)
        task.collect()
        learner.learn(0)
        for index in range(2):
            torch.manual_seed(5)
            played[rounds, index] = task.play(learner.playing(), seed=index)["action"].unflatten(0, (2, 3))
            task.add(task.data[0])
    for index, changes in ((0, True), (1, False)):
        noisy, led = played[0, index], played[1, index]
        assert torch.equal(noisy[:, 0], led[:, 0]) is not changes


def test_others_act_in_their_episodes_and_keep_their_plans():
    def policy(tensordict):
        return tensordict.set("action", torch.zeros(4, 1))

    def counting(tensordict):
        assert set(tensordict.keys()) <= {"state", "target", "plan"}
        count = tensordict["plan", "count"] + 1 if "plan" in tensordict.keys() else torch.ones(len(tensordict), 1)
        return tensordict.update({"action": count, "plan": {"count": count}})

    act = with_others(policy, [(slice(1), lambda each: each.set("action", -each["state"])), (slice(2, None), counting)])
    for step in range(1, 4):
        played = act(TensorDict({"state": torch.full((4, 1), 7.0), "reward": torch.zeros(4, 1)}, [4]))
        assert played["action"].flatten().tolist() == [-7, 0, step, step] and "plan" not in played.keys()


def test_a_planner_acts_in_the_last_episodes(pendulum, reward, small):
    task = ActorCriticTask(pendulum, options := small(planned_episodes=1, novelty_rounds=0), reward)
    learner = ActorCritic([task], options)
    task.collect()
    shapes = []

    def planner(policy):
        def act(tensordict):
            shapes.append(tensordict["state"].shape)
            return tensordict.set("action", torch.full((1, 1), 0.125))

        return act

    task.planner = planner
    learner.learn(0)
    action = task.play(learner.playing(), seed=0)["action"]
    assert len(action) == 2 and (action[1] == 0.125).all() and (action[0] != 0.125).any() and shapes[0] == (1, 2, 13)
    with pytest.raises(ValueError, match="planned_episodes=3 must be at most episodes=2"):
        small(planned_episodes=3)


def test_a_planner_goes_from_the_policys_proposals_to_the_value(pendulum, reward, small):
    task = ActorCriticTask(pendulum, options := small(), reward)
    learner = ActorCritic([task], options)
    task.collect()
    learner.learn(0)
    policy = learner.playing()
    planner = task.planner(policy, horizon=2, iterations=1, samples=2, elites=1, proposals=1, seed=0)
    starts = TensorDict({"state": task.newest["state"][:4, 0]}, [4])
    first = planner.proposed_plans(starts, 1)
    torch.testing.assert_close(planner.actions(first)[:, 0, 0], policy.act(starts["state"]))
    states, actions = planner.imagined.imagine(starts, planner.actions(first)[:, 0])[0], planner.actions(first)[:, 0]
    with torch.no_grad():
        found = planner.predicted_returns(starts, first)
        paid = [reward(states[:, k], actions[:, k], states[:, k + 1]) for k in range(2)]
        total = paid[0] + options.discount * paid[1] + options.discount**2 * task.value(states[:, 2])
    torch.testing.assert_close(found, total.to(found.dtype), rtol=1e-4, atol=1e-4)
    assert task.evaluate(planner).shape == (2, 5)
    weights = [each.clone() for each in planner.parameters()]
    learner.learn(1)  # a planner keeps the networks of its round
    assert all(torch.equal(*each) for each in zip(weights, planner.parameters(), strict=True))


@pytest.mark.parametrize(("system", "horizon"), [("pendulum", 20), ("cheetah", 5)])
def test_plans_are_longer_where_no_bodies_can_touch(system, horizon, small):
    scene = gn.load_scene(system)
    task = ActorCriticTask(scene, options := small(), lambda state, action, next_state, task: state[..., 0, :1])
    learner = ActorCritic([task], options)
    task.collect()
    learner.learn(0)
    assert task.planner(learner.playing(), samples=2, elites=1, proposals=1).horizon == horizon
    assert task.planner(learner.playing(), horizon=3, samples=2, elites=1, proposals=1).horizon == 3


def test_a_planner_goes_through_an_ensemble_that_is_not_calibrated(pendulum, reward, small):
    task = ActorCriticTask(pendulum, options := small(members=2, planned_episodes=1), reward)
    learner = ActorCritic([task], options)
    task.collect()
    learner.learn(0)
    assert task.play(learner.playing(), seed=0)["action"].isfinite().all()
    planner = task.planner(learner.playing(), horizon=2, iterations=1, samples=2, elites=1, proposals=1, seed=0)
    assert task.evaluate(planner)["action"].shape == (2, 5, 1)


def test_a_round_that_left_nothing_is_passed_over(pendulum, reward, small):
    task = ActorCriticTask(pendulum, small(), reward)
    task.collect()
    task.add(task.data[0][:0])
    assert task.newest is task.data[0]


def test_learning_needs_trajectories(pendulum, reward, small):
    task = ActorCriticTask(pendulum, options := small(), reward)
    learner = ActorCritic([task], options)
    with pytest.raises(RuntimeError, match="no trajectories of 'pendulum' to learn from: call collect"):
        learner.learn(0)


def test_refuses_a_target_that_a_policy_cannot_know(small):
    swimmer = gn.load_scene("swimmer3")
    with pytest.raises(ValueError, match="does not read the target"):
        ActorCriticTask(swimmer, small(), gn.make_reward("reach", swimmer))


def test_targets_lie_in_the_squares():
    squares = TargetSquares(gn.load_scene("swimmer3"), [0.1, 2.0])
    state = gn.SceneEnv(squares.scene, seed=0).reset().unsqueeze(0)["state"].repeat(2000, 1, 1)
    moved = squares.move(state)
    place, shift = moved[:, 1, :2], moved[:, 1:, :2] - state[:, 1:, :2]
    torch.testing.assert_close(shift, shift[:, :1].expand_as(shift))  # as one
    assert torch.equal(moved[..., 2:], state[..., 2:]) and torch.equal(moved[:, 0], state[:, 0])
    near = (place.abs() <= 0.1).all(1).double().mean()
    assert place.abs().max() <= 2 and abs(near - (0.5 + 0.5 * 0.05**2)) < 0.05


@pytest.mark.parametrize(
    ("name", "sides", "message"),
    [("swimmer3", [0.3, -1], "must be positive half sides"), ("pendulum", [0.3], "slides freely along x and y, not")],
)
def test_refuses_squares(name, sides, message):
    with pytest.raises(ValueError, match=message):
        TargetSquares(gn.load_scene(name), sides)


def test_a_function_is_a_reward(pendulum, reward, small):
    def function(state, action, next_state, task):
        return reward(state, action, next_state, task)

    losses = []
    for each in (reward, function):
        torch.manual_seed(0)
        task = ActorCriticTask(pendulum, options := small(), each)
        learner = ActorCritic([task], options)
        task.collect()
        losses.append(learner.learn(0))
        task.add(task.play(learner.playing(), seed=1))
        task.evaluate(task.planner(learner.playing(), horizon=2, iterations=1, samples=4, elites=2, proposals=2))
    assert losses[0] == losses[1]


@pytest.mark.parametrize("wrong", ["balance", lambda state, action, next_state: state], ids=["name", "three arguments"])
def test_a_reward_is_a_function_of_four(pendulum, reward, small, wrong):
    with pytest.raises(TypeError, match="reward= must be a function of"):
        ActorCriticTask(pendulum, small(), wrong)
    with pytest.raises(TypeError, match="reward= must be a function of"):
        ActorCriticTask(pendulum, small(), reward, evaluation_reward=wrong)
