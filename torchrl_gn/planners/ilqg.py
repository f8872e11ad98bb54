"""Control-limited iLQG on the true physics, receding horizon (paper, SM "Baseline Mujoco-based planner")."""

from __future__ import annotations

import math
import warnings
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
from torchrl_gn.planners.plan import (
    KEY,
    RecedingHorizonPlanner,
    check_count,
    check_plannable,
    plan_left,
    plan_primer,
    read_plan,
)
from torchrl_gn.planners.reward_expansion import RewardExpansion

_STARTS = 16  # random sequences of which a first plan starts from the best


class ILQGPlanner(RecedingHorizonPlanner):
    """Plan with the true MuJoCo physics, by control-limited differential dynamic programming.

    At every control step the planned actions are improved by some iterations of iLQG (Tassa, Mansard
    and Todorov 2014; see :class:`~torchrl_gn.planners.ilqg_solver.ILQGSolver`) so as to maximise the sum
    of ``env.reward`` over the horizon, less a cost of the controls. The first action is taken and the
    rest is where the next control step begins.

    The planner keeps no plan itself: the plan is the TensorDict's entry ``plan``, and where it is missing a
    plan begins anew. Where episodes end and begin anew inside one rollout (a collector), append
    :meth:`make_tensordict_primer` to the environment, which clears the plan.

    The rows of a batch are planned one by one, each from its own state and task, in float64. The reward
    is differentiated by autograd, which is opened inside: it works under ``torch.no_grad`` and
    ``torch.inference_mode``. No gradient flows through the planner.

    Entries:
        - reads ``physics`` ``[*B, S]`` float64, ``task`` where there is one, and ``plan``.
        - writes ``action`` ``[*B, A]`` and ``plan``, of ``actions`` ``[*B, H, A]`` float64, those that are left
          with the last one repeated, and ``planned`` ``[*B, 1]`` bool.

    A state from which no sequence can be simulated keeps its last plan (the actuators' rest if it has none),
    with a warning, the first time.

    Args:
        env: the true physics, with a reward: any differentiable ``(state, action, next_state, task) -> [*B, 1]``.
        horizon: control steps ``H`` to plan ahead.
        iterations: of iLQG at every control step.
        warm_up: iterations where nothing was planned yet, from the best of some random smooth
            sequences. Default: ten times ``iterations``.
        control_cost: cost per control and step of a control at its bound; quadratic, and zero in the
            middle of its range. To be small beside the rewards of a step.
        central: differentiate the physics by central differences: about 1.5 times the time for the same plans,
            where we measured.
        seed: seed of the random sequences. Default: drawn from torch's global generator.
        num_threads: threads of the simulation. Default: the environment's.

    Raises:
        TypeError: ``env`` is no :class:`~torchrl_gn.envs.SceneEnv`.
        ValueError: ``env`` has no reward, no actions or unlimited ones, or an option is out of its range; when
            planning, physics of a wrong shape or not finite, a plan of another shape, or a reward that
            autograd cannot differentiate.
        KeyError: when planning, no ``physics``.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_gn.rewards import make_reward
        >>> from torchrl_gn.scenes import load_scene
        >>> scene = load_scene("pendulum")
        >>> env = SceneEnv(scene, make_reward("balance", scene), seed=0)
        >>> planner = ILQGPlanner(env, horizon=10, iterations=1, seed=0)
        >>> acted = TransformedEnv(env, planner.make_tensordict_primer())
        >>> acted.rollout(3, planner)["action"].shape
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
                f"ILQGPlanner plans with the true physics of a SceneEnv, got {type(env).__name__};"
                " of a transformed environment give its base_env."
            )
        warm_up = 10 * iterations if warm_up is None else warm_up
        threads = 1 if num_threads is None else num_threads
        check_plannable(env, horizon=horizon, iterations=iterations, num_threads=threads)
        check_count("warm_up", warm_up, 0)
        if not 0 <= control_cost < math.inf:
            raise ValueError(f"control_cost must be finite and not negative, got {control_cost}")
        super().__init__(env)
        self.horizon, self.iterations, self.warm_up = horizon, iterations, warm_up
        self.control_cost, self.central, self.num_threads = control_cost, central, num_threads
        self._rng = numpy_generator(seed)
        self._simulators: dict[int, Simulator] = {}
        self._warned = False

    def simulator(self, variant: int = 0) -> Simulator:
        """The simulation to plan with of one of the environment's scenes."""
        env = self._scene_env
        if self.num_threads is None and len(env.scenes) == 1:
            return env.simulator
        if variant not in self._simulators:
            threads = env.num_threads if self.num_threads is None else self.num_threads
            self._simulators[variant] = Simulator(env.scenes[variant], threads)
        return self._simulators[variant]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that clears plans when episodes begin."""
        return plan_primer(self._plan_shape, torch.float64, self._scene_env.device)

    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        """The actions ``[*B, A]`` to take now, and what is left of the plan."""
        actions = self.plan(tensordict)
        return actions[..., 0, :].to(self.action_spec.dtype), {KEY: plan_left(tensordict.shape, actions)}

    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Sequences of actions ``[*B, H, A]``, float64, from the states of a TensorDict ``[*B]``; see the class."""
        env = self._scene_env
        size = env.scene.physics_size
        physics = cast("Tensor | None", tensordict.get("physics", None))
        if physics is None:
            raise KeyError("ILQGPlanner needs an entry 'physics', the full MuJoCo state, as a SceneEnv gives.")
        if physics.shape != (*tensordict.shape, size):
            raise ValueError(f"'physics' must be {[*tensordict.shape, size]}, got {list(physics.shape)}")
        actions, planned = read_plan(tensordict, self._plan_shape, torch.float64)
        task = cast(Any, tensordict.get("task", None))
        states = physics.detach().reshape(-1, size).cpu().numpy()
        plans = actions.detach().reshape(-1, *self._plan_shape).cpu().numpy().copy()
        known = planned.reshape(-1).tolist()
        # With the batch as one dimension, whatever stands behind it in a task.
        tasks = None if task is None else _flat(task, len(tensordict.shape))
        variant = env.variant_of(tensordict)
        which = [0] * len(states) if variant is None else variant.flatten().tolist()
        for row, state in enumerate(states):
            plan = plans[row] if known[row] else None
            task = None if tasks is None else tasks[row]
            plans[row] = self._plan_row(self.simulator(which[row]), state, plan, task)
        return torch.from_numpy(plans).reshape(actions.shape).to(actions.device)

    def _plan_row(self, simulator: Simulator, physics: np.ndarray, plan: np.ndarray | None, task: Any) -> np.ndarray:
        """The improved plan ``[H, A]`` of one state."""
        env = self._scene_env
        reward = RewardExpansion(cast(Any, env.reward), task, env.device)
        solver = ILQGSolver(simulator, reward, control_cost=self.control_cost, central=self.central)
        iterations = self.warm_up if plan is None else self.iterations
        if plan is not None:
            start = solver.simulate(physics, solver.controls(plan)[None])
            if math.isfinite(start.cost):
                return solver.actions(solver.improve(start, iterations).controls)
        rest = solver.controls(np.zeros(self._plan_shape))[None]
        random = solver.controls(spline_controls(env.scene, _STARTS, self.horizon, self._rng))
        start = solver.simulate(physics, random)
        if not math.isfinite(start.cost):
            start = solver.simulate(physics, rest)
        if not math.isfinite(start.cost):
            self._warn()
            return solver.actions(rest[0]) if plan is None else plan
        return solver.actions(solver.improve(start, iterations).controls)

    def _warn(self) -> None:
        if self._warned:
            return
        self._warned = True
        warnings.warn(
            f"ILQGPlanner found no sequence of {self.horizon} actions for {self._scene_env.scene.name!r} that can be"
            " simulated from a given state with a finite reward: the simulation becomes unstable whatever is done, or"
            " the reward is not finite. Such states keep their last plan, or rest if they have none. A smaller physics"
            " step in the model may help. (Said once.)",
            RuntimeWarning,
            stacklevel=2,
        )

    @property
    def _scene_env(self) -> SceneEnv:
        return cast(SceneEnv, self.env)

    @property
    def _plan_shape(self) -> tuple[int, int]:
        return (self.horizon, self._scene_env.scene.num_actions)

    def __getstate__(self) -> dict:
        # Copies and worker processes start threads and MuJoCo data of their own.
        return {**super().__getstate__(), "_simulators": {}}


def _flat(task: Any, dims: int) -> Any:
    """A task ``[*B, ...]``, tensor or TensorDict, as ``[prod(B), ...]``."""
    if isinstance(task, TensorDictBase):
        task = task.copy()
        task.batch_size = task.batch_size[:dims]
        return task.reshape(-1)
    return task.reshape(-1, *task.shape[dims:])
