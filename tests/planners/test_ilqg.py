"""iLQG against the Riccati equation, a bounded optimiser, a swing-up, and TorchRL's requirements on planners."""

from __future__ import annotations

import copy
import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, StepCounter, TransformedEnv

from torchrl_gn.data import sample_start_states
from torchrl_gn.envs import SceneEnv
from torchrl_gn.planners.ilqg import ILQGPlanner
from torchrl_gn.planners.ilqg_solver import ILQGSolver
from torchrl_gn.planners.linearize import RewardExpansion
from torchrl_gn.planners.plan_ahead import PlanAhead
from torchrl_gn.planners.plant import SimulatedPlant
from torchrl_gn.rewards import make_reward
from torchrl_gn.scenes import Scene, load_scene

from .. import zoo

SUBSTEPS, STEP, MASS = 4, 0.01, 2.0  # of zoo/point.xml
SPEED_WEIGHT, CONTROL_COST, HORIZON = 0.1, 0.02, 25


def quadratic(state, action, next_state, task):
    """Near a target [*B, 3] (the origin without one), slowly."""
    point = next_state[..., 1, :]
    off = point[..., :3] if task is None else point[..., :3] - task
    return -(off.square().sum(-1) + SPEED_WEIGHT * point[..., 7:10].square().sum(-1)).unsqueeze(-1)


def point_scene(limit: float) -> Scene:
    return zoo.load("point", ("-1 1", f"-{limit} {limit}"), timestep=SUBSTEPS * STEP)


def point_env(limit: float, reward=quadratic) -> SceneEnv:
    return SceneEnv(point_scene(limit), reward, num_threads=1, seed=0)


def point_planner(env: SceneEnv, iterations: int = 2, **options) -> ILQGPlanner:
    options = {"control_cost": CONTROL_COST, "seed": 0, **options}
    return ILQGPlanner(env, HORIZON, iterations, **options)


def physics_of(env: SceneEnv, *rows: list[float]) -> torch.Tensor:
    """Physics ``[n, S]`` of rows of positions and velocities."""
    physics = torch.from_numpy(sample_start_states(env.scene, len(rows), 0))
    physics[:, 1:] = torch.tensor(rows, dtype=torch.float64)
    return physics


def point_dynamics(limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact ``A`` and ``B`` of (x, y, vx, vy) in a control step; MuJoCo's Euler moves by the new velocity."""
    a, b = np.eye(4), np.zeros((4, 2))
    one = np.eye(4)
    one[:2, 2:] = STEP * np.eye(2)
    push = np.concatenate([STEP**2 * np.eye(2), STEP * np.eye(2)]) * limit / MASS
    for _ in range(SUBSTEPS):
        a, b = one @ a, one @ b + push
    return a, b


def riccati(limit: float, start: np.ndarray) -> np.ndarray:
    """Optimal controls ``[H, 2]``, in units of the limit, without regard to it."""
    a, b = point_dynamics(limit)
    weight = np.diag([1.0, 1.0, SPEED_WEIGHT, SPEED_WEIGHT])
    value, gains = np.zeros((4, 4)), []
    for _ in range(HORIZON):
        total = weight + value
        gain = np.linalg.solve(CONTROL_COST * np.eye(2) + b.T @ total @ b, b.T @ total @ a)
        value = a.T @ total @ (a - b @ gain)
        gains.append(gain)
    controls, state = [], start
    for gain in reversed(gains):
        controls.append(-gain @ state)
        state = a @ state + b @ controls[-1]
    return np.stack(controls)


def bounded_optimum(limit: float, start: np.ndarray) -> np.ndarray:
    """Optimal controls ``[H, 2]`` within -1 and 1, by bounded least squares."""
    a, b = point_dynamics(limit)
    root = np.sqrt([1.0, 1.0, SPEED_WEIGHT, SPEED_WEIGHT])[:, None]
    by_controls, state, rows, offsets = np.zeros((4, 2 * HORIZON)), start, [], []
    for t in range(HORIZON):
        by_controls, state = a @ by_controls, a @ state
        by_controls[:, 2 * t : 2 * t + 2] += b
        rows.append(root * by_controls)
        offsets.append(root[:, 0] * state)
    rows.append(np.sqrt(CONTROL_COST) * np.eye(2 * HORIZON))
    offsets.append(np.zeros(2 * HORIZON))
    found = lsq_linear(np.concatenate(rows), -np.concatenate(offsets), (-1, 1), tol=1e-15, method="bvls")
    return found.x.reshape(HORIZON, 2)


@pytest.mark.parametrize("central", [False, True])
def test_linear_quadratic_problem_reaches_the_riccati_optimum(central):
    limit, start = 100.0, [0.5, -0.3, 0.2, 0.4]
    env = point_env(limit)
    planner = point_planner(env, warm_up=8, central=central)
    plan = planner.plan(TensorDict({"physics": physics_of(env, start)}, [1]))[0].numpy() / limit
    wanted = riccati(limit, np.array(start))
    assert np.abs(wanted).max() < 0.9
    np.testing.assert_allclose(plan, wanted, atol=1e-7)


def test_limits_that_are_hit_equal_a_bounded_optimiser():
    limit, start = 2.0, [0.5, -0.3, 0.2, 0.4]
    env = point_env(limit)
    planner = point_planner(env, warm_up=10)
    plan = planner.plan(TensorDict({"physics": physics_of(env, start)}, [1]))[0].numpy() / limit
    wanted = bounded_optimum(limit, np.array(start))
    hit = np.abs(wanted) > 1 - 1e-9
    assert 0.2 < hit.mean() < 0.8
    np.testing.assert_allclose(plan, wanted, atol=1e-6)


@pytest.mark.slow
def test_swings_the_pendulum_up():
    scene = load_scene("pendulum")
    env = SceneEnv(scene, make_reward("balance", scene), num_threads=1, seed=0)
    planner = ILQGPlanner(env, 50, 1, seed=0)
    acted = TransformedEnv(env, planner.make_tensordict_primer())
    start = acted.reset(TensorDict({"physics": physics_of(env, [1.3, 0.0])[0]}), set_state=True)
    executed = acted.rollout(160, planner, tensordict=start, auto_reset=False)
    angle = -executed["next", "reward"].flatten()
    assert angle.max() > 2.5  # torque alone does not lift it: it must swing the other way first
    assert angle[-25:].max() < 0.1


@pytest.mark.slow
def test_rows_of_a_batch_are_planned_by_themselves():
    env = point_env(5.0)
    planner = point_planner(env)
    rng = torch.Generator().manual_seed(0)
    count = 6
    given = TensorDict(
        {
            "physics": physics_of(env, *torch.randn(count, 4, generator=rng).tolist()),
            "task": torch.randn(count, 3, generator=rng, dtype=torch.float64),
            "plan": {
                "actions": torch.randn(count, HORIZON, 2, generator=rng, dtype=torch.float64),
                "planned": torch.ones(count, 1, dtype=torch.bool),
            },
        },
        [count],
    )
    before = given.clone()
    together = planner(given.reshape(2, 3).clone())
    assert together["action"].shape == (2, 3, 2) and together["action"].dtype == torch.float32
    assert together["plan", "actions"].shape == (2, 3, HORIZON, 2)
    assert together["plan", "planned"].all()
    together = together.reshape(-1)
    for row in range(count):
        alone = planner(given[row].clone())
        for key in ("action", ("plan", "actions")):
            torch.testing.assert_close(together[row][key], alone[key], rtol=0, atol=1e-9)
    # A task that says nothing else than where to go: the plans go there.
    assert together["action"].std(0).min() > 0.1
    assert (given == before).all()


def test_plan_is_shifted_and_improved():
    env = point_env(5.0)
    planner = point_planner(env, warm_up=6)
    first = planner(env.reset())
    plan = point_planner(env, warm_up=6).plan(first.exclude("action", "plan"))
    torch.testing.assert_close(first["plan", "actions"][-1], first["plan", "actions"][-2])
    torch.testing.assert_close(first["action"].double(), plan[0], rtol=0, atol=1e-3)
    torch.testing.assert_close(first["plan", "actions"][:-1], plan[1:], rtol=0, atol=1e-3)


def test_same_seed_same_actions():
    env = point_env(5.0)
    start = env.reset()
    first, same, other = (point_planner(env, 1, warm_up=0, seed=seed)(start.clone())["action"] for seed in (1, 1, 2))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_beats_the_random_sequences_it_starts_from_on_contacts():
    scene = load_scene("cheetah")
    node = scene.node_names.index("torso")

    def forward(state, action, next_state, task):
        return next_state[..., node, 7:8]

    env = SceneEnv(scene, forward, num_threads=1, seed=0)
    start = env.reset()
    returns = []
    for warm_up in (0, 10):
        plan = ILQGPlanner(env, 20, 1, warm_up, seed=0).plan(start)
        assert (plan.abs() <= 1).all()
        simulated = env.simulator.rollout(start["physics"], plan)
        returns.append(float(simulated["state"][1:, node, 7].sum()))
    assert returns[1] > returns[0] + 5


def test_primer_and_collector():
    scene = load_scene("pendulum")
    env = SceneEnv(scene, make_reward("balance", scene), num_threads=1, seed=0)
    planner = ILQGPlanner(env, 8, 1, 2, seed=0)
    acted = TransformedEnv(env, Compose(StepCounter(max_steps=5), planner.make_tensordict_primer()))
    known, plan = [], planner.plan

    def watched(tensordict):
        known.append(bool(tensordict["plan", "planned"]))
        return plan(tensordict)

    planner.plan = watched
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        executed = acted.rollout(5, planner)
        assert known == [False] + [True] * 4
        known.clear()
        collector = Collector(
            acted, planner, frames_per_batch=12, total_frames=12, auto_register_policy_transforms=False
        )
        data = next(iter(collector))
        collector.shutdown()
    assert executed["plan", "actions"].shape == (5, 8, 1)
    assert data["action"].shape == (12, 1)
    # Before it begins, the collector tries the policy once.
    assert known[-12:] == ([False] + [True] * 4) * 2 + [False, True]


@pytest.mark.slow
def test_without_a_primer_the_plan_goes_on():
    env = point_env(5.0)
    planner = point_planner(env, 1, warm_up=5)
    rewards = env.rollout(HORIZON, planner)["next", "reward"]
    assert rewards[-1] > -1e-3 and rewards[-1] >= rewards[0]


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_works_without_gradients(mode):
    env = point_env(5.0)
    physics, task = physics_of(env, [0.5, 0.1, 0, 0]), torch.ones(1, 3, dtype=torch.float64)
    wanted = point_planner(env)(TensorDict({"physics": physics, "task": task}, [1]))
    with mode():
        given = TensorDict({"physics": physics + 0, "task": task + 0}, [1])
        found = point_planner(env)(given)
    assert torch.equal(found["action"], wanted["action"])
    assert not wanted["plan", "actions"].requires_grad


@pytest.mark.slow
def test_task_may_be_a_tensordict():
    def reward(state, action, next_state, task):
        return quadratic(state, action, next_state, task["target"])

    target = torch.tensor([[1.0, 0, 0], [0, -1.0, 0]], dtype=torch.float64)
    physics = physics_of(point_env(5.0), [0.0] * 4, [0.0] * 4)
    wanted = point_planner(point_env(5.0))(TensorDict({"physics": physics, "task": target}, [2]))
    given = TensorDict({"physics": physics, "task": TensorDict({"target": target}, [2])}, [2])
    assert torch.equal(point_planner(point_env(5.0, reward))(given)["action"], wanted["action"])


def test_controls_are_costly():
    env = point_env(5.0)
    start = TensorDict({"physics": physics_of(env, [0.5, 0, 0, 0])}, [1])
    cheap, dear = (point_planner(env, control_cost=cost).plan(start) for cost in (1e-3, 10.0))
    assert dear.abs().max() < 0.1 * cheap.abs().max()


def test_output_tensordict():
    env = point_env(5.0)
    given, out = env.reset(), TensorDict()
    assert point_planner(env)(given, out) is out
    assert set(out.keys(True, True)) == {"action", *(("plan", name) for name in ("actions", "planned", "time"))}
    assert "action" not in given and "next" not in given
    with pytest.raises(ValueError, match="ILQGPlanner takes no steps"):
        point_planner(env)(given, steps=3)


def test_unstable_states_keep_their_plan_and_warn_once():
    scene = load_scene("pendulum")
    env = SceneEnv(scene, make_reward("balance", scene), num_threads=1)
    planner = ILQGPlanner(env, 5, 1, seed=0)
    physics = physics_of(env, [1.0, 0.0], [1.0, 0.99e10])
    actions = torch.linspace(-0.9, 0.9, 10, dtype=torch.float64).reshape(2, 5, 1)
    plan = {"actions": actions.clone(), "planned": torch.ones(2, 1, dtype=torch.bool)}
    given = TensorDict({"physics": physics, "plan": plan}, [2])
    physics[1, 1:] = torch.tensor([1e10, 1e10])
    with pytest.warns(
        RuntimeWarning, match="unstable under all actions.* last plan, or rest if they have none"
    ) as caught:
        planned = planner.plan(given)
        planner.plan(given)
        rest = planner.plan(given.exclude("plan"))
    assert len(caught) == 1
    assert torch.equal(planned[1], actions[1])
    assert not torch.equal(planned[0], actions[0])
    assert (rest[1] == 0).all()


def test_a_reward_that_is_no_number_keeps_the_plan():
    def reward(state, action, next_state, task):
        return quadratic(state, action, next_state, None) * float("nan")

    env = point_env(5.0, reward)
    plan = {"actions": torch.ones(HORIZON, 2, dtype=torch.float64), "planned": torch.ones(1, dtype=torch.bool)}
    with pytest.warns(RuntimeWarning, match="not finite"):
        planned = point_planner(env).plan(env.reset().set("plan", TensorDict(plan)))
    assert torch.equal(planned, plan["actions"])


def test_a_gradient_that_is_no_number_keeps_the_plan():
    def reward(state, action, next_state, task):
        return quadratic(state, action, next_state, None) + 0 * (0 * next_state[..., 1, :1]).sqrt()

    env = point_env(5.0, reward)
    plan = {"actions": torch.ones(HORIZON, 2, dtype=torch.float64), "planned": torch.ones(1, dtype=torch.bool)}
    planned = point_planner(env).plan(env.reset().set("plan", TensorDict(plan)))
    assert torch.equal(planned, plan["actions"])


def solver_of(reward) -> tuple[ILQGSolver, SceneEnv]:
    env = point_env(2.0, reward)
    expansion = RewardExpansion(reward, None, env.device)
    return ILQGSolver(SimulatedPlant(env.simulator), expansion, control_cost=0.0), env


def test_a_reward_that_curves_upwards_has_its_curvature_cut():
    """Else the backward pass would look for a maximum."""
    solver, env = solver_of(lambda state, action, next_state, task: -quadratic(state, action, next_state, task))
    start = solver.follow(physics_of(env, [0.5, -0.3, 0.2, 0.4])[0].numpy(), np.zeros((1, 5, 2)))
    assert solver.improve(start, 3).cost < start.cost
    hessian = solver.expand(start)[1].hessian
    assert np.linalg.eigvalsh(hessian).min() > -1e-9 and np.abs(hessian).max() < 1e-9
    mixed, _ = solver_of(lambda *step: step[1][..., :1].square() - 3 * step[1][..., 1:].square())
    assert np.diag(mixed.expand(start)[1].hessian[0])[-2:] == pytest.approx([0, 6 * 2.0**2])  # by half the range


def test_where_every_step_is_too_long_shorter_ones_are_tried():
    """The only way down is 0.003 long, which no damping of the first iteration finds."""

    def reward(state, action, next_state, task):
        along = action[..., :1] / 2.0
        return torch.exp(-(((along - 0.003) / 0.002) ** 2)) - 50 * along.abs()

    solver, env = solver_of(reward)
    start = solver.follow(physics_of(env, [0.0] * 4)[0].numpy(), np.full((1, 1, 2), 1e-6))
    assert solver.improve(start, 1).cost == start.cost
    assert solver.improve(start, 3).cost < start.cost - 0.1


@pytest.mark.slow
def test_copies_and_pickles_plan_alike():
    env = point_env(5.0)
    planner = point_planner(env, num_threads=1)
    start = env.reset()
    planner(start.clone())
    copies = [copy.deepcopy(planner), pickle.loads(pickle.dumps(planner))]
    wanted = planner(start.clone())["action"]
    for other in copies:
        assert torch.equal(other(start.clone())["action"], wanted)


def test_equal_bounds_fix_an_action():
    free, fixed = point_env(2.0), point_env(2.0)
    low, high = free.scene.action_low, free.scene.action_high
    scene = replace(fixed.scene, action_low=np.array([low[0], 0.5]), action_high=np.array([high[0], 0.5]))
    fixed = SceneEnv(scene, quadratic, num_threads=1, seed=0)
    given = TensorDict({"physics": physics_of(free, [0.5, -0.3, 0.2, 0.4])}, [1])
    wanted, found = (point_planner(env, warm_up=10).plan(given)[0] for env in (free, fixed))
    assert (found[:, 1] == 0.5).all()
    torch.testing.assert_close(found[:, 0], wanted[:, 0], rtol=0, atol=1e-5)  # the two directions do not mix


def test_refuses_what_it_cannot_plan():
    env = point_env(5.0)
    refused = (("horizon", 0), ("horizon", 2.5), ("iterations", 0), ("iterations", 1.0), ("warm_up", -1))
    for name, value in (*refused, ("warm_up", 0.5), ("control_cost", -1.0), ("num_threads", 0), ("num_threads", 1.5)):
        with pytest.raises(ValueError, match=rf"{name}=\S+ must be"):
            ILQGPlanner(env, **{"horizon": 3, name: value})
    with pytest.raises(TypeError, match="a ModelEnv, got TransformedEnv"):
        ILQGPlanner(TransformedEnv(env), 3)  # pyright: ignore
    with pytest.raises(ValueError, match="no reward"):
        ILQGPlanner(SceneEnv(env.scene), 3)
    with pytest.raises(ValueError, match="no actions"):
        ILQGPlanner(SceneEnv(zoo.load("falling"), quadratic), 3)
    unlimited = SceneEnv(env.scene, quadratic)
    unlimited.scene = replace(env.scene, action_high=np.array([np.inf, 1.0]))
    with pytest.raises(ValueError, match="without bounds"):
        ILQGPlanner(unlimited, 3)
    unlimited.scene = replace(env.scene, action_low=np.array([-1.0, 6.0]))
    with pytest.raises(ValueError, match="action 1 between 6 and 5"):
        ILQGPlanner(unlimited, 3)
    planner = ILQGPlanner(env, 3, 1)
    start = env.reset()
    with pytest.raises(KeyError, match="'physics'"):
        planner(start.exclude("physics"))
    with pytest.raises(ValueError, match="'physics' must be"):
        planner(start.clone().set("physics", torch.zeros(2)))
    with pytest.raises(ValueError, match="finite"):
        planner(start.clone().set("physics", torch.full((env.scene.physics_size,), torch.nan, dtype=torch.float64)))
    with pytest.raises(ValueError, match="comes from another planner"):
        planner(start.clone().set("plan", TensorDict(actions=torch.zeros(4, 2), planned=torch.ones(1).bool())))
    env.reward = lambda state, action, next_state, task: torch.zeros(*action.shape[:-1], 1)
    with pytest.raises(ValueError, match="autograd can differentiate"):
        planner(start.clone())
    env.reward = lambda state, action, next_state, task: next_state[..., 1, 0]
    with pytest.raises(ValueError, match="the reward must be"):
        planner(start.clone())


@pytest.mark.parametrize("delay", [0, 2])
def test_environments_of_another_control_step_are_refused(delay):
    """A plan shifts by one action a call, so 20 ms of a plan would be played for 40 ms."""

    def env(timestep: float) -> SceneEnv:
        scene = load_scene("pendulum", timestep=timestep)
        return SceneEnv(scene, make_reward("balance", scene), seed=0)

    made = ILQGPlanner(env(0.02), horizon=5, iterations=1, warm_up=1, seed=0)
    planner = PlanAhead(made, delay) if delay else made
    played = env(0.02).append_transform(planner.make_tensordict_primer()).rollout(4, planner)
    torch.testing.assert_close(played["physics"][:, :1].diff(dim=0), torch.full((3, 1), 0.02, dtype=torch.float64))
    for primed in (False, True):
        other = env(0.04)
        real = other.append_transform(planner.make_tensordict_primer()) if primed else other
        with pytest.raises(ValueError, match="40 ms have passed .* takes 20 ms"):
            real.rollout(4, planner)


def test_plans_of_repeated_and_earlier_times_go_on():
    """Samples that have ended repeat their last step; a start may be set back."""
    env = point_env(1.0)
    planner = point_planner(env, iterations=1)
    now = planner(TensorDict({"physics": physics_of(env, [0.5, 0, 0, 0])}, [1]))
    assert planner(now.clone())["plan", "time"].item() == now["physics"][0, 0].item()
    now["physics"][:, 0] = -3.0
    assert planner(now)["plan", "time"].item() == -3.0
