"""Planning by gradients against the known optimum, finite differences, and TorchRL's requirements on planners."""

from __future__ import annotations

import copy
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import StepCounter

from torchrl_gn.data import collect_trajectories
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.envs import ModelEnv, SceneEnv, batched
from torchrl_gn.planners import GradientPlanner
from torchrl_gn.rewards import FreezeGoal, make_reward
from torchrl_gn.scenes import Scene, load_scene

from .. import zoo
from ..sizes import SMALL

STEP, SPEED_WEIGHT, CONTROL_COST, HORIZON = 0.1, 0.1, 0.02, 12


def cart(limit: float) -> Scene:
    return zoo.load("cart", ("-1 1", f"-{limit} {limit}"), timestep=STEP)


class Point(TensorDictModuleBase):
    """A mass of 1 kg on a rail, exactly as MuJoCo integrates it."""

    def __init__(self, scene):
        super().__init__()
        self.in_keys, self.out_keys, self.scene = ["state", "action"], [("next", "state")], scene

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, action = tensordict["state"], tensordict["action"].to(tensordict["state"].dtype)
        along = torch.zeros(state.shape[-2:], dtype=state.dtype)
        along[1, 7] = 1.0
        moved = torch.zeros_like(along)
        moved[1, 0] = 1.0
        speed = state[..., 1, 7:8] + STEP * action
        shift = (STEP * speed).unsqueeze(-1) * moved
        return tensordict.set(("next", "state"), state + shift + (STEP * action).unsqueeze(-1) * along)


def quadratic(state, action, next_state, task):
    point = next_state[..., 1, :]
    cost = point[..., :1].square() + SPEED_WEIGHT * point[..., 7:8].square()
    return -cost - CONTROL_COST * action.square()


def point_env(limit: float) -> ModelEnv:
    return ModelEnv(Point(cart(limit)), quadratic)


def at(*places: float) -> TensorDict:
    state = torch.zeros(len(places), 2, 13, dtype=torch.float64)
    state[..., 3] = 1.0
    state[:, 1, 0] = torch.tensor(places)
    return TensorDict({"state": state}, batch_size=[len(places)])


def best_gains() -> list[np.ndarray]:
    """Riccati recursion of the cost on x_1 .. x_H and u_0 .. u_{H-1}."""
    a, b = np.array([[1.0, STEP], [0.0, 1.0]]), np.array([[STEP**2], [STEP]])
    q = np.diag([1.0, SPEED_WEIGHT])
    value, gains = np.zeros((2, 2)), []
    for _ in range(HORIZON):
        p = value + q
        gain = np.linalg.solve(CONTROL_COST + b.T @ p @ b, b.T @ p @ a)
        value, gains = a.T @ p @ (a - b @ gain), [gain, *gains]
    return gains


def best_actions(place: float) -> torch.Tensor:
    x, actions = np.array([place, 0.0]), []
    for gain in best_gains():
        u = -gain @ x
        actions.append(u)
        x = np.array([[1.0, STEP], [0.0, 1.0]]) @ x + np.array([STEP**2, STEP]) * u
    return torch.from_numpy(np.array(actions))


def returns(env: ModelEnv, start: TensorDict, actions: torch.Tensor) -> torch.Tensor:
    return env.imagine(start, actions)[1].sum((-2, -1)).double()


def check_that_it_imagines_what_stepping_gives(env: ModelEnv, start: TensorDict, actions: torch.Tensor) -> None:
    states, rewards = env.imagine(start, actions)
    now = start.clone()
    for t, action in enumerate(actions.unbind(1)):
        stepped = env.step(now.set("action", action))["next"]
        torch.testing.assert_close(states[:, t + 1], stepped["state"])
        torch.testing.assert_close(rewards[:, t], stepped["reward"])
        now = stepped.exclude("reward", "done", "terminated")


def trained(scene, **options):
    """A forward model that has seen data, and no more."""
    torch.manual_seed(0)
    bound = ForwardModel.for_scene(scene, **options).double().bind(scene)
    seen = collect_trajectories(scene, 5, 20, seed=0)
    update_parameter_normalizers(bound)
    update_dynamic_normalizers(bound, seen["state"][:, :-1], seen["action"], seen["state"][:, 1:])
    return bound


@pytest.mark.slow
def test_it_reaches_the_known_optimum_of_a_linear_quadratic_problem():
    env, start = point_env(20.0), at(1.0, -0.5)
    planner = GradientPlanner(env, HORIZON, warm_up=400, samples=4, seed=0)
    action = planner(start)["action"]
    optimum = torch.stack([best_actions(1.0), best_actions(-0.5)])
    assert optimum.abs().max() < 20  # no limit in the way
    # The plan that is left lacks the first action and repeats the last.
    planned = torch.cat((action[:, None], start["plan", "actions"][:, 0, :-1]), dim=1)
    best, found = returns(env, start, optimum.float()), returns(env, start, planned)
    assert (found <= best + 1e-6 * best.abs()).all()
    assert (best - found < 1e-3 * best.abs()).all()
    torch.testing.assert_close(action.double(), optimum[:, 0], rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_limits_bind():
    env, start = point_env(2.0), at(1.0)
    planner = GradientPlanner(env, HORIZON, warm_up=300, samples=4, seed=0)
    assert planner(start)["action"].item() == pytest.approx(-2.0)
    assert (start["plan", "actions"].abs() <= 2).all()


def test_it_imagines_what_stepping_gives():
    env, start = point_env(2.0), at(0.3, 0.7, -0.2)
    actions = torch.randn(3, 5, 1)
    check_that_it_imagines_what_stepping_gives(env, start, actions)
    with pytest.raises(ValueError, match=r"actions must be \[\*B, H, 1\]"):
        env.imagine(start, actions[:2])


@pytest.mark.parametrize("kind", ["bound", "specialized", "recurrent"])
def test_a_trained_kind_of_model_imagines_what_stepping_gives_and_differentiates_it(kind):
    scene = load_scene("cartpole")
    core = {"core": "recurrent", "hidden_state": [4, 4, 4]} if kind == "recurrent" else {}
    bound = trained(scene, **SMALL, **core)
    env = ModelEnv(specialize(bound) if kind == "specialized" else bound, make_reward("balance", scene), seed=0)
    start, actions = env.reset(TensorDict(batch_size=[2])), torch.rand(2, 4, 1, dtype=torch.float64) - 0.5
    check_that_it_imagines_what_stepping_gives(env, start, actions)

    def total(actions):
        states, _ = env.imagine(start, actions)
        return states[:, -1, :, :3].sum()

    actions.requires_grad_()
    (gradient,) = torch.autograd.grad(total(actions), actions)
    for index in ((0, 0, 0), (1, 3, 0)):
        step = torch.zeros_like(actions)
        step[index] = 1e-6
        difference = (total(actions + step) - total(actions - step)).item() / 2e-6
        assert gradient[index].item() == pytest.approx(difference, rel=1e-5, abs=1e-9)


@pytest.mark.slow
def test_the_next_call_goes_on_from_the_last_plan():
    env, planner = point_env(20.0), GradientPlanner(point_env(20.0), HORIZON, 2, warm_up=200, samples=4, seed=0)
    executed = env.rollout(4, planner, tensordict=at(1.0), auto_reset=False)
    optimum = best_actions(1.0)[:4]
    torch.testing.assert_close(executed["action"][0].double(), optimum, rtol=0.1, atol=0.3)
    fresh = GradientPlanner(env, HORIZON, 2, warm_up=2, samples=4, seed=0)
    alone = at(1.0)
    assert (fresh(alone)["action"].double() - optimum[0]).abs() > (executed["action"][0, 0].double() - optimum[0]).abs()


@pytest.mark.slow
def test_steps_shrink_where_they_gain_nothing_and_grow_where_they_do():
    env, error, sizes = point_env(20.0), {}, {}
    for shrink in (1.0, 0.7):
        planner = GradientPlanner(env, HORIZON, 3, shrink=shrink, warm_up=200, samples=4, seed=0)
        executed = env.rollout(30, planner, tensordict=at(1.0, -0.5, 2.0), auto_reset=False)
        best = -executed["state"][:, :, 1, [0, 7]] @ torch.from_numpy(best_gains()[0]).T
        error[shrink] = (executed["action"] - best)[:, 15:].abs().mean()
        sizes[shrink] = executed["plan", "step_size"][..., 0]
    assert error[0.7] < 0.4 * error[1.0]
    assert (sizes[1.0] == 1).all()
    assert (sizes[0.7][:, :1] == 1).all() and (sizes[0.7] <= 1).all() and 0.01 <= sizes[0.7][:, 15:].mean() < 0.5
    # Two rows that go on from here, one of them thrown off: its steps grow at every step, the other's do not.
    now = torch.cat([executed[:1, -1].exclude("next", "action")] * 2)
    now["plan", "step_size"] = torch.full((2, 1), 0.05)
    now["state"][1, 1, 0] += 5.0
    for _ in range(3):
        planner(now)
    at_rest, thrown = now["plan", "step_size"][:, 0].tolist()
    assert thrown == pytest.approx(0.4) and at_rest < 0.4


@pytest.mark.slow
def test_rows_are_planned_on_their_own():
    env = point_env(20.0)
    optimum = GradientPlanner(env, HORIZON, warm_up=150, samples=1, candidates=1, seed=0)
    both, one = at(1.0, -2.0), at(1.0)
    together = optimum(both)["action"]
    torch.testing.assert_close(together[:1], optimum(one)["action"], rtol=0.05, atol=0.05)


def test_candidates_find_what_one_sequence_misses():
    """A single ascent from the middle of two hills may climb the lower one."""
    scene = cart(1)

    def hills(state, action, next_state, task):
        x = next_state[..., 1, :1]
        return torch.exp(-((x - 0.4) ** 2) / 0.01) * 2 + torch.exp(-((x + 0.25) ** 2) / 0.01)

    env, start = ModelEnv(Point(scene), hills), at(0.0)
    many = GradientPlanner(env, HORIZON, warm_up=60, candidates=6, samples=6, seed=1)
    many(start)
    states, _ = env.imagine(at(0.0), start["plan", "actions"][:, 0])
    assert start["plan", "actions"].shape == (1, 6, HORIZON, 1)
    assert states[0, -1, 1, 0] > 0.2


def test_a_first_plan_is_of_the_best_samples_only(calls):
    """The first plan takes the best samples; the next plan draws two samples anew."""
    env, start = point_env(1.0), at(-0.3, 0.2)
    planner = GradientPlanner(env, HORIZON, 1, warm_up=0, candidates=4, samples=9, seed=3)
    twin = GradientPlanner(env, HORIZON, 1, warm_up=0, candidates=4, samples=9, seed=3)
    samples = twin.random_plans(2, 9)
    samples[:, 0] = 0
    drawn = calls(planner, "random_plans")
    planner(start)
    returns = planner.predicted_returns(at(-0.3, 0.2).repeat_interleave(9, 0), samples)
    best = samples.gather(1, returns.argsort(1, descending=True)[:, :4, None, None].expand(-1, -1, HORIZON, 1))
    torch.testing.assert_close(start["plan", "actions"][:, :, :-1], best[:, :, 1:])
    planner(start)
    assert drawn == [(2, 9), (2, 2)]


def test_steps_grow_after_an_improvement_and_shrink_after_none():
    def paid(state, action, next_state, task):
        return action

    planner = GradientPlanner(ModelEnv(Point(cart(20.0)), paid), 3, 1, warm_up=0, samples=1, shrink=0.7, seed=0)
    for place, factor in ((0.0, 2.0), (1.0, 0.7)):  # at the bound nothing is better
        plan, memory = torch.full((1, 1, 3, 1), place), {"step_size": torch.full((1, 1), 0.25)}
        after = planner.improve(at(0.0), plan, memory, resumed=True)[1]["step_size"]
        assert after.item() == pytest.approx(0.25 * factor)


def test_as_many_samples_as_candidates_are_sorted_too():
    planner, start = GradientPlanner(point_env(1.0), 4, warm_up=0, candidates=3, samples=3, seed=0), at(1.0)
    first = planner.initial_plan(start)
    totals = planner.predicted_returns(start.repeat_interleave(3, 0), first)
    assert (totals.diff(dim=1) <= 0).all() and (first[:, 0] != 0).any()


def test_an_episode_that_begins_anew_is_planned_anew(calls):
    scene = cart(5)
    planner = GradientPlanner(ModelEnv(Point(scene), quadratic), 4, 1, warm_up=3, samples=3, seed=0)
    env = batched(SceneEnv(scene, quadratic, seed=0), 2).append_transform(StepCounter(2))
    seen = calls(planner, "decide", lambda tensordict: tensordict["plan", "planned"].flatten().tolist())
    # TorchRL finds the primer by its name and appends it.
    collector = Collector(env, planner, frames_per_batch=8, total_frames=8, auto_register_policy_transforms=True)
    for data in collector:
        assert data["action"].shape == (2, 4, 1)
    assert seen[-4:] == [[False, False], [True, True], [False, False], [True, True]]


def test_a_task_is_fixed_when_planning_starts():
    scene = load_scene("swimmer3")
    reward = make_reward("reach", scene)
    imagined = ModelEnv(specialize(trained(scene, **SMALL)), reward)
    planner = GradientPlanner(imagined, 3, 1, warm_up=2, samples=3, candidates=2, seed=0)
    env = SceneEnv(scene, reward, seed=0)
    start = env.reset(TensorDict(batch_size=[2]))
    start["target"] = start["state"][:, 1, :3] + torch.tensor([[2.0, 0, 0], [0, 2, 0]])
    with torch.no_grad():
        executed = env.rollout(3, TensorDictSequential(FreezeGoal(reward), planner), tensordict=start, auto_reset=False)
    assert executed["action"].shape == (2, 3, scene.num_actions)
    assert (executed["next", "reward"] != 0).any()


def test_what_is_not_finite_keeps_the_last_good_plan_and_says_so():
    class Exploding(Point):
        def forward(self, tensordict):
            out = super().forward(tensordict)
            bad = tensordict["state"][..., 1, :1] > 5
            state = torch.where(bad.unsqueeze(-1), torch.nan, out["next", "state"])
            return out.set(("next", "state"), state)

    env = ModelEnv(Exploding(cart(2)), quadratic)
    planner = GradientPlanner(env, 4, 2, warm_up=5, samples=3, seed=0)
    good = at(1.0, 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        planner(good)
    plan = good["plan", "actions"].clone()
    good["state"][1, 1, 0] = 9.0
    with pytest.warns(RuntimeWarning, match="1 of 2 states has predictions or rewards that are not finite"):
        action = planner(good)["action"]
    assert action.isfinite().all()
    torch.testing.assert_close(action[1], plan[1, 0, 0])


class Exploding(Point):
    """Predicts a sideways velocity that is no number where it is pushed too hard, or everywhere."""

    def __init__(self, scene, strongest: float):
        super().__init__(scene)
        self.strongest = strongest

    def forward(self, tensordict):
        out = super().forward(tensordict)
        state = out["next", "state"].clone()
        state[..., 1, 8] = torch.where(tensordict["action"][..., 0] > self.strongest, torch.nan, state[..., 1, 8])
        return out.set(("next", "state"), state)


@pytest.mark.parametrize("what", ["rewards", "predictions"])
def test_a_plan_that_diverges_upwards_never_wins(what):
    """Float32 rewards overflow to infinity, more than any other; and a reward may not see which body is lost."""

    def strongest(state, action, next_state, task):
        reward = action.double()
        return torch.where(action > 1.5, 1e200, reward) if what == "rewards" else reward

    model = Exploding(cart(2), 1.5 if what == "predictions" else 9.0)
    planner = GradientPlanner(ModelEnv(model, strongest), 4, 5, warm_up=60, candidates=2, samples=6, seed=0)
    start = at(1.0, 0.5)
    for _ in range(2):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            action = planner(start)["action"]
        assert (action <= 1.5).all() and 1.3 < start["plan", "actions"][:, 0].max() <= 1.5


@pytest.mark.parametrize("reward", [quadratic, lambda *step: 1e200 * (1 + quadratic(*step).square())])
def test_where_nothing_is_finite_a_first_plan_is_to_rest_and_the_next_is_kept(reward):
    scene = cart(2)
    env = ModelEnv(Exploding(scene, -9.0) if reward is quadratic else Point(scene), reward)
    planner = GradientPlanner(env, 4, 2, warm_up=5, candidates=2, samples=40, seed=0)
    start = at(1.0, 0.5)
    with pytest.warns(RuntimeWarning, match="of 2 of 2 states .* there is no plan yet, and nothing is done"):
        assert (planner(start)["action"] == 0).all()
    assert (start["plan", "actions"][:, 0] == 0).all()
    start["plan", "actions"][:, 0] = 0.25
    with pytest.warns(RuntimeWarning, match="their last plan is kept"):
        torch.testing.assert_close(planner(start)["action"], torch.full((2, 1), 0.25))


def test_equal_bounds_fix_an_action():
    env = point_env(2.0)
    env.world_model.scene = env.scene = replace(env.scene, action_low=np.array([1.5]), action_high=np.array([1.5]))
    planner, start = GradientPlanner(env, 4, 2, warm_up=3, candidates=2, samples=4, action_cost=1.0, seed=0), at(1.0)
    for _ in range(2):
        assert planner(start)["action"].item() == 1.5
        assert (start["plan", "actions"] == 1.5).all()


def test_gradients_are_opened_under_no_grad_and_refused_in_inference_mode():
    planner = GradientPlanner(point_env(2.0), 3, 1, warm_up=2, samples=2, seed=0)
    with torch.no_grad():
        assert planner(at(1.0))["action"].shape == (1, 1)
    with torch.inference_mode(), pytest.raises(RuntimeError, match="torch.no_grad"):
        planner(at(1.0))


def test_states_of_inference_mode_are_planned_from():
    planner = GradientPlanner(point_env(2.0), 3, 1, warm_up=2, samples=2, seed=0)
    with torch.inference_mode():
        start = at(1.0) + 0
    assert start["state"].is_inference()
    again = copy.deepcopy(planner)
    torch.testing.assert_close(planner(start)["action"], again(at(1.0))["action"])


def test_output_tensordict():
    planner = GradientPlanner(point_env(2.0), 3, 1, warm_up=2, samples=2, seed=0)
    given, out = at(1.0), TensorDict()
    assert planner(given, out) is out and set(given.keys()) == {"state"}
    plan = {("plan", name) for name in ("actions", "planned", "time", "step_size")}
    assert set(out.keys(True, True)) == {"action", *plan}
    with pytest.raises(ValueError, match="GradientPlanner takes no steps"):
        planner(given, steps=3)


@pytest.mark.slow
def test_actions_cost_what_is_asked():
    """``action_cost`` replaces the reward's own cost; zero actions are best at a high cost."""
    env = ModelEnv(point_env(2.0).world_model, lambda *step: quadratic(*step) + CONTROL_COST * step[1].square())
    start = at(1.0)
    free, dear = (
        GradientPlanner(env, HORIZON, warm_up=100, samples=2, action_cost=cost, seed=0)(start.clone())[
            "plan", "actions"
        ]
        for cost in (0.0, 100.0)
    )
    assert dear.abs().max() < 0.05 < free.abs().max()


def test_the_optimizer_is_the_one_given():
    """A step of gradient descent with a rate of 1/4 from rest, in units of half the range."""
    env, start = point_env(2.0), at(1.0)
    planner = GradientPlanner(
        env, HORIZON, warm_up=1, samples=1, optimizer=lambda moved: torch.optim.SGD(moved, lr=0.25), seed=0
    )
    units = torch.zeros(1, HORIZON, 1, requires_grad=True)
    (gradient,) = torch.autograd.grad(env.imagine(at(1.0), 2 * units)[1].sum(), units)
    action = planner(start)["action"]
    expected = 2 * 0.25 * gradient[0]
    assert expected.abs().max() < 2
    torch.testing.assert_close(torch.cat((action, start["plan", "actions"][0, 0, :-1])), expected)


def test_noise_is_a_share_of_the_range_around_the_best():
    plan = torch.full((3, 4, HORIZON, 1), 0.1)
    plan[:, 1:] = -0.9
    for noise in (0.0, 0.05, 0.5):
        planner = GradientPlanner(point_env(2.0), HORIZON, candidates=4, noise=noise, seed=0)
        off = planner.resample(plan)[:, 2:] - 0.1
        assert (off.abs() <= noise + 1e-6).all() and (off.abs().max() > 0.5 * noise or noise == 0)
        assert torch.equal(planner.resample(plan)[:, :2], plan[:, :2])


def test_a_gradient_that_is_no_number_costs_an_iteration_and_no_more():
    """The reward is a number all the while."""
    calls = []

    def reward(state, action, next_state, task):
        calls.append(None)
        lost = torch.tensor(len(calls) == 5) & (state[..., 1, :1] < 0)
        return quadratic(state, action, next_state, task) + torch.where(lost, 0 * action, 1.0).sqrt()

    scene = cart(20)
    planner = GradientPlanner(ModelEnv(Point(scene), reward), 1, 60, warm_up=60, samples=1, seed=0)
    action = planner(at(1.0, -1.0))["action"]
    assert len(calls) > 60 and action[0] < -0.4 and action[1] == pytest.approx(-action[0].item(), rel=0.05)


def test_a_copy_plans_the_same():
    planner = GradientPlanner(point_env(2.0), 3, 1, warm_up=2, samples=2, seed=0)
    torch.testing.assert_close(copy.deepcopy(planner)(at(1.0))["action"], planner(at(1.0))["action"])


def test_integers_of_numpy_are_whole_numbers_and_booleans_are_not():
    env, counts = (
        point_env(2.0),
        {"horizon": 3, "iterations": 2, "warm_up": 2, "samples": 4, "candidates": 2, "seed": 0},
    )
    usual = GradientPlanner(env, **counts)(at(1.0, -0.5))["action"]
    numbers = {name: np.int64(count) for name, count in counts.items()}
    assert torch.equal(GradientPlanner(env, **numbers)(at(1.0, -0.5))["action"], usual)
    with pytest.raises(ValueError, match="horizon=True must be a whole number"):
        GradientPlanner(env, **{**counts, "horizon": True})


@pytest.mark.parametrize(
    ("optimizer", "message"),
    [
        (torch.optim.LBFGS, "LBFGS needs a closure"),
        ("adam", "must be a function that makes an optimiser of tensors, .* not 'adam'"),
        (torch.optim.Adam([torch.zeros(1)]), "must be a function that makes an optimiser of tensors, .* not Adam"),
        (lambda moved: None, "must be a function that makes an optimiser of tensors"),
    ],
)
def test_optimisers_that_cannot_plan_are_refused(optimizer, message):
    """They ended in Python's errors at the first plan."""
    with pytest.raises(TypeError, match=message):
        GradientPlanner(point_env(2.0), 3, optimizer=optimizer)


def test_bad_input_is_named():
    env = point_env(2.0)
    for options, message in (
        ({"horizon": 0}, "horizon=0 must be a whole number, 1 or more"),
        ({"horizon": 3, "iterations": 0}, "iterations=0 must be a whole number, 1 or more"),
        ({"horizon": 3, "candidates": 0}, "candidates=0 must be a whole number, 1 or more"),
        ({"horizon": 3, "candidates": 3, "samples": 2}, "samples must be at least candidates=3, got 2"),
        ({"horizon": 2.5}, "horizon=2.5 must be a whole number"),
        ({"horizon": 3, "samples": 4.0}, "samples=4.0 must be a whole number"),
        ({"horizon": 3, "warm_up": -1}, "warm_up=-1 must be a whole number, 0 or more"),
        ({"horizon": 3, "warm_up": 2.5}, "warm_up=2.5 must be a whole number"),
        ({"horizon": 3, "noise": 2.0}, "noise=2.0 must be from 0 to 1"),
        ({"horizon": 3, "shrink": 0.0}, "shrink must be above 0 and at most 1, got 0"),
        ({"horizon": 3, "action_cost": float("inf")}, "action_cost=inf must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            GradientPlanner(env, **options)
    with pytest.raises(TypeError, match="On the true physics use ILQGPlanner"):
        GradientPlanner(SceneEnv(env.scene, quadratic), 3)
    with pytest.raises(ValueError, match="no reward to plan for"):
        GradientPlanner(ModelEnv(Point(env.scene)), 3)
    crossed = point_env(2.0)
    crossed.scene = replace(env.scene, action_high=np.array([-3.0]))
    with pytest.raises(ValueError, match="action 0 between -2 and -3: action_low must not be above"):
        GradientPlanner(crossed, 3)
    still = zoo.load("falling")
    with pytest.raises(ValueError, match="no actions to plan"):
        GradientPlanner(ModelEnv(Point(still), quadratic), 3)
    deaf = ModelEnv(Point(env.scene), lambda state, action, next_state, task: state.detach()[..., 1, :1])
    with pytest.raises(ValueError, match="do not depend on the actions"):
        GradientPlanner(deaf, 1, 1, warm_up=1, samples=2, seed=0)(at(1.0))
    weight = torch.ones(1, requires_grad=True)  # has a gradient of its own
    deaf = ModelEnv(Point(env.scene), lambda state, action, next_state, task: weight * state.detach()[..., 1, :1])
    with pytest.raises(ValueError, match="do not depend on the actions"):
        GradientPlanner(deaf, 1, 1, warm_up=1, samples=2, seed=0)(at(1.0))
    planner, start = GradientPlanner(env, 3, 1, warm_up=1, samples=2, seed=0), at(1.0)
    planner(start)
    with pytest.raises(ValueError, match="comes from another planner"):
        GradientPlanner(env, 5, 1, warm_up=1, samples=2, seed=0)(start)


def test_a_compiled_model_sees_one_number_of_rows(calls):
    """Every other number of rows would take minutes to compile."""
    scene = cart(20.0)
    point = Point(scene)
    point.fixed_batch = True
    env = ModelEnv(point, quadratic)
    rows = calls(env, "imagine_steps", lambda entries, actions, prepared: len(actions))
    start = at(1.0, -0.5)
    GradientPlanner(env, HORIZON, 2, warm_up=3, samples=9, candidates=2, seed=0)(start)
    assert set(rows) == {4} and len(rows) == 9 // 2 + 3 + 1
