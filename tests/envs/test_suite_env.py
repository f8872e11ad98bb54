"""Tasks of the suite as flat observations: dm_control's own numbers, and TorchRL's own ends of episodes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from torchrl_gn.envs import observation_env, suite_env
from torchrl_gn.scenes import ObservationGraph
from torchrl_gn.training.experience import episode_state, load_episode_state


@pytest.fixture
def own_env(monkeypatch):
    """dm_control's own environments."""
    monkeypatch.setenv("MUJOCO_GL", "off")  # it would look for a display
    from dm_control import suite
    from dm_control.rl import control
    from dm_control.suite import swimmer

    def make(domain: str, task: str, seed: int, timestep: float) -> control.Environment:
        if domain == "swimmer":
            loaded = swimmer.swimmer(int(task.removeprefix("swimmer")), random=seed)
        else:
            loaded = suite.load(domain, task, {"random": seed})
        return control.Environment(loaded.physics, loaded.task, control_timestep=timestep)

    return make


@pytest.mark.slow
@pytest.mark.parametrize(
    ("domain", "task", "timestep"),
    [
        ("swimmer", "swimmer6", 0.02),
        ("swimmer", "swimmer4", 0.01),
        ("cheetah", "run", 0.03),
        ("manipulator", "bring_ball", 0.01),  # has an observation of two axes
    ],
)
def test_physics_observations_and_rewards_are_dm_controls(own_env, domain, task, timestep):
    seeds = np.random.SeedSequence(5).generate_state(2).tolist()
    env = suite_env(domain, task, num_envs=2, timestep=timestep, seed=5)
    actions = 2 * torch.rand(2, 8, env.action_spec.shape[-1], generator=torch.Generator().manual_seed(0)) - 1
    td = env.reset()
    owns = [own_env(domain, task, int(seed), timestep) for seed in seeds]
    starts = [own.reset() for own in owns]

    def flat(step) -> np.ndarray:
        return np.concatenate([np.ravel(part) for part in step.observation.values()])

    for index, start in enumerate(starts):
        np.testing.assert_allclose(td["observation"][index], flat(start), rtol=1e-6, atol=1e-6)
    for action in actions.unbind(1):
        td = env.step(td.set("action", action.to(env.action_spec.dtype)))
        for index, own in enumerate(owns):
            step = own.step(action[index].numpy())
            np.testing.assert_allclose(td["next", "observation"][index], flat(step), rtol=1e-5, atol=1e-5)
            np.testing.assert_allclose(td["next", "reward"][index], step.reward, rtol=1e-5, atol=1e-6)
        td = step_mdp(td)


@pytest.mark.parametrize("links", [3, 5, 9])
def test_swimmers_of_any_length_are_what_their_graph_arranges(links):
    graph = ObservationGraph.swimmer(links)
    env = observation_env(graph, "swimmer", f"swimmer{links}", num_envs=2, timestep=0.02)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (2, graph.num_observations)
    assert env.observation_spec["observation"].dtype == torch.float32
    assert env.action_spec.shape == (2, graph.num_actions)


def test_entries_lie_in_the_order_of_the_graph():
    declared = ObservationGraph.swimmer(3).description()
    declared["observation"] = dict(reversed(declared["observation"].items()))
    one = suite_env("swimmer", "swimmer3", seed=1).reset()["observation"]
    other = observation_env(ObservationGraph.from_description(declared), "swimmer", "swimmer3", seed=1).reset()
    assert torch.equal(other["observation"], torch.cat((one[:, 4:], one[:, 2:4], one[:, :2]), -1))


# 7 steps of 0.01 s are 7.000000000000001 times 5 of the swimmer's steps of 0.002 s.
@pytest.mark.parametrize(("timestep", "steps"), [(0.02, 3), (0.01, 7)])
def test_the_time_limit_truncates_and_terminates_nothing(timestep, steps):
    env = suite_env("swimmer", "swimmer3", num_envs=2, timestep=timestep, steps=steps)
    rollout = env.rollout(2 * steps + 1, break_when_any_done=False)
    ends = [steps - 1, 2 * steps - 1]
    for key in ("truncated", "done"):
        assert rollout["next", key][0].flatten().nonzero().flatten().tolist() == ends
    assert not rollout["next", "terminated"].any()
    assert not torch.equal(rollout["observation"][0, steps], rollout["next", "observation"][0, steps - 1])


def test_without_steps_the_limit_is_the_suites():
    env = suite_env("swimmer", "swimmer3", timestep=1.5, steps=None)  # of 30 s
    assert len(env.rollout(30)[0]) == 20


@pytest.mark.slow
def test_every_environment_starts_elsewhere_and_the_same_seed_alike():
    envs = [suite_env("swimmer", "swimmer3", num_envs=num, seed=seed) for num, seed in ((2, 1), (1, 1), (1, 2))]
    first, same, other = (env.reset()["observation"] for env in envs)
    assert torch.equal(first[:1], same)
    assert len(torch.cat((first, other))[:, 2].unique()) == 3


def test_without_a_seed_environments_have_their_own_episodes():
    """As ``SerialEnv(2, lambda: suite_env(...))`` makes them."""
    torch.manual_seed(0)
    envs = [suite_env("swimmer", "swimmer3") for _ in range(2)]
    firsts = [env.reset()["observation"] for env in envs]
    torch.manual_seed(0)
    again = suite_env("swimmer", "swimmer3").reset()["observation"]
    assert not torch.equal(*firsts) and torch.equal(firsts[0], again)


def test_a_reset_of_some_leaves_the_others():
    env = suite_env("swimmer", "swimmer3", num_envs=2)
    before = env.rollout(3)[:, -1]["next"]
    some = TensorDict({"_reset": torch.tensor([[True], [False]])}, [2])
    after = env.reset(
        before.select("observation", "done", "terminated", "truncated", *env.observation_spec.keys()).update(some)
    )
    assert not torch.equal(after["observation"][0], before["observation"][0])
    assert torch.equal(after["observation"][1], before["observation"][1])


@pytest.mark.parametrize("timestep", [0.003, 0.0, -0.02, float("nan"), float("inf")])
def test_control_steps_that_do_not_fit_are_refused(timestep):
    with pytest.raises(ValueError, match=f"timestep={timestep} must be a positive multiple of the physics step, 0.002"):
        suite_env("swimmer", "swimmer3", timestep=timestep)


def test_unknown_tasks_and_numbers_are_refused():
    with pytest.raises(ValueError, match="no task swimmer crawl; there are swimmer15, swimmer6"):
        suite_env("swimmer", "crawl")
    with pytest.raises(ValueError, match="no task snake swim; there are acrobot, "):
        suite_env("snake", "swim")
    for options in ({"num_envs": 0}, {"steps": 0}):
        with pytest.raises(ValueError, match="=0 must be a whole number, 1 or more"):
            suite_env("swimmer", "swimmer3", **options)


def test_the_graph_of_another_task_is_refused():
    with pytest.raises(ValueError, match="and 2 actions, graph 'swimmer4' arranges .* and 3"):
        observation_env(ObservationGraph.swimmer(4), "swimmer", "swimmer3")
    for observation, actions in (
        ({"position": 9, "velocity": 8}, 6),
        ({"pose": 17}, 6),
        ({"position": 8}, 6),
        ({"position": 8, "velocity": 9}, 5),
    ):
        joints = {("a", "b"): ()}
        acting = {("a", "b"): tuple(range(actions))}
        graph = ObservationGraph("mine", observation, {"a": tuple(observation), "b": ()}, joints, actions=acting)
        with pytest.raises(ValueError, match="Task cheetah run has observations .* graph 'mine' arranges"):
            observation_env(graph, "cheetah", "run")


def test_actions_of_other_ranges_are_refused():
    graph = ObservationGraph.swimmer(3)
    with pytest.raises(ValueError, match=r"Task lqr lqr_2_1 has actions of -1e\+10 to 1e\+10; policies give -1 to 1"):
        observation_env(graph, "lqr", "lqr_2_1")


@pytest.mark.slow
def test_running_episodes_go_on_elsewhere_as_they_would_have():
    """The episode may end; the next start is then drawn as in the original."""

    def make(seed: int):
        return observation_env(ObservationGraph.swimmer(4), "swimmer", "swimmer4", num_envs=2, steps=9, seed=seed)

    def go_on(env, start, actions) -> torch.Tensor:
        return torch.stack([observe(env, start, action) for action in actions])

    def observe(env, state, action) -> torch.Tensor:
        after, later = env.step_and_maybe_reset(state.set("action", action))
        state.update(later)
        return after["next", "observation"]

    env = make(0)
    actions = 2 * torch.rand(20, *env.action_spec.shape, generator=torch.Generator().manual_seed(0)) - 1
    state = env.reset()
    go_on(env, state, actions[:13])  # the second episode runs
    saved = episode_state(env)
    assert {len(episode["actions"]) for episode in saved.values()} == {13 - 9}
    other = make(5)
    load_episode_state(other, saved)
    start = other.reset()
    assert torch.equal(start["observation"], state["observation"])
    assert torch.equal(go_on(env, state, actions[13:]), go_on(other, start, actions[13:]))
    assert not torch.equal(other.reset()["observation"], start["observation"])  # the next is a new one


@pytest.mark.parametrize(
    "forged",
    [
        {"random": torch.zeros(3, dtype=torch.int64)},
        {"random": torch.full((624,), 2**32)},
        {"drawn": [2**20, 0, 0.0]},  # numpy would read behind its numbers
        {"drawn": [-1, 0, 0.0]},
        {"drawn": [1, 2, 0.0]},
        {"actions": torch.zeros(9, 3).double()},  # as many as an episode has
        {"actions": torch.full((1, 3), torch.nan).double()},
        {"actions": torch.zeros(1, 4).double()},
        {"actions": [[0.0]]},
    ],
)
def test_forged_episodes_are_refused(forged):
    env = suite_env("swimmer", "swimmer4", steps=9)
    env.reset()
    saved = episode_state(env)
    with pytest.raises(ValueError, match="a running episode is not one of this task"):
        load_episode_state(env, {"worker0": saved["worker0"] | forged})
    with pytest.raises(ValueError, match=r"training\.episodes"):
        load_episode_state(env, {"worker1": saved["worker0"]})
