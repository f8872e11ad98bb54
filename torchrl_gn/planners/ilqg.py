"""Receding-horizon, control-limited iLQG, on the true physics or through a learned model."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from torchrl_gn.data.controls import numpy_generator, spline_controls
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.envs.episode_ends import counted_steps, ended_steps
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.envs.scene_env import SceneEnv
from torchrl_gn.envs.terminal import plan_rewards
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.frozen_weights import frozen
from torchrl_gn.planners.ilqg_solver import CountedSteps, ILQGSolver
from torchrl_gn.planners.linearize import RewardExpansion
from torchrl_gn.planners.plan import (
    KEY,
    RecedingHorizonPlanner,
    check_plannable,
    flat_rows,
    plan_primer,
    read_plan,
    shift_plan,
)
from torchrl_gn.planners.plant import LearnedPlant, Plant, SimulatedPlant
from torchrl_gn.planners.proposal import check_every_step, check_proposal, propose

_INITIAL_SAMPLES = 16  # random sequences; a first plan starts from the best


class ILQGPlanner(RecedingHorizonPlanner):
    """Planner by control-limited iLQG (Tassa, Mansard and Todorov 2014).

    It plans on the true physics of a :class:`~torchrl_gn.envs.SceneEnv`, linearised by finite differences, as the
    paper's baseline does (SM "Baseline Mujoco-based planner"). Or it plans through the learned model of a
    :class:`~torchrl_gn.envs.ModelEnv`, linearised by autograd: this is iLQR, a second-order method, while
    :class:`~torchrl_gn.planners.GradientPlanner` is first-order.

    Every control step improves the planned actions by a few iterations, to maximise the sum of ``env.reward`` minus a
    control cost, until the environment's ``done``. The first action is executed; the rest warm-starts the next plan.
    If episodes auto-reset, append :meth:`make_tensordict_primer` to the environment. Rows of a batch are planned one
    by one, in float64, without gradients. A state without any stable sequence keeps its last plan, or else gets the
    scene's rest action, with a warning.

    Reads ``physics`` ``[*B, S]`` float64 (with a model ``state`` ``[*B, N, 13]``), and ``task`` and ``plan`` if
    present; writes ``action`` ``[*B, A]`` and ``plan``: remaining ``actions`` ``[*B, H, A]`` float64, ``planned``
    ``[*B, 1]`` bool, and the ``time`` ``[*B, 1]`` of ``physics``.

    Args:
        env: environment of the true physics or a model, with a differentiable reward
            ``(state, action, next_state, task) -> [*B, 1]``. A specialised model plans many times faster. The planner
            refuses models that carry entries from step to step or read parameters of each sample.
        horizon: control steps ``H`` to plan ahead.
        warm_up: iterations of an episode's first plan, which starts from the best of some random sequences. Default:
            ten times ``iterations``.
        control_cost: quadratic cost per control and step, of a control at its bound; keep it below a step's reward.
        central: use central differences of the physics; takes 1.5 times as long, and gave equal plans where measured.
        proposal: policy; its actions in ``env`` are one of the sequences that a first plan starts from.
        propose_every_step: also propose at later control steps, which start from the better of proposal and last plan.
        seed: seed of the random sequences. Default: drawn from torch's global generator.

    Raises:
        TypeError: ``env`` is neither environment, or its model is not a predictor.
        ValueError: reward, actions or bounds are missing, an option is out of range, or an entry does not fit; when
            planning, the time in ``physics`` is not one control step after the last plan.

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
        env: SceneEnv | ModelEnv,
        horizon: int,
        iterations: int = 3,
        warm_up: int | None = None,
        *,
        control_cost: float = 1e-5,
        central: bool = False,
        proposal: TensorDictModuleBase | None = None,
        propose_every_step: bool = False,
        seed: int | None = None,
        num_threads: int | None = None,
    ):
        if not isinstance(env, (SceneEnv, ModelEnv)):
            raise TypeError(
                f"ILQGPlanner needs a SceneEnv or a ModelEnv, got {type(env).__name__}; for a transformed environment"
                " give its base_env."
            )
        if isinstance(env, ModelEnv):
            predictor = env.predictor
            if not isinstance(predictor, Predictor):
                raise TypeError(f"ILQGPlanner needs a Predictor as model, got {type(env.world_model).__name__}.")
            if further := [*env.carried_keys, *filter(None, [predictor.parameters_key])]:
                raise ValueError(
                    f"ILQGPlanner plans through models of state and action alone; {env} also reads {further}: use"
                    " GradientPlanner."
                )
            if env.action_repeat > 1:
                raise ValueError(
                    "ILQGPlanner plans single steps of a model, this environment repeats actions: use GradientPlanner,"
                    " or action_repeat=1."
                )
        threads = 1 if num_threads is None else num_threads
        check_plannable(env, warm_up, horizon=horizon, iterations=iterations, num_threads=threads)
        if not 0 <= control_cost < math.inf:
            raise ValueError(f"control_cost={control_cost} must be finite and not negative.")
        check_proposal(proposal, env)
        check_every_step(proposal, propose_every_step)
        super().__init__(env)
        self.proposal, self.propose_every_step = proposal, propose_every_step
        self.horizon, self.iterations = horizon, iterations
        self.warm_up = 10 * iterations if warm_up is None else warm_up
        self.control_cost, self.central, self.num_threads = control_cost, central, num_threads
        self.set_seed(seed)
        self._plants: dict[int, Plant] = {}
        self._warned = False

    def set_seed(self, seed: int | None) -> None:
        """Reseed the random sequences; None draws the seed from torch's global generator."""
        self._rng = numpy_generator(seed)

    def plant(self, variant: int = 0) -> Plant:
        """Return the plant to plan on: the true physics of a variant, or the learned model."""
        env = self._env
        if isinstance(env, ModelEnv):
            plant, predictor = self._plants.get(0), cast(Predictor, env.predictor)
            # The environment may have moved, or have another model.
            if not isinstance(plant, LearnedPlant) or (plant.predictor, plant.device) != (predictor, env.device):
                plant = self._plants[0] = LearnedPlant(predictor, env.device)
            return plant
        if variant not in self._plants:
            if self.num_threads is None and len(env.scenes) == 1:
                self._plants[variant] = SimulatedPlant(env.simulator, central=self.central)
            else:
                threads = env.num_threads if self.num_threads is None else self.num_threads
                simulator = Simulator(env.scenes[variant], threads)
                self._plants[variant] = SimulatedPlant(simulator, central=self.central)
        return self._plants[variant]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform for the environment that resets the plan when an episode begins."""
        return plan_primer(self._plan_shape, torch.float64, self._env.device)

    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        actions = self.plan(tensordict)
        return actions[..., 0, :].to(self.action_spec.dtype), {KEY: shift_plan(tensordict, actions)}

    @without_autocast
    def plan(self, tensordict: TensorDictBase) -> Tensor:
        """Plan actions ``[*B, H, A]``, float64, from the states of a TensorDict ``[*B]``."""
        env = self._env
        starts = self._starts(tensordict)
        actions, planned = read_plan(tensordict, self._plan_shape, torch.float64, env.scene.timestep)
        task = cast(Any, tensordict.get("task", None))
        task = None if task is None else task.to(env.device)
        plans = actions.detach().reshape(-1, *self._plan_shape).cpu().numpy().copy()
        resumed = planned.reshape(-1).tolist()
        tasks = None if task is None else _flat(task, len(tensordict.shape))
        variant = env.variant_of(tensordict) if isinstance(env, SceneEnv) else None
        variants = [0] * len(starts) if variant is None else variant.flatten().tolist()
        proposed: list[np.ndarray | None] = [None] * len(starts)
        if self.proposal is not None and (self.propose_every_step or not all(resumed)):
            flat = flat_rows(tensordict.exclude("next", "action", KEY).detach()).to(env.device)
            proposed = list(propose(self.proposal, env, flat, self.horizon).double().cpu().numpy())
        with frozen(env) if isinstance(env, ModelEnv) else contextlib.nullcontext():
            for row, start in enumerate(starts):
                plan = plans[row] if resumed[row] else None
                task = None if tasks is None else tasks[row]
                plans[row] = self._plan_row(self.plant(variants[row]), start, plan, task, proposed[row])
        return torch.from_numpy(plans).reshape(actions.shape).to(actions.device)

    def _starts(self, tensordict: TensorDictBase) -> np.ndarray:
        """Return the plants' start states ``[prod(B), S]``."""
        env = self._env
        if isinstance(env, ModelEnv):
            key, shape = "state", (env.scene.num_nodes, env.scene.state_size)
        else:
            key, shape = "physics", (env.scene.physics_size,)
        entry = cast("Tensor | None", tensordict.get(key, None))
        if entry is None:
            what = "state of the bodies" if key == "state" else "full MuJoCo state, as a SceneEnv writes"
            raise KeyError(f"ILQGPlanner needs an entry {key!r}, the {what}.")
        if entry.shape != (*tensordict.shape, *shape):
            raise ValueError(f"{key!r} must be {[*tensordict.shape, *shape]}, got {list(entry.shape)}")
        return entry.detach().double().reshape(math.prod(tensordict.shape), math.prod(shape)).cpu().numpy()

    def _plan_row(
        self, plant: Plant, start: np.ndarray, plan: np.ndarray | None, task: Any, proposed: np.ndarray | None
    ) -> np.ndarray:
        env = self._env
        reward = RewardExpansion(cast(Any, env.reward) if env.terminal is None else self._plan_reward, task, env.device)
        count = None if env.ends is None else partial(self._count, task)
        solver = ILQGSolver(plant, reward, control_cost=self.control_cost, count=count)
        iterations = self.warm_up if plan is None else self.iterations
        rest_plan = np.zeros((1, *self._plan_shape)) + env.scene.rest_action
        offered = rest_plan[:0] if proposed is None or not (plan is None or self.propose_every_step) else proposed[None]
        attempts: list[Callable[[], np.ndarray]] = []
        attempts += [] if plan is None else [lambda: np.concatenate((plan[None], offered))]
        drawn = partial(spline_controls, env.scene, _INITIAL_SAMPLES, self.horizon, self._rng)
        attempts += [lambda: np.concatenate((offered, drawn())), lambda: rest_plan]
        for sequences in attempts:
            best = solver.follow(start, solver.controls(sequences()))
            if math.isfinite(best.cost):
                return solver.actions(solver.improve(best, iterations).controls)
        if not self._warned:
            self._warned = True
            warnings.warn(
                f"ILQGPlanner found no sequence of {self.horizon} actions for {env.scene.name!r} that can be simulated"
                " with a finite reward: the simulation becomes unstable under all actions, or the reward is not finite."
                " Such states keep their last plan, or rest if they have none. Try a smaller physics step in the model."
                " (Warned once.)",
                RuntimeWarning,
                stacklevel=2,
            )
        return solver.actions(solver.controls(rest_plan[0])) if plan is None else plan

    def _plan_reward(self, state: Tensor, action: Tensor, next_state: Tensor, task: Any) -> Tensor:
        """Compute rewards ``[*B, H, 1]`` of the steps of plans; only the last step may end the episode."""
        env = self._env
        rewards = cast(Any, env.reward)(state, action, next_state, task)
        if task is not None:
            task = task[(*[slice(None)] * (action.ndim - 2), -1)]  # the last step's
        entries = TensorDict({} if task is None else {"task": task}, action.shape[:-2])
        last = state[..., -1:, :, :], action[..., -1:, :], next_state[..., -1:, :, :]
        alive = ~ended_steps(env, entries, *last).squeeze(-2)
        return plan_rewards(env.terminal, rewards, next_state[..., -1, :, :], task, alive)

    def _count(self, task: Any, bodies: np.ndarray, actions: np.ndarray, stable: np.ndarray) -> CountedSteps:
        """Return the steps that count, in the solver's form, from bodies ``[n, H + 1, N, C]``."""
        env = self._env
        tensors = [torch.from_numpy(array).to(env.device) for array in (bodies, actions, stable)]
        entries = TensorDict({} if task is None else {"task": task.expand(len(actions), *task.shape)}, [len(actions)])
        with torch.no_grad():
            steps = counted_steps(env, entries, *tensors)
        masks = steps.stable.squeeze(-1), steps.alive[:, :-1].squeeze(-1)
        arrays = [array.cpu().numpy() for array in (steps.before, steps.action, steps.after, *masks)]
        return cast(CountedSteps, tuple(arrays))

    @property
    def _env(self) -> SceneEnv | ModelEnv:
        return cast(Any, self.env)

    @property
    def _plan_shape(self) -> tuple[int, int]:
        return (self.horizon, self._env.scene.num_actions)

    def __getstate__(self) -> dict:
        # Copies and worker processes start their own threads and MuJoCo data.
        return {**super().__getstate__(), "_plants": {}}


def _flat(task: Any, dims: int) -> Any:
    """Flatten a task ``[*B, ...]``, tensor or TensorDict, to ``[prod(B), ...]``."""
    if isinstance(task, TensorDictBase):
        task = task.copy()
        task.batch_size = task.batch_size[:dims]
        return flat_rows(task)
    return task.reshape(-1, *task.shape[dims:])
