"""Tasks of the control suite as scenes: their physics, starts and descriptions are dm_control's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_gn.data import Simulator, sample_start_states
from torchrl_gn.scenes import hidden_by_task, load_scene, load_suite_task, scene_from_description, suite_name
from torchrl_gn.scenes.suite_tasks import full_physics

pytest.importorskip("dm_control.suite")
STEPS = 20


@pytest.mark.parametrize(
    "task",
    ["acrobot/swingup", "cartpole/two_poles", "finger/spin", "fish/upright", "quadruped/walk", "swimmer/swimmer6"],
)
def test_physics_are_dm_controls(task: str) -> None:
    domain, name = task.split("/")
    scene, env = load_scene(f"suite:{task}"), load_suite_task(domain, name, 3)
    env.reset()
    assert scene.timestep == env.control_timestep() and scene.name == task.replace("/", "-")
    rng, spec = np.random.default_rng(0), env.action_spec()
    start, controls, states = full_physics(env), rng.uniform(spec.minimum, spec.maximum, (STEPS, *spec.shape)), []
    for control in controls:
        env.step(control)
        states.append(full_physics(env))
    found = Simulator(scene).rollout(torch.from_numpy(start), torch.from_numpy(controls))["physics"]
    assert np.abs(states[-1] - start).max() > 0.1
    np.testing.assert_allclose(torch.as_tensor(found)[1:].numpy(), np.stack(states), atol=1e-8)
    np.testing.assert_array_equal(scene.action_low, spec.minimum)


def test_starts_are_dm_controls() -> None:
    scene = load_scene("suite:cheetah/run")
    states = sample_start_states(scene, 3, 0)
    again = sample_start_states(scene, 3, 0)
    np.testing.assert_array_equal(states, again)
    env = load_suite_task("cheetah", "run", 0)
    env.task.random.seed(int(np.random.default_rng(0).integers(2**32)))
    for state in states:
        env.reset()
        np.testing.assert_array_equal(state, full_physics(env))
    assert np.ptp(states[:, 4:10], axis=0).min() > 0.01


def test_a_description_rebuilds_the_task() -> None:
    scene = load_scene("suite:finger/spin", timestep=0.04)
    again = scene_from_description(scene.description())
    assert again.origin["suite"] == "finger/spin" and again.timestep == 0.04
    np.testing.assert_array_equal(again.model.dof_damping, scene.model.dof_damping)
    assert scene.model.joint("hinge").damping == 0.03  # which the task sets, not its file


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("cheetah/fly", "The suite has no task cheetah fly; there are run"),
        ("cow/run", "no task cow run; there are acrobot"),
        ("dog/run", "There is no scene of the suite's dog/run"),
        ("quadruped/escape", "no scene of the suite's quadruped/escape"),
        ("point_mass/hard", "point_mass/hard differ in their physics"),
    ],
)
def test_refuses_tasks_without_a_scene(task: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_scene(f"suite:{task}")


def test_names() -> None:
    assert suite_name("suite:ball_in_cup/catch") == ("ball_in_cup", "catch")
    assert suite_name("cheetah") is None and suite_name(None) is None and suite_name("suite:cheetah") is None
    with pytest.raises(ValueError, match="has bounds of its own"):
        load_scene("suite:cheetah/run", action_bounds=(-1, 1))


@pytest.mark.parametrize(
    ("task", "hidden"),
    [
        ("cheetah/run", (True, False)),
        ("quadruped/walk", (True, True)),
        ("humanoid/run_pure_state", (False, False)),
        ("cartpole/swingup", (False, False)),
    ],
)
def test_what_observations_hide(task: str, hidden: tuple[bool, bool]) -> None:
    assert hidden_by_task(*task.split("/")) == hidden


def test_loads_in_silence(caplog: pytest.LogCaptureFixture) -> None:
    load_scene("suite:cheetah/run")
    assert caplog.records == []
