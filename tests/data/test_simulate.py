"""Batched simulation against MuJoCo stepped one by one, and against itself."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator, sample_start_states, spline_controls
from torchrl_gn.scenes import Scene, load_scene

from .. import zoo

PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS


def _inputs(scene: Scene, num: int, steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return sample_start_states(scene, num, rng), spline_controls(scene, num, steps, rng)


def _body_states(scene: Scene, data: mujoco.MjData) -> np.ndarray:
    """The 13 numbers of each node from MuJoCo's own functions, without sensors."""
    rows, velocity = [], np.empty(6)
    for body in map(int, scene.body):
        mujoco.mj_objectVelocity(scene.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        rows.append(np.concatenate([data.xpos[body], data.xquat[body], velocity[3:], velocity[:3]]))
    return np.stack(rows)


@pytest.mark.parametrize("name", ["swimmer6", "cheetah", "acrobot"])
def test_equals_a_plain_loop_of_mj_step(name: str) -> None:
    scene = load_scene(name)
    physics, actions = _inputs(scene, 3, 20)
    result = Simulator(scene, 2).rollout(physics, actions)
    for i in range(3):
        data = mujoco.MjData(scene.model)
        mujoco.mj_setState(scene.model, data, physics[i], PHYSICS)
        state = np.empty(scene.physics_size)
        for t in range(21):
            mujoco.mj_getState(scene.model, data, state, PHYSICS)
            np.testing.assert_array_equal(result["physics"][i, t], state)
            mujoco.mj_forward(scene.model, data)
            np.testing.assert_allclose(result["state"][i, t], _body_states(scene, data), rtol=0, atol=1e-12)
            if t < 20:
                data.ctrl[:] = actions[i, t]
                mujoco.mj_step(scene.model, data, scene.substeps)


def test_actions_may_change_within_a_control_step() -> None:
    scene = load_scene("swimmer6")
    physics, actions = _inputs(scene, 3, 4 * scene.substeps)
    simulator = Simulator(scene, 1, memory=1)
    within = actions.reshape(3, 4, scene.substeps, scene.num_actions)
    result = simulator.rollout(physics, within)
    assert scene.substeps > 1 and result["state"].shape[:2] == (3, 5)
    for i in range(3):
        data, state = mujoco.MjData(scene.model), np.empty(scene.physics_size)
        mujoco.mj_setState(scene.model, data, physics[i], PHYSICS)
        for t, action in enumerate(actions[i], 1):
            data.ctrl[:] = action
            mujoco.mj_step(scene.model, data)
            if t % scene.substeps == 0:
                mujoco.mj_getState(scene.model, data, state, PHYSICS)
                np.testing.assert_array_equal(result["physics"][i, t // scene.substeps], state)
    held = np.repeat(within[:, :, :1], scene.substeps, axis=2)
    same, expected = (simulator.rollout(physics, each) for each in (held, within[:, :, 0]))
    assert all(torch.equal(same[key], expected[key]) for key in ("state", "physics"))


@pytest.mark.parametrize("name", ["swimmer6", "cheetah"])
def test_replays_bit_for_bit(name: str) -> None:
    """Steps replay from the middle, with another number of threads, in another batch and in chunks."""
    scene = load_scene(name)
    physics, actions = _inputs(scene, 6, 30)
    recorded = Simulator(scene, 2).rollout(physics, actions)
    middle, rest = recorded["physics"][:, 13], torch.from_numpy(actions[:, 13:])
    for threads, memory in ((1, None), (3, 1)):
        again = Simulator(scene, threads, memory=memory).rollout(middle, rest)
        assert torch.equal(again["physics"], recorded["physics"][:, 13:])
        assert torch.equal(again["state"], recorded["state"][:, 13:])
    one = Simulator(scene, 1).rollout(middle[4], rest[4])
    assert torch.equal(one["state"], recorded["state"][4, 13:])


def test_any_batch(swimmer: Scene) -> None:
    simulator = Simulator(swimmer, 1)
    physics, actions = _inputs(swimmer, 6, 4)
    flat = simulator.rollout(physics, actions)
    for batch in ((2, 3), (6, 1, 1)):
        shaped = simulator.rollout(physics.reshape(*batch, -1), actions.reshape(*batch, 4, -1))
        assert shaped.shape == batch and shaped["state"].shape == (*batch, 5, 7, 13)
        assert torch.equal(shaped["state"].reshape(6, 5, 7, 13), flat["state"])
    assert simulator.rollout(physics[:0], actions[:0])["state"].shape == (0, 5, 7, 13)
    none = simulator.rollout(physics, actions[:, :0])
    assert torch.equal(none["state"], flat["state"][:, :1]) and none["stable"].all()


def test_observe_equals_rollout(swimmer: Scene) -> None:
    simulator = Simulator(swimmer, 1)
    result = simulator.rollout(*_inputs(swimmer, 3, 5))
    assert torch.equal(simulator.observe(result["physics"]), result["state"])


@pytest.mark.parametrize("memory", [None, 1])
def test_a_step_equals_that_of_a_rollout(memory: int | None) -> None:
    scene = load_scene("cheetah")
    simulator = Simulator(scene, 1, memory=memory)
    physics, actions = _inputs(scene, 3, 2)
    executed = simulator.rollout(physics, actions)
    for t in range(2):
        after, state = simulator.step(physics, actions[:, t])
        np.testing.assert_array_equal(after, executed["physics"][:, t + 1])
        np.testing.assert_array_equal(state, executed["state"][:, t])
        physics = after


def test_scenes_of_different_mass() -> None:
    scenes = [zoo.load("pole", ('mass="1"', f'mass="{mass}"')) for mass in (1.0, 3.0)]
    physics, actions = _inputs(scenes[0], 4, 10)
    alone = [Simulator(scene, 1).rollout(physics, actions) for scene in scenes]
    assert not torch.equal(alone[0]["state"], alone[1]["state"])
    together = Simulator(scenes, 2)
    in_turn = together.rollout(physics, actions)
    chosen = together.rollout(physics, actions, torch.tensor([1, 1, 0, 0]))
    for i in range(4):
        assert torch.equal(in_turn["state"][i], alone[i % 2]["state"][i])
        assert torch.equal(chosen["state"][i], alone[1 if i < 2 else 0]["state"][i])
    assert torch.equal(together.observe(in_turn["physics"][:, -1]), in_turn["state"][:, -1])
    stepped, _ = together.step(physics, actions[:, 0], np.array([1, 1, 0, 0]))
    np.testing.assert_array_equal(stepped, chosen["physics"][:, 1])
    with pytest.raises(ValueError, match="variant must lie in"):
        together.rollout(physics, actions, torch.tensor([0, 1, 2, 0]))
    with pytest.raises(ValueError, match="node_names"):
        Simulator([scenes[0], load_scene("pendulum")])


def test_scenes_of_different_steps_are_refused() -> None:
    """Equal numbers of physics steps are refused, too: the times of both would be the first's."""
    first, second = (
        zoo.load("point", ('timestep="0.01"', f'timestep="{step}"'), timestep=5 * step) for step in (0.004, 0.005)
    )
    with pytest.raises(ValueError, match="timestep of scene 0 .* is 0.02 and of scene 1 .* 0.025"):
        Simulator([first, second])


def test_actions_outside_the_bounds_are_clamped(pendulum: Scene) -> None:
    physics, _ = _inputs(pendulum, 1, 1)
    simulator = Simulator(pendulum, 1)
    beyond, at = (simulator.rollout(physics, np.full((1, 5, 1), u)) for u in (7.0, 1.0))
    assert torch.equal(beyond["state"], at["state"])


def test_files_that_do_not_clamp_controls_are_clamped_too() -> None:
    text = """<mujoco><option><flag clampctrl="disable"/></option><worldbody><body><joint name="a"/><geom size=".1"
      pos=".3 0 0"/></body></worldbody><actuator><motor joint="a" ctrlrange="-1 1"/></actuator></mujoco>"""
    scene = load_scene(text)
    physics, actions = torch.from_numpy(scene.rest_physics).expand(2, -1), torch.tensor([[[1.0]], [[5.0]]])
    within, beyond = Simulator(scene).rollout(physics, actions)["state"]
    assert torch.equal(within, beyond) and within[1, 1].any()


def test_scene_without_actuators() -> None:
    scene = zoo.load("falling", timestep=0.01)
    physics, _ = _inputs(scene, 2, 1)
    result = Simulator(scene, 1).rollout(physics, np.zeros((2, 10, 0)))
    fallen = result["state"][:, -1, 1, 2] - result["state"][:, 0, 1, 2]
    # Semi-implicit Euler: sum of k g dt^2 over 10 steps.
    np.testing.assert_allclose(fallen, -55 * 9.81 * 0.01**2, rtol=1e-9)


def test_bad_input_is_refused_and_named(swimmer: Scene) -> None:
    simulator = Simulator(swimmer, 1)
    physics, actions = _inputs(swimmer, 2, 3)
    with pytest.raises(TypeError, match="physics must be float64.*float32"):
        simulator.observe(physics.astype(np.float32))
    with pytest.raises(TypeError, match="actions must be floating point, got int64"):
        simulator.rollout(physics, np.zeros((2, 3, 5), dtype=np.int64))
    with pytest.raises(TypeError, match="must be a tensor or an array, got list"):
        simulator.rollout(physics, [[0.0]])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"must be \[2, T, 5\].*got \[2, 3, 4\]"):
        simulator.rollout(physics, actions[..., :4])
    with pytest.raises(ValueError, match=r"must be \[2, T, 5\].*got \[1, 3, 5\]"):
        simulator.rollout(physics, actions[:1])
    with pytest.raises(ValueError, match=rf"must be \[2, T, {swimmer.substeps}, 5\].*got \[2, 3, 1, 5\]"):
        simulator.rollout(physics, actions[:, :, None])
    with pytest.raises(ValueError, match=r"must be \[2, T, 5\].*got \[2\]"):
        simulator.rollout(physics, actions[:, 0, 0])
    with pytest.raises(ValueError, match=r"must be \[\*B, 17\], got \[2, 16\]"):
        simulator.observe(physics[:, 1:])
    with pytest.raises(ValueError, match=r"must be \[2, 5\].*got \[1, 5\]"):
        simulator.step(physics, actions[:1, 0])
    with pytest.raises(ValueError, match="num_threads"):
        Simulator(swimmer, 0)


@pytest.mark.parametrize("threads", [1, 2])
def test_unstable_simulations_are_told(threads: int, tmp_path, monkeypatch, capfd, request) -> None:
    before = mujoco.get_mju_user_warning()  # dm_control sets one, if a test has imported it
    request.addfinalizer(lambda: mujoco.set_mju_user_warning(before))
    mujoco.set_mju_user_warning(None)
    monkeypatch.chdir(tmp_path)
    scene = zoo.load("cart", ('gear="1"', 'gear="1e12"'))
    simulator = Simulator(scene, threads)
    physics = np.tile(_inputs(scene, 1, 1)[0], (4, 1))
    actions = np.zeros((4, 6, 1))
    actions[1, 0], actions[2, 5], actions[3, 3] = 1.0, 1.0, -1.0
    assert simulator.rollout(physics, actions)["stable"].tolist() == [True, False, False, False]
    # One step from time 0, as an environment takes it: the time after MuJoCo's reset looks right.
    assert simulator.rollout(physics, actions[:, :1])["stable"].tolist() == [True, False, True, True]
    assert simulator.rollout(physics, actions[:, :3])["stable"].tolist() == [True, False, True, True]
    after = physics.copy()  # at time 0, to which MuJoCo's reset sets back
    for t in range(4):
        after, _ = simulator.step(after, actions[:, t])  # what was unstable once stays so
        assert np.isnan(after).all(1).tolist() == [False, True, False, t == 3]
    assert np.isfinite(after[[0, 2]]).all()
    physics[0, 1] = 1e11  # MuJoCo resets such a state
    assert simulator.rollout(physics, actions * 0)["stable"].tolist() == [False, True, True, True]
    assert not list(tmp_path.iterdir())  # no MUJOCO_LOG.TXT
    assert "".join(capfd.readouterr()) == ""
    assert mujoco.get_mju_user_warning() is None


def test_scenes_of_other_action_bounds_are_refused() -> None:
    text = """<mujoco><worldbody><body name="a"><joint name="j"/><geom size=".1"/></body></worldbody>
      <actuator><motor name="m" joint="j" ctrlrange="-{0} {0}"/></actuator></mujoco>"""
    with pytest.raises(ValueError, match=r"action_low of scene 0 .* is \[-1\.\] and of scene 1 .* \[-0\.5\]"):
        Simulator([load_scene(text.format(size)) for size in (1, 0.5)])
