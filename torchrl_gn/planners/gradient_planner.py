"""Model-predictive control by gradients through a learned model."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from torchrl_gn.data.controls import numpy_generator, spline_controls
from torchrl_gn.dynamics.ensemble import lower_bound
from torchrl_gn.dynamics.program import PreparedStep
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.networks.frozen_weights import frozen
from torchrl_gn.planners.plan import (
    KEY,
    RecedingHorizonPlanner,
    check_pessimism,
    check_plannable,
    device_of,
    flat_rows,
    keep_better,
    plan_primer,
    read_plan,
    repeated,
    shift_plan,
)
from torchrl_gn.planners.proposal import check_proposal, propose

_MIN_STEP_SIZE = 0.01  # as a fraction of the optimiser's

OptimizerFactory = Callable[[Iterable[Tensor]], torch.optim.Optimizer]


class GradientPlanner(RecedingHorizonPlanner):
    """MPC planner by gradient ascent on the rewards that a learned model predicts.

    Paper, SM "MPC planner with learned models". Every control step rolls out ``horizon`` steps and updates the
    actions by the gradient of their summed reward, ``iterations`` times. The planner executes the first action of the
    best sequence found. The remaining actions, shifted by a step, warm-start the next plan; the TensorDict carries them
    in its entry ``plan``. If episodes auto-reset, append :meth:`make_tensordict_primer` to the environment.

    Rewards count until the model environment's ``done``. The planner discards sequences with a state or reward before
    ``done`` that is not finite; if it discards all, it keeps the last plan, with a warning. It enables autograd itself,
    also under ``no_grad``, and refuses ``inference_mode``. Actions are detached.

    Args:
        env: environment of the learned model, with the reward. A specialised model plans several times faster.
        iterations: updates at each control step (paper: 3 to 51).
        warm_up: updates of an episode's first plan. Default: ``iterations * horizon`` (paper), at most 200.
        candidates: number ``K`` of sequences that are improved in parallel.
        samples: number of random sequences that the first candidates are chosen from; at least ``candidates``.
        noise: amplitude of the random perturbations of the best candidate, in units of half the actions' range. They
            replace the worse half of the candidates at every later control step.
        optimizer: factory of the optimiser of the actions, which are in units of half their range. Default: Adam,
            learning rate 0.1.
        shrink: factor on the step size after a control step without improvement; an improvement doubles the step size,
            up to 1.
        action_cost: cost per step of the mean squared action, in units of half the range.
        pessimism: for an ensemble: plans maximise the mean of the members' returns minus this many standard
            deviations. Negative values explore where the members disagree.
        proposal: policy, for example a :class:`~torchrl_gn.policies.StatePolicy`. Its actions, rolled out in the model,
            are one of the samples.
        propose_every_step: also propose at later control steps. The proposal replaces the last candidate; a single
            candidate is replaced only if the proposal is better.
        seed: seed of the random sequences. Default: drawn from torch's global generator.

    Raises:
        ValueError: an option is out of range, reward or actions are missing, or the rewards ignore the actions; when
            planning, if the entry ``physics`` has moved on by another time than a control step.
        KeyError: when planning, if the real environment does not carry a model's hidden state or past actions.
    """

    middle: Tensor
    half_range: Tensor

    def __init__(
        self,
        env: ModelEnv,
        horizon: int,
        iterations: int = 10,
        *,
        warm_up: int | None = None,
        candidates: int = 1,
        samples: int = 64,
        noise: float = 0.25,
        optimizer: OptimizerFactory | None = None,
        shrink: float = 0.7,
        action_cost: float = 0.0,
        pessimism: float = 0.0,
        proposal: TensorDictModuleBase | None = None,
        propose_every_step: bool = False,
        seed: int | None = None,
    ) -> None:
        if not isinstance(env, ModelEnv):
            raise TypeError(
                f"GradientPlanner needs a ModelEnv, which has gradients; got {type(env).__name__}."
                " On the true physics use ILQGPlanner."
            )
        check_plannable(env, warm_up, horizon=horizon, iterations=iterations, candidates=candidates, samples=samples)
        if samples < candidates:
            raise ValueError(f"samples must be at least candidates={candidates}, got {samples}")
        if not 0 <= noise <= 1 or not 0 <= action_cost < math.inf:
            raise ValueError(
                f"noise must be in [0, 1] and action_cost finite and not negative, got {noise} and {action_cost}"
            )
        if not 0 < shrink <= 1:
            raise ValueError(f"shrink must be above 0 and at most 1, got {shrink}")
        check_pessimism(pessimism, env)
        check_proposal(proposal, propose_every_step, env)
        super().__init__(env)
        self.horizon, self.iterations, self.shrink = horizon, iterations, shrink
        self.warm_up = min(iterations * horizon, 200) if warm_up is None else warm_up
        self.candidates, self.samples, self.noise, self.action_cost = candidates, samples, noise, action_cost
        self.proposal, self.propose_every_step, self.pessimism = proposal, propose_every_step, pessimism
        self.optimizer: OptimizerFactory = optimizer or partial(torch.optim.Adam, lr=0.1)
        low, high = torch.as_tensor(env.scene.action_low), torch.as_tensor(env.scene.action_high)
        self.register_buffer("middle", ((low + high) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        self.to(env.device)
        self.set_seed(seed)

    def set_seed(self, seed: int | None) -> None:
        """Reseed the random sequences; None draws the seed from torch's global generator."""
        self._rng = numpy_generator(seed)

    @property
    def imagined(self) -> ModelEnv:
        """The environment of the learned model."""
        return cast(ModelEnv, self.env)

    @property
    def plan_shape(self) -> tuple[int, int, int]:
        """Shape of a sample's plan ``(K, H, A)``."""
        return self.candidates, self.horizon, self.imagined.scene.num_actions

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform for the real environment that resets the plan, hidden state and past actions."""
        carried = {key: self.imagined.observation_spec[key].clone() for key in self.imagined.carried_keys}
        return plan_primer(self.plan_shape, torch.float32, self.imagined.device, carried, step_size=(1,))

    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        if torch.is_inference_mode_enabled():
            raise RuntimeError(
                "GradientPlanner needs gradients: use torch.no_grad() instead of torch.inference_mode()."
            )
        batch, device = tensordict.shape, self.imagined.device
        flat = flat_rows(tensordict)
        plan, planned = read_plan(flat, self.plan_shape, torch.float32, self.imagined.scene.timestep)
        states_at = device_of(tensordict)
        plan, planned = self._scaled(plan.to(device)), planned.flatten().to(device)
        entries = self._entries(flat)
        lost = [key for key in self.imagined.carried_keys if key not in entries.keys()]
        if lost and bool(planned.any()):
            raise KeyError(
                f"The model carries {lost[0]!r} from step to step, and the environment drops it: append the planner's"
                " make_tensordict_primer() to the real environment."
            )
        size = cast(Tensor, flat.get((KEY, "step_size"), torch.ones(len(flat), 1, dtype=torch.float32)))
        step_size = size.where(size > 0, 1.0).to(device)  # a primer resets it to 0
        best = plan.clone()
        with frozen(self.imagined):
            for resumed in (False, True):
                rows = (planned == resumed).nonzero().flatten()
                if len(rows) == 0:
                    continue
                some = entries if len(rows) == len(flat) else cast(TensorDictBase, entries[rows])
                start = self.later_plan(some, plan[rows]) if resumed else self.initial_plan(some)
                best[rows], improved = self._improve(some, start, step_size[rows], resumed=resumed)
                if resumed:
                    step_size[rows] *= torch.where(improved, 2.0, self.shrink)
        actions, step_size = self._actions(best), step_size.clamp(_MIN_STEP_SIZE, 1.0)
        plan, step_size = actions.reshape(*batch, *self.plan_shape), step_size.reshape(*batch, 1)
        written: dict[NestedKey, TensorDictBase]
        written = {KEY: shift_plan(tensordict, plan.to(states_at), step_size=step_size.to(states_at))}
        if self.imagined.carried_keys:
            executed = entries.copy().set("action", self.env.action_spec.project(actions[:, 0, 0]))
            with torch.no_grad():
                for key, value in self.imagined.carried(executed).items():
                    written["next", key] = value.reshape(*batch, *value.shape[1:]).to(states_at)
        return plan[..., 0, 0, :].to(states_at), written

    def _scaled(self, actions: Tensor) -> Tensor:
        """Scale actions ``[*B, A]`` to units of half their range, -1 to 1; 0 where they are fixed."""
        return torch.where(self.half_range > 0, (actions - self.middle) / self.half_range, 0.0)

    def _actions(self, scaled: Tensor) -> Tensor:
        """Convert scaled actions ``[*B, A]`` to the actuators' units."""
        return torch.addcmul(self.middle, scaled, self.half_range)

    def _entries(self, flat: TensorDictBase) -> TensorDictBase:
        """Return the entries that a rollout reads, detached."""
        self.imagined.predictor.parameters_in(flat)  # refuses other variants; their entries are gone below
        keys = [key for key in (*self.imagined.world_model.in_keys, "past_actions", "task") if key != "action"]
        for reader in (self.proposal, self.imagined.ends):
            keys += [key for key in getattr(reader, "in_keys", ()) if key not in (*keys, "action", "reward")]
        read = flat.select(*keys, strict=False).detach()
        # Autograd refuses tensors made in inference mode: clone them.
        usable = read.apply(lambda entry: entry.clone() if entry.is_inference() else entry)
        return cast(TensorDictBase, usable).to(self.imagined.device)

    def predicted_returns(self, starts: TensorDictBase, plan: Tensor, prepared: PreparedStep | None = None) -> Tensor:
        """Predict returns ``[B, K]`` of scaled sequences ``[B, K, H, A]``; minus infinity if diverged before the end.

        ``prepared``: see :meth:`ModelEnv.prepared`.
        """
        members = self.imagined.members
        imagined = self.imagined.imagine_by_member(starts, self._actions(plan).flatten(0, 1), prepared)
        total = torch.where(imagined.diverged, -torch.inf, imagined.rewards.sum((-2, -1)))
        total = total.reshape(members, *plan.shape[:2])
        if self.action_cost:
            alive = imagined.alive[:, :-1, 0].reshape(members, *plan.shape[:3])
            total = total - self.action_cost * torch.where(alive, plan.square().mean(-1), 0.0).sum(-1)
        return lower_bound(total, self.pessimism)

    def initial_plan(self, entries: TensorDictBase) -> Tensor:
        """Choose the best sequences ``[B, K, H, A]`` among random ones, zero actions and the proposal."""
        rows = len(entries)
        drawn = self.random_plans(rows, self.samples)
        drawn[:, 0] = self._scaled(torch.zeros_like(self.middle)).clamp(-1, 1)
        if self.proposal is not None:
            drawn = torch.cat([self.proposed_plan(entries), drawn[:, : self.samples - 1]], dim=1)
        # A compiled model takes minutes to recompile for another batch size: use that of later steps.
        size = self.candidates if self.imagined.predictor.fixed_batch else self.samples
        drawn = drawn[:, : self.samples // size * size]
        starts = repeated(entries, size)
        with torch.no_grad():
            prepared, parts = self.imagined.prepared(starts, self.horizon), drawn.split(size, dim=1)
            total = torch.cat([self.predicted_returns(starts, part, prepared) for part in parts], dim=1)
        total = total.nan_to_num(-torch.inf, -torch.inf, -torch.inf)
        best = total.argsort(dim=1, descending=True, stable=True)[:, : self.candidates]
        return drawn.gather(1, best[..., None, None].expand(-1, -1, *drawn.shape[2:]))

    def random_plans(self, rows: int, count: int) -> Tensor:
        """Draw scaled smooth random sequences ``[rows, count, H, A]``."""
        drawn = torch.from_numpy(spline_controls(self.imagined.scene, rows * count, self.horizon, self._rng))
        return self._scaled(drawn.float().to(self.half_range.device)).reshape(rows, count, self.horizon, -1)

    def resample(self, plan: Tensor) -> Tensor:
        """Replace the worse half of the candidates ``[B, K, H, A]`` by perturbations of the first, the best."""
        count = self.candidates // 2
        if not count:
            return plan
        noise = self.noise * self.random_plans(len(plan), count)
        return torch.cat([plan[:, : self.candidates - count], (plan[:, :1] + noise).clamp(-1, 1)], dim=1)

    def proposed_plan(self, entries: TensorDictBase) -> Tensor:
        """Return the policy's scaled sequences ``[B, 1, H, A]``."""
        assert self.proposal is not None
        size = self.candidates if self.imagined.predictor.fixed_batch else 1
        actions = propose(self.proposal, self.imagined, repeated(entries, size), self.horizon)[::size]
        return self._scaled(actions.to(self.half_range.dtype)).clamp(-1, 1).unsqueeze(1)

    def later_plan(self, entries: TensorDictBase, plan: Tensor) -> Tensor:
        """Return candidates ``[B, K, H, A]`` to improve, from a warm start."""
        plan = self.resample(plan)
        if not self.propose_every_step:
            return plan
        proposed = self.proposed_plan(entries)
        if self.candidates == 1:
            with torch.no_grad():
                old, new = (self.predicted_returns(entries, each) for each in (plan, proposed))
            return torch.where((new > old)[..., None, None], proposed, plan)
        return torch.cat([plan[:, :-1], proposed], dim=1)

    @torch.no_grad()
    def _improve(
        self, entries: TensorDictBase, plan: Tensor, step_size: Tensor, *, resumed: bool
    ) -> tuple[Tensor, Tensor]:
        """Ascend the returns of candidates ``[B, K, H, A]`` by steps of ``step_size`` ``[B, 1]`` times the optimiser's.

        Returns the best sequences found, best candidate first, and a mask ``[B, 1]``: True if one beats all given ones.
        """
        starts = repeated(entries, self.candidates)
        prepared = self.imagined.prepared(starts, self.horizon)  # the model folds its weights once
        best, best_return = plan.clone(), plan.new_full(plan.shape[:2], -torch.inf)
        initial_return, descent = best_return, -torch.ones_like(best_return)
        # The optimiser works on offsets in units of the step size.
        scale = step_size[..., None, None]
        offset = torch.zeros_like(plan, requires_grad=True)
        optimizer = self.optimizer([offset])
        for iteration in range(self.iterations if resumed else self.warm_up):
            actions = torch.addcmul(plan, scale, offset).requires_grad_()
            with torch.enable_grad():
                total = self.predicted_returns(starts, actions, prepared)
            depends = total.requires_grad
            gradient = torch.autograd.grad(total, actions, descent, allow_unused=True)[0] if depends else None
            if gradient is None:
                raise ValueError(
                    f"The rewards that {self.imagined} imagines do not depend on the actions. Train the model,"
                    " lengthen the horizon until actions change the reward, or mend a reward that passes no gradient"
                    " (detach, NumPy, comparisons)."
                )
            best, best_return = keep_better(best, best_return, actions, total)
            initial_return = best_return if iteration == 0 else initial_return
            # Zero the gradient of a candidate if it overflows.
            finite = gradient.isfinite().flatten(2).all(-1)[..., None, None]
            offset.grad = torch.where(finite, scale * gradient, 0.0)
            optimizer.step()
            offset.copy_((torch.addcmul(plan, scale, offset).clamp(-1, 1) - plan) / scale)
        actions = torch.addcmul(plan, scale, offset)
        best, best_return = keep_better(best, best_return, actions, self.predicted_returns(starts, actions, prepared))
        failed = int((best_return == -torch.inf).all(1).sum())
        if failed:
            fallback = "their last plan is kept" if resumed else "there is no plan yet, and nothing is done"
            warnings.warn(
                f"{self.imagined}: every imagined rollout of {failed} of {len(plan)} states has predictions or rewards"
                f" that are not finite; {fallback}.",
                RuntimeWarning,
                stacklevel=2,
            )
        order = best_return.argsort(dim=1, descending=True, stable=True)
        improved = best_return.amax(1, keepdim=True) > initial_return.amax(1, keepdim=True)
        return best.gather(1, order[..., None, None].expand_as(best)).clamp(-1, 1), improved
