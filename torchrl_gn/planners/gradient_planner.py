"""Model-predictive control by gradients through a learned model."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_gn.checks import check_count, check_counts, refuse_closure
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.planners.model_planner import ModelPlanner
from torchrl_gn.planners.plan import keep_better, repeated
from torchrl_gn.planners.proposal import check_every_step

_MIN_STEP_SIZE = 0.01  # as a fraction of the optimiser's

OptimizerFactory = Callable[[Iterable[Tensor]], torch.optim.Optimizer]


class GradientPlanner(ModelPlanner):
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
        TypeError: ``optimizer`` makes no optimiser, or one whose steps need a closure; see :class:`ModelPlanner`.
        ValueError: an option is out of range, reward or actions are missing, or the rewards ignore the actions; when
            planning, the time in ``physics`` is not one control step after the last plan.
        KeyError: when planning, the real environment does not carry a model's hidden state or past actions.
    """

    memory = {"step_size": 1}

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
        options = {"candidates": candidates, "action_cost": action_cost, "pessimism": pessimism}
        super().__init__(env, horizon, **options, proposal=proposal, seed=seed)
        check_counts(iterations=iterations, samples=samples)
        check_count("warm_up", 0 if warm_up is None else warm_up, 0)
        if samples < candidates:
            raise ValueError(f"samples must be at least candidates={candidates}, got {samples}")
        if not 0 <= noise <= 1:
            raise ValueError(f"noise={noise} must be from 0 to 1.")
        if not 0 < shrink <= 1:
            raise ValueError(f"shrink must be above 0 and at most 1, got {shrink}")
        check_every_step(proposal, propose_every_step)
        self.iterations, self.shrink, self.samples, self.noise = int(iterations), shrink, int(samples), noise
        self.warm_up = min(iterations * horizon, 200) if warm_up is None else warm_up
        self.propose_every_step = propose_every_step
        self.optimizer: OptimizerFactory = optimizer or partial(torch.optim.Adam, lr=0.1)
        if optimizer is not None:
            _check_optimizer(optimizer)

    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        if torch.is_inference_mode_enabled():
            raise RuntimeError(
                "GradientPlanner needs gradients: use torch.no_grad() instead of torch.inference_mode()."
            )
        return super().decide(tensordict)

    def improve(
        self, entries: TensorDictBase, plan: Tensor, memory: dict[str, Tensor], *, resumed: bool
    ) -> tuple[Tensor, dict[str, Tensor]]:
        step_size = memory["step_size"]
        step_size = step_size.where(step_size > 0, torch.ones_like(step_size))  # a new plan's is 0
        start = self.later_plan(entries, plan) if resumed else self.initial_plan(entries)
        best, improved = self._ascend(entries, start, step_size, resumed=resumed)
        if resumed:
            step_size = step_size * torch.where(improved, 2.0, self.shrink).to(step_size)
        return best, {"step_size": step_size.clamp(_MIN_STEP_SIZE, 1.0)}

    def initial_plan(self, entries: TensorDictBase) -> Tensor:
        """Choose the best sequences ``[B, K, H, A]`` among random ones, zero actions and the proposal."""
        rows = len(entries)
        drawn = self.random_plans(rows, self.samples)
        drawn[:, 0] = self.rest_action
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

    def resample(self, plan: Tensor) -> Tensor:
        """Replace the worse half of the candidates ``[B, K, H, A]`` by perturbations of the first, the best."""
        count = self.candidates // 2
        if not count:
            return plan
        noise = self.noise * self.random_plans(len(plan), count)
        return torch.cat([plan[:, : self.candidates - count], (plan[:, :1] + noise).clamp(-1, 1)], dim=1)

    def proposed_plan(self, entries: TensorDictBase) -> Tensor:
        """Return the policy's scaled sequences ``[B, 1, H, A]``."""
        # A compiled model takes minutes to recompile for another batch size.
        count = self.candidates if self.imagined.predictor.fixed_batch else 1
        return self.proposed_plans(entries, count)[:, :1]

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
    def _ascend(
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
                    " lengthen the horizon until actions change the reward, or fix a reward that passes no gradient"
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
        self.warn_of_divergence(best_return, resumed=resumed)
        order = best_return.argsort(dim=1, descending=True, stable=True)
        improved = best_return.amax(1, keepdim=True) > initial_return.amax(1, keepdim=True)
        return best.gather(1, order[..., None, None].expand_as(best)).clamp(-1, 1), improved


def _check_optimizer(factory: OptimizerFactory) -> None:
    """Raise TypeError unless ``factory`` makes an optimiser of tensors whose steps need no closure."""
    with torch.inference_mode(False):
        made = factory([torch.zeros(1, requires_grad=True)]) if callable(factory) else factory
    if not callable(factory) or not isinstance(made, torch.optim.Optimizer):
        what = repr(factory) if isinstance(factory, str) else type(factory).__name__
        raise TypeError(
            "optimizer= must be a function that makes an optimiser of tensors, such as"
            f" lambda actions: torch.optim.Adam(actions, lr=0.1), not {what}."
        )
    refuse_closure(made)
