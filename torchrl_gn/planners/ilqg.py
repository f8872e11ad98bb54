"""Receding-horizon, control-limited iLQG on the true physics (paper, SM "Baseline Mujoco-based planner")."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from torchrl_gn.data.controls import numpy_generator, spline_controls
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.envs.scene_env import SceneEnv
from torchrl_gn.planners.ilqg_solver import ILQGSolver
from torchrl_gn.planners.linearize import RewardExpansion
from torchrl_gn.planners.plan import KEY, RecedingHorizonPlanner, check_plannable, plan_primer, read_plan, shift_plan

_INITIAL_SAMPLES = 16  # random sequences; a first plan starts from the best


class ILQGPlanner(RecedingHorizonPlanner):
    """Plan on the true MuJoCo physics by control-limited iLQG (Tassa, Mansard and Todorov 2014).

    Every control step improves the planned actions by a few iterations, to maximise the sum of ``env.reward`` minus a
    control cost. The first action is executed; the rest warm-starts the next plan. Where episodes auto-reset, append
    :meth:`make_tensordict_primer` to the environment. Rows of a batch are planned one by one, in float64, without
    gradients. A state without any stable sequence keeps its last plan, or zero actions, with a warning.

    Reads ``physics`` ``[*B, S]`` float64, and ``task`` and ``plan`` if present; writes ``action`` ``[*B, A]`` and
    ``plan``: remaining ``actions`` ``[*B, H, A]`` float64 and ``planned`` ``[*B, 1]`` bool.

    Args:
        env: the true physics, with a differentiable reward ``(state, action, next_state, task) -> [*B, 1]``.
        horizon: control steps ``H`` to plan ahead.
        warm_up: iterations of a first plan, from the best of some random sequences. Default: ten times ``iterations``.
        control_cost: quadratic cost per control and step, of a control at its bound; keep it below a step's reward.
        central: central differences of the physics: 1.5 times the time, equal plans where measured.
        seed: default: drawn from torch's global generator.

    Raises:
        TypeError: ``env`` is no :class:`~torchrl_gn.envs.SceneEnv`.
        ValueError: reward, actions or bounds are missing, an option is out of range, or an entry does not fit.

    Example:
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("pendulum")
        >>> planner = ILQGPlanner(SceneEnv(scene, make_reward("balance", scene), seed=0), horizon=10, iterations=1)
        >>> planner.env.rollout(3, planner)["action"].shape
        torch.Size([3, 1])
    """

    def __init__(
        self,
        env: SceneEnv,
        horizon: int,
        iterations: int = 3,
        warm_up: int | None = None,
        *,
        control_cost: float = 1e-5,
        central: bool = False,
        seed: int | None = None,
        num_threads: int | None = None,
    ):
        if not isinstance(env, SceneEnv):
            raise TypeError(
                f"ILQGPlanner needs the true physics of a SceneEnv, got {type(env).__name__}; for a transformed"
                " environment give its base_env."
            )
        threads = 1 if num_threads is None else num_threads
        check_plannable(env, warm_up, horizon=horizon, iterations=iterations, num_threads=threads)
        if not 0 <= control_cost < math.inf:
            raise ValueError(f"control_cost must be finite and not negative, got {control_cost}")
        super().__init__(env)
        self.horizon, self.iterations = horizon, iterations
        self.warm_up = 10 * iterations if warm_up is None else warm_up
        self.control_cost, self.central, self.num_threads = control_cost, central, num_threads
        self._rng = numpy_generator(seed)
        self._simulators: dict[int, Simulator] = {}
        self._warned = False

    def simulator(self, variant: int = 0) -> Simulator:
        """Simulator of one of the environment's scenes."""
        env = self._scene_env
        if self.num_threads is None and len(env.scenes) == 1:
            return env.simulator
        if variant not in self._simulators:
            threads = env.num_threads if self.num_threads is None else self.num_threads
            self._simulators[variant] = Simulator(env.scenes[variant], threads)
        return self._simulators[variant]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Transform for the environment that resets the plan when an episode begins."""
        return plan_primer(self._plan_shape, torch.float64, self._scene_env.device)

    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        actions = self.plan(tensordict)
        return actions[..., 0, :].to(self.action_spec.dtype), {KEY: shift_plan(tensordict.shape, actions)}

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Planned actions ``[*B, H, A]``, float64, from the states of a TensorDict ``[*B]``."""
        env = self._scene_env
        size = env.scene.physics_size
        physics = cast("Tensor | None", tensordict.get("physics", None))
        if physics is None:
            raise KeyError("ILQGPlanner needs an entry 'physics', the full MuJoCo state, as a SceneEnv writes.")
        if physics.shape != (*tensordict.shape, size):
            raise ValueError(f"'physics' must be {[*tensordict.shape, size]}, got {list(physics.shape)}")
        actions, planned = read_plan(tensordict, self._plan_shape, torch.float64)
        task = cast(Any, tensordict.get("task", None))
        states = physics.detach().reshape(-1, size).cpu().numpy()
        plans = actions.detach().reshape(-1, *self._plan_shape).cpu().numpy().copy()
        resumed = planned.reshape(-1).tolist()
        tasks = None if task is None else _flat(task, len(tensordict.shape))
        variant = env.variant_of(tensordict)
        variants = [0] * len(states) if variant is None else variant.flatten().tolist()
        for row, state in enumerate(states):
            plan = plans[row] if resumed[row] else None
            task = None if tasks is None else tasks[row]
            plans[row] = self._plan_row(self.simulator(variants[row]), state, plan, task)
        return torch.from_numpy(plans).reshape(actions.shape).to(actions.device)

    def _plan_row(self, simulator: Simulator, physics: np.ndarray, plan: np.ndarray | None, task: Any) -> np.ndarray:
        env = self._scene_env
        reward = RewardExpansion(cast(Any, env.reward), task, env.device)
        solver = ILQGSolver(simulator, reward, control_cost=self.control_cost, central=self.central)
        iterations = self.warm_up if plan is None else self.iterations
        rest = np.zeros((1, *self._plan_shape))
        attempts: list[Callable[[], np.ndarray]] = [] if plan is None else [lambda: plan[None]]
        attempts += [lambda: spline_controls(env.scene, _INITIAL_SAMPLES, self.horizon, self._rng), lambda: rest]
        for sequences in attempts:
            start = solver.simulate(physics, solver.controls(sequences()))
            if math.isfinite(start.cost):
                return solver.actions(solver.improve(start, iterations).controls)
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"ILQGPlanner found no sequence of {self.horizon} actions for {env.scene.name!r} that can be simulated"
                " with a finite reward: the simulation becomes unstable whatever is done, or the reward is not finite."
                " Such states keep their last plan, or rest if they have none. Try a smaller physics step in the model."
                " (Warned once.)",
                RuntimeWarning,
                stacklevel=2,
            )
        return solver.actions(solver.controls(rest[0])) if plan is None else plan

    @property
    def _scene_env(self) -> SceneEnv:
        return cast(SceneEnv, self.env)

    @property
    def _plan_shape(self) -> tuple[int, int]:
        return (self.horizon, self._scene_env.scene.num_actions)

    def __getstate__(self) -> dict:
        # Copies and worker processes start their own threads and MuJoCo data.
        return {**super().__getstate__(), "_simulators": {}}


def _flat(task: Any, dims: int) -> Any:
    """Flatten a task ``[*B, ...]``, tensor or TensorDict, to ``[prod(B), ...]``."""
    if isinstance(task, TensorDictBase):
        task = task.copy()
        task.batch_size = task.batch_size[:dims]
        return task.reshape(-1)
    return task.reshape(-1, *task.shape[dims:])
