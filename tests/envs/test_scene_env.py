"""SceneEnv: the physics it steps and the promises it makes about it."""

from __future__ import annotations

import copy
import math
import multiprocessing
import pickle

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv, check_env_specs
from torchrl.record import PixelRenderTransform

from torchrl_gn.data import Simulator
from torchrl_gn.envs import ModelEnv, SceneEnv, batched
from torchrl_gn.envs.starts import StartSampler
from torchrl_gn.rewards import Velocity, make_reward
from torchrl_gn.scenes import load_scene

from .. import zoo


def batch(*size: int) -> TensorDict:
    return TensorDict(batch_size=size)


def test_scenes_are_given_as_load_scene_takes_them(pendulum, tmp_path):
    text = "<mujoco><worldbody><body><joint name='j'/><geom size='0.1'/></body></worldbody><actuator>"
    text += "<motor joint='j' ctrlrange='-1 1'/></actuator></mujoco>"
    path = tmp_path / "arm.xml"
    path.write_text(text)
    kinds = [text, path, str(path), mujoco.MjSpec.from_string(text), load_scene(text)]
    starts = torch.zeros(1, load_scene(text).physics_size)
    for one in (*kinds, *([each] for each in kinds)):
        env = SceneEnv(one, start_states=starts, seed=0)
        assert env.step(env.reset().set("action", torch.ones(1)))["next", "physics"][0] > 0
    for wrong in (7, None, [7], load_scene):
        with pytest.raises(TypeError, match="A scene must be"):
            SceneEnv(wrong)  # type: ignore[arg-type]


def test_a_batch_steps_as_its_members_do(swimmer):
    env = SceneEnv(swimmer, seed=0)
    start = env.rand_action(env.reset(batch(2, 3)))
    together = env.step(start.clone())["next"]
    for index in np.ndindex(2, 3):
        alone = env.step(start[index].clone())["next"]
        assert (together[index] == alone).all()


def test_a_recorded_rollout_replays_bit_for_bit(swimmer):
    env = SceneEnv(swimmer, seed=0)
    env.set_seed(3)
    executed = env.rollout(10, tensordict=batch(4))
    replayed = SceneEnv(swimmer, num_threads=1).step(executed.select("physics", "action"))["next"]
    for key in ("state", "physics"):
        assert torch.equal(replayed[key], executed["next", key])
        assert torch.equal(executed[key][:, 1:], executed["next", key][:, :-1])


def test_a_step_leaves_its_input_alone(scene_env):
    start = scene_env.rand_action(scene_env.reset(batch(3)))
    before = start.clone()
    scene_env.step(start)
    assert (start.exclude("next") == before).all()


def test_the_pendulum_obeys_its_equation_of_motion(scene_env):
    # Semi-implicit Euler on I w' = m g l sin(q) - d w + u, the suite's pendulum, damping implicit.
    mass, length, damping, step = 1.0, 0.5, 0.1, 0.02
    inertia = mass * length**2 + 2 / 5 * mass * 0.05**2
    executed = scene_env.rollout(20, tensordict=batch(5))
    angle, speed = executed["physics"][..., 1], executed["physics"][..., 2]
    torque = mass * 9.81 * length * angle.sin() - damping * speed + executed["action"][..., 0].double()
    next_speed = speed + step * torque / (inertia + step * damping)
    torch.testing.assert_close(executed["next", "physics"][..., 2], next_speed, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(executed["next", "physics"][..., 1], angle + step * next_speed, rtol=1e-9, atol=1e-9)


def test_the_reward_is_the_angle_from_upright(scene_env):
    executed = scene_env.rollout(20, tensordict=batch(5))
    angle = executed["next", "physics"][..., 1]
    wrapped = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    expected = -wrapped.abs().unsqueeze(-1).float()
    torch.testing.assert_close(executed["next", "reward"], expected, rtol=1e-6, atol=1e-6)


def test_takes_actions_of_either_precision(scene_env):
    start = scene_env.rand_action(scene_env.reset(batch(3)))
    wide = start.clone().set("action", start["action"].double())
    assert (scene_env.step(start.clone())["next"] == scene_env.step(wide)["next"]).all()


def test_without_reward_it_is_zero(pendulum):
    assert (SceneEnv(pendulum, seed=0).rollout(3)["next", "reward"] == 0).all()


def test_same_seed_same_starts(pendulum, scene_env):
    first = scene_env.reset(batch(6))["physics"]
    assert torch.equal(SceneEnv(pendulum, seed=0).reset(batch(6))["physics"], first)
    assert not torch.equal(scene_env.reset(batch(6))["physics"], first)
    scene_env.set_seed(0)
    assert torch.equal(scene_env.reset(batch(6))["physics"], first)
    torch.manual_seed(1)
    unseeded = SceneEnv(pendulum).reset()["physics"]
    torch.manual_seed(1)
    assert torch.equal(SceneEnv(pendulum).reset()["physics"], unseeded)


def test_reset_starts_from_given_physics_only_when_asked(scene_env):
    start = scene_env.reset(batch(4))
    kept = scene_env.reset(start.clone(), set_state=True)
    assert (kept.select("physics", "state") == start.select("physics", "state")).all()
    drawn = scene_env.reset(start.clone(), set_state=False)
    assert (drawn["physics"] != start["physics"]).any(-1).all()
    executed = scene_env.rollout(2, tensordict=start.clone(), set_state=True)
    assert torch.equal(executed["physics"][:, 0], start["physics"])


def test_a_partial_reset_moves_the_masked_only(scene_env):
    start = scene_env.reset(batch(4))
    mask = torch.tensor([True, False, True, False]).unsqueeze(-1)
    again = scene_env.reset(start.clone().set("_reset", mask), select_reset_only=True)
    moved = (again["physics"] != start["physics"]).any(-1)
    assert torch.equal(moved, mask.squeeze(-1))
    assert torch.equal((again["state"] != start["state"]).flatten(1).any(-1), mask.squeeze(-1))


def test_starts_from_a_table_or_a_function(pendulum):
    table = torch.zeros(3, pendulum.physics_size, dtype=torch.float64)
    table[:, 1] = torch.tensor([0.1, 0.2, 0.3])
    drawn = SceneEnv(pendulum, start_states=table, seed=0).reset(batch(50))["physics"]
    assert set(drawn[:, 1].tolist()) == set(table[:, 1].tolist())
    shown = SceneEnv(pendulum, start_states=lambda n, rng: table[:1].numpy().repeat(n, 0)).reset(batch(2))
    assert torch.equal(shown["physics"], table[[0, 0]])


@pytest.mark.parametrize("bad", [torch.zeros(3), torch.zeros(0, 3), torch.zeros(2, 7)])
def test_refuses_start_states_of_a_wrong_shape(pendulum, bad):
    with pytest.raises(ValueError, match="start states of 'pendulum' must be"):
        SceneEnv(pendulum, start_states=bad)


def test_bad_steps_are_named(scene_env):
    start = scene_env.rand_action(scene_env.reset(batch(4)))
    with pytest.raises(ValueError, match=r"'action' must be \[4, 1\], got \[4, 2\]"):
        scene_env.step(start.clone().set("action", torch.zeros(4, 2)))
    with pytest.raises(KeyError, match="needs an entry 'physics'"):
        scene_env.step(start.select("state", "action"))


def test_an_unstable_step_ends_the_episode_and_keeps_the_last_good_state(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env = SceneEnv(zoo.load("cart", ('gear="1"', 'gear="1e12"')), seed=0)
    start = env.reset(batch(2))
    start["action"] = torch.tensor([[1.0], [0.0]])
    after = env.step(start)["next"]
    assert after["terminated"].flatten().tolist() == [True, False]
    assert torch.equal(after["done"], after["terminated"])
    assert after["reward"].flatten().tolist() == [-1e6, 0]
    assert torch.equal(after["physics"][0], start["physics"][0])
    assert torch.equal(after["state"][0], start["state"][0])
    assert after["physics"].isfinite().all()
    assert not list(tmp_path.iterdir())  # MuJoCo's log file


def test_a_scene_without_motors_steps(capfd):
    env = SceneEnv(zoo.load("falling"), seed=0)
    executed = env.rollout(5, tensordict=batch(2))
    assert executed["action"].shape == (2, 5, 0)
    assert not executed["next", "done"].any()
    assert "".join(capfd.readouterr()) == ""


def test_copies_and_pickles(scene_env):
    start = scene_env.rand_action(scene_env.reset(batch(2)))
    expected = scene_env.step(start.clone())["next"]
    for twin in (copy.deepcopy(scene_env), pickle.loads(pickle.dumps(scene_env))):
        assert (twin.step(start.clone())["next"] == expected).all()
        assert torch.equal(twin.reset(batch(3))["physics"], copy.deepcopy(scene_env).reset(batch(3))["physics"])


def test_resets_and_steps_share_one_simulator(env, calls):
    made = calls(Simulator, "__init__", lambda self, *_, **__: self)
    if isinstance(env, SceneEnv):
        env.num_threads = 1
    for _ in range(3):
        env.step(env.rand_action(env.reset(batch(2))))
    assert len(made) == 1 and (made[0].num_threads == 1 or not isinstance(env, SceneEnv))
    twin = copy.deepcopy(env)
    assert torch.equal(twin.reset(batch(2))["state"], env.reset(batch(2))["state"])


def test_a_task_entry_reaches_the_reward(pendulum):
    env = SceneEnv(pendulum, lambda state, action, next_state, task: task, seed=0)
    start = env.reset(batch(3)).set("task", torch.arange(3.0).unsqueeze(-1))
    executed = env.rollout(4, tensordict=start, auto_reset=False)
    assert torch.equal(executed["next", "reward"], torch.arange(3.0).reshape(3, 1, 1).expand(3, 4, 1))


def test_a_reward_of_a_wrong_shape_is_named(pendulum):
    env = SceneEnv(pendulum, lambda state, action, next_state, task: state[..., 0, 0], seed=0)
    with pytest.raises(TypeError, match=r"a function of \(state, action, next_state, task\), .*<lambda> is not"):
        SceneEnv(pendulum, lambda state, action, next_state: state[..., 0, :1])  # pyright: ignore
    with pytest.raises(ValueError, match=r"the reward must be \[3, 1\]"):
        env.rollout(1, tensordict=batch(3))


def test_no_gradient_passes(pendulum):
    env = SceneEnv(pendulum, make_reward("balance", pendulum), seed=0)
    start = env.reset(batch(3))
    start["action"] = torch.zeros(3, 1, requires_grad=True)
    after = env.step(start)["next"]
    assert not any(value.requires_grad for value in after.values())


def test_a_scene_by_its_name_or_file(tmp_path):
    assert SceneEnv("swimmer3", seed=0).rollout(2)["state"].shape == (2, 4, 13)
    file = tmp_path / "cart.xml"
    file.write_text(zoo.mjcf("cart"))
    assert SceneEnv(file).scene.name == SceneEnv(str(file)).scene.name == "cart"


def test_an_unstable_step_costs_a_learner_what_staying_would(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo's log file
    for value, expected in ((-0.5, -50.0), (0.5, 0.0)):
        env = SceneEnv(zoo.load("cart", ('gear="1"', 'gear="1e12"')), lambda s, a, n, t, v=value: v + 0 * a, seed=0)
        for learning, reward in ((batched(env, 2), expected), (env, -1e6), (batched(env, 2).base_env, expected)):
            start = learning.reset(batch(2))
            start["action"] = torch.tensor([[1.0], [0.0]])
            after = learning.step(start)["next"]
            assert after["terminated"].flatten().tolist() == [True, False]
            assert after["reward"].flatten().tolist() == [reward, value]
    chosen = SceneEnv(env.scene, unstable_reward=-7.0)
    assert batched(chosen, 2).base_env is chosen


@pytest.mark.parametrize(
    "done",
    [
        lambda state: state[..., 1, 11] > 0,
        lambda state: state[..., 1, 11:12] > 0,
        TensorDictModule(lambda state: state[..., 1, 11:12] > 0, in_keys=["state"], out_keys=["terminated"]),
    ],
)
def test_episodes_end_where_a_function_says(pendulum, env, done):
    start = env.reset(batch(20))
    ends = SceneEnv(pendulum, done=done) if isinstance(env, SceneEnv) else ModelEnv(env.world_model, done=done)
    after = ends.step(ends.rand_action(start))["next"]
    expected = after["state"][..., 1, 11:12] > 0
    assert torch.equal(after["terminated"], expected) and torch.equal(after["done"], expected)
    check_env_specs(ends)
    wrong = SceneEnv(pendulum, done=lambda state: state[..., 1, 11])
    with pytest.raises(ValueError, match=r"done= must give 'terminated', bool \[20\] or \[20, 1\], got torch.float64"):
        wrong.step(wrong.rand_action(wrong.reset(batch(20))))


def test_a_done_module_reads_the_step_s_own_physics(pendulum):
    """MuJoCo's time, the first number, ends the episode after five steps."""
    late = TensorDictModule(lambda physics: physics[..., :1] > 4.5 * pendulum.timestep, ["physics"], ["terminated"])
    played = SceneEnv(pendulum, done=late, seed=0).rollout(10)
    assert len(played) == 5 and played["next", "terminated"].flatten().tolist() == 4 * [False] + [True]


def test_pictures_of_states(pendulum, scene_env, model_env):
    pytest.importorskip("PIL")
    executed = scene_env.rollout(3)
    pictures = scene_env.render(executed, size=64)
    assert pictures.shape == (3, 64, 64, 3) and pictures.dtype == np.uint8
    assert np.array_equal(pictures, model_env.render(executed.select("state"), size=64))
    variants = SceneEnv([pendulum, load_scene("pendulum", parameters={"length": 0.3})])
    first, second = variants.render(variants.rollout(1, tensordict=batch(2))[:, 0], size=64)
    assert (first != second).any()
    pixels = PixelRenderTransform(out_keys=["pixels"], pass_tensordict=True, size=64)
    assert TransformedEnv(scene_env, pixels).rollout(2)["pixels"].shape == (2, 64, 64, 3)


def test_a_reward_of_nan_is_named(pendulum, env):
    def broken(state, action, next_state, task):
        return next_state[..., 1, :1] * math.nan

    good = make_reward("balance", pendulum)
    bad = Velocity(pendulum, "pole", "x") * math.nan
    for reward, name in ((broken, "broken"), (good + bad, "WeightedSum")):
        made = SceneEnv(pendulum, reward) if isinstance(env, SceneEnv) else ModelEnv(env.world_model, reward)
        with pytest.raises(ValueError, match=f"the reward .*{name}.* returned NaN"):
            made.rollout(2)


def test_workers_that_get_a_copy_of_an_unseeded_environment_begin_their_own_episodes(pendulum):
    """As those of ``ParallelEnv(4, EnvCreator(lambda: env))``, or of a collector that gets an environment."""
    fork = multiprocessing.get_context("fork")
    firsts = []
    for seed in (None, 7):
        starts, drawn = StartSampler(pendulum, torch.arange(1000.0)[:, None].expand(-1, 3), seed), []
        for _ in range(2):
            ours, theirs = fork.Pipe()
            process = fork.Process(target=_draw_starts, args=(starts, theirs))
            process.start()
            assert ours.poll(60)
            drawn.append(ours.recv())
            process.join()
        firsts.append(drawn[0] == drawn[1])
        again = pickle.loads(pickle.dumps(starts))  # a copy in this process goes on with the same draws
        assert torch.equal(*(each.draw(torch.Size([8]), simulator=None) for each in (starts, again)))
    assert firsts == [False, True]


def _draw_starts(starts: StartSampler, pipe) -> None:
    pipe.send(starts.draw(torch.Size([8]), simulator=None)[:, 0].tolist())
