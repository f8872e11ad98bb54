"""Planning while acting: committed actions, plans for the state after them, in turn and in the background."""

from __future__ import annotations

import contextlib
import threading
import time

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, InitTracker, StepCounter, TransformedEnv
from torchrl.modules import CEMPlanner
from torchrl.modules.planners.common import MPCPlannerBase

from torchrl_gn.dynamics import specialize
from torchrl_gn.envs import ModelEnv, SceneEnv
from torchrl_gn.planners import GradientPlanner, ILQGPlanner, PlanAhead
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import load_scene
from torchrl_gn.training import load_pretrained


@pytest.fixture(scope="module")
def scene():
    return load_scene("pendulum")


@pytest.fixture
def env(scene):
    return SceneEnv(scene, make_reward("balance", scene), seed=0)


class Feedback(MPCPlannerBase):
    """A planner without memory: an action that follows from the state."""

    def __init__(self, env, seconds: float = 0.0) -> None:
        super().__init__(env)
        self.seconds, self.threads = seconds, set()

    def planning(self, td):
        time.sleep(self.seconds)
        self.threads.add(threading.current_thread().name)
        return torch.tanh(td["state"][..., 1, 3:5].sum(-1, keepdim=True) + td["state"][..., 1, 11:12]).float()


def execute(env, planner, steps: int, start: TensorDict | None = None) -> TensorDict:
    start = env.reset() if start is None else start.copy()
    return env.rollout(steps, planner, tensordict=start, auto_reset=False)


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("delay", [1, 2, 4])
def test_with_exact_predictions_the_delay_changes_nothing(env, delay, background):
    start = env.reset()
    expected = execute(env, Feedback(env), 12, start)
    planner = PlanAhead(Feedback(env), delay, background=background)
    found = execute(env, planner, 12, start)
    torch.testing.assert_close(found["action"], expected["action"], rtol=1e-6, atol=1e-7)
    planner.wait()


@pytest.mark.parametrize("delay", [1, 3])
def test_the_background_plans_as_in_turn(scene, env, delay):
    model = specialize(load_pretrained("pendulum").bind(scene))
    imagined, start = ModelEnv(model, env.reward), env.reset()
    actions = []
    for background in (False, True):
        gradients = GradientPlanner(imagined, 8, 2, warm_up=3, samples=8, seed=0)
        planner = PlanAhead(gradients, delay, background=background)
        actions.append(execute(env, planner, 8, start)["action"])
        planner.wait()
    assert torch.equal(*actions) and actions[0].abs().max() > 0


def test_it_plans_beside_the_caller_and_counts_late_plans(env):
    slow, quick = PlanAhead(Feedback(env, 0.2), background=True), PlanAhead(Feedback(env), background=True)
    quick.planner(env.reset())
    for planner, waits in ((slow, False), (quick, True)):
        td = env.reset()
        for _ in range(5):
            td = planner(td)
            if waits:
                planner.wait()
            stepped = env.step(td)
            td = stepped["next"].exclude("reward").update(td.select("ahead"))
        planner.wait()
    assert slow.late >= 3 and quick.late == 0
    assert any(name.startswith("PlanAhead") for name in slow.planner.threads)


def test_episodes_of_a_batch_begin_apart(scene, env):
    several = env.reset(TensorDict(batch_size=[3]))
    planner = PlanAhead(ILQGPlanner(env, 5, 1, seed=0), 2)
    first = planner(several.copy())
    assert first["ahead", "actions"].shape == (3, 2, 1) and first["ahead", "planned"].all()
    mixed = first.clone()
    mixed["ahead", "planned"][1] = False
    mixed["plan", "planned"][1] = False
    after = planner(mixed.copy())
    alone = planner(first.copy())
    torch.testing.assert_close(after["action"][[0, 2]], alone["action"][[0, 2]])
    with pytest.raises(ValueError, match="begin together"):
        PlanAhead(Feedback(env), background=True)(mixed)


def test_auto_resets_begin_anew(scene, env):
    planner = PlanAhead(ILQGPlanner(env, 5, 1, seed=0), 2)
    real = TransformedEnv(SceneEnv(scene, make_reward("balance", scene), seed=1), planner.make_tensordict_primer())
    td = real.reset()
    assert not td["ahead", "planned"].any() and td["ahead", "actions"].shape == (2, 1)
    after = real.rollout(3, planner)
    assert after["next", "ahead", "planned"].all()
    assert not real.reset()["ahead", "planned"].any()


@pytest.mark.parametrize("background", [False, True])
def test_actions_of_an_earlier_episode_are_dropped_without_a_primer(scene, env, background):
    """By the time in ``physics``, which a reset sets back."""
    planner = PlanAhead(Feedback(env), 2, background=background)
    real = TransformedEnv(SceneEnv(scene, env.reward, seed=1), StepCounter(4))
    played = real.rollout(10, planner, break_when_any_done=False)
    planner.wait()
    assert played["next", "done"].sum() == 2
    torch.testing.assert_close(played["action"], Feedback(env)(played.clone())["action"], rtol=1e-6, atol=1e-7)


def test_where_an_episode_begins_by_torchrls_tracker_it_plans_anew(scene, env):
    """Environments without ``physics`` do not tell the time."""
    imagined = ModelEnv(specialize(load_pretrained("pendulum").bind(scene)), env.reward, seed=1)
    planner = PlanAhead(Feedback(imagined), 2)
    real = TransformedEnv(imagined, Compose(InitTracker(), StepCounter(4)))
    played = real.rollout(10, planner, break_when_any_done=False)
    assert played["next", "done"].sum() == 2
    torch.testing.assert_close(played["action"], Feedback(env)(played.clone())["action"], rtol=1e-6, atol=1e-7)


def test_environments_of_another_control_step_are_refused(scene, env):
    slower = load_scene("pendulum", timestep=2 * scene.timestep)
    with pytest.raises(ValueError, match="have passed in 'physics' since the plan was made"):
        SceneEnv(slower, make_reward("balance", slower), seed=0).rollout(3, PlanAhead(Feedback(env), 2))


def test_planners_of_torchrl_plan_ahead_too(env):
    planner = PlanAhead(CEMPlanner(env, planning_horizon=3, optim_steps=1, num_candidates=4, top_k=2), 2)
    start = env.reset(TensorDict(batch_size=[2]))
    assert execute(env, planner, 3, start)["action"].shape == (2, 3, 1)


def test_what_a_plan_raises_reaches_the_caller(env):
    class Broken(Feedback):
        def planning(self, td):
            if threading.current_thread().name.startswith("PlanAhead"):
                raise ArithmeticError("no plan")
            return super().planning(td)

    planner = PlanAhead(Broken(env), background=True)
    td = planner(env.reset())
    with pytest.raises(ArithmeticError, match="no plan"):
        planner(td)


@pytest.mark.parametrize("failed", [1, 2, 3])
def test_it_plans_on_after_an_error_in_the_background(env, failed):
    """A plan that failed stopped all later episodes with its error."""
    broken = threading.Event()

    class Sometimes(Feedback):
        def planning(self, td):
            if broken.is_set() and threading.current_thread().name.startswith("PlanAhead"):
                raise ArithmeticError("no plan")
            return super().planning(td)

    planner, start = PlanAhead(Sometimes(env), 2, background=True), env.reset()
    expected = execute(env, PlanAhead(Sometimes(env), 2, background=True), 5, start.clone())["action"]
    now = planner(start.clone())
    broken.set()
    for _ in range(failed):
        with contextlib.suppress(ArithmeticError):
            now = planner(now)
    broken.clear()
    with contextlib.suppress(ArithmeticError):
        planner.wait()
    assert torch.equal(execute(env, planner, 5, start.clone())["action"], expected)


def test_bad_options_are_named(env):
    with pytest.raises(ValueError, match="delay=0 must be a whole number, 1 or more"):
        PlanAhead(Feedback(env), 0)
    with pytest.raises(TypeError, match="needs a planner with an environment, got Linear"):
        PlanAhead(torch.nn.Linear(1, 1))  # type: ignore[arg-type]
