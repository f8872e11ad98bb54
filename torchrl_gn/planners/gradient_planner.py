"""Model-predictive control by gradients through the learned model."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from torchrl_gn.data.controls import numpy_generator, spline_controls
from torchrl_gn.dynamics import Predictor
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.networks.frozen_weights import frozen
from torchrl_gn.planners.plan import (
    KEY,
    RecedingHorizonPlanner,
    check_count,
    check_plannable,
    plan_left,
    plan_primer,
    read_plan,
)

SMALLEST_STEP = 0.01  # as a share of the optimiser's

OptimizerFactory = Callable[[Iterable[Tensor]], torch.optim.Optimizer]


class GradientPlanner(RecedingHorizonPlanner):
    """Choose the actions whose imagined rewards are highest, by gradient ascent.

    (Paper, SM "MPC planner with learned models".)
    At every control step the rewards of the next ``horizon`` steps are imagined in one rollout of the model
    (:meth:`~torchrl_gn.envs.ModelEnv.imagine`), differentiated with respect to the actions, and the actions changed, a
    number of times. The first is taken; the others, shifted by one step and with the last repeated, are where the
    next control step's planning starts (receding horizon). The best sequence seen counts, not the last.

    An optimiser with a fixed rate cannot balance finely: near the best actions its steps go past them. So a state's
    steps are ``shrink`` times as large after a control step that found nothing better than the plan it began with, and
    twice as large, up to what the optimiser makes them, after one that did.

    A plan is the TensorDict's entry ``plan``: the planner itself keeps nothing, serves any batch, and an episode's
    first call is one without that entry. It then draws smooth random sequences and improves the best ones for
    ``warm_up`` iterations. Where episodes end and begin anew inside one rollout, :meth:`make_tensordict_primer` clears
    the plan; ``Collector(..., auto_register_policy_transforms=True)`` appends it to the environment by itself.

    A sequence whose predictions or rewards are not finite (float32 rewards overflow above 3e38) never gets into a plan.
    Where all are, the last plan is kept, or nothing is done if there is none, with a warning.

    Plan with a specialised model, ``ModelEnv(specialize(bound, compile=True), reward)``: several times as fast.
    Works under ``no_grad`` and not under ``inference_mode``, where nothing has a gradient.

    Args:
        env: the learned model with the reward to plan for.
        horizon: control steps to look ahead.
        iterations: changes of the plan at each control step (paper: 3 to 51).
        warm_up: changes of a first plan. Default: ``iterations * horizon`` (paper), at most 200.
        candidates: sequences that are improved at a time, each on its own; the best one acts.
        samples: random sequences of which a first plan takes the best ones; at least ``candidates``. At every later
            control step half of the candidates, the worst ones, start anew close to the best.
        noise: how far from the best, as a share of the actions' range.
        optimizer: makes the optimiser of the actions, which it sees in units of half their range.
            Default: Adam with a rate of 0.1.
        shrink: how much smaller steps get where they gain nothing, above 0; 1: never.
        action_cost: subtracted for each step's mean squared action, in those units.
        seed: of the random sequences. Default: drawn from torch's global generator.

    Raises:
        TypeError: if ``env`` is no ``ModelEnv``.
        ValueError: if a number is out of its range, the environment has no reward or the scene no actions; when
            planning, if rewards do not depend on the actions.
        RuntimeError: when planning, in inference mode.
    """

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
        seed: int | None = None,
    ) -> None:
        if not isinstance(env, ModelEnv):
            raise TypeError(
                f"GradientPlanner plans through a ModelEnv, which has gradients; got {type(env).__name__}."
                " On the true physics use ILQGPlanner."
            )
        check_plannable(env, horizon=horizon, iterations=iterations, candidates=candidates, samples=samples)
        if samples < candidates:
            raise ValueError(f"samples must be at least candidates={candidates}, got {samples}")
        warm_up = min(iterations * horizon, 200) if warm_up is None else warm_up
        check_count("warm_up", warm_up, 0)
        if not 0 <= noise <= 1 or not 0 <= action_cost < math.inf:
            raise ValueError(
                f"noise must be in [0, 1] and action_cost finite and not negative, got {noise} and {action_cost}"
            )
        if not 0 < shrink <= 1:
            raise ValueError(f"shrink must be above 0 and at most 1, got {shrink}")
        super().__init__(env)
        self.shrink = shrink
        self.horizon, self.iterations, self.warm_up = horizon, iterations, warm_up
        self.candidates, self.samples, self.noise, self.action_cost = candidates, samples, noise, action_cost
        self.optimizer: OptimizerFactory = optimizer or partial(torch.optim.Adam, lr=0.1)
        low, high = torch.as_tensor(env.scene.action_low), torch.as_tensor(env.scene.action_high)
        self.register_buffer("middle", ((low + high) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        self.to(env.device)
        self._rng = numpy_generator(seed)

    middle: Tensor
    half_range: Tensor

    @property
    def imagined(self) -> ModelEnv:
        """The environment that is planned in."""
        return cast(ModelEnv, self.env)

    @property
    def plan_shape(self) -> tuple[int, int, int]:
        """Shape of a sample's plan: candidates, horizon, actions."""
        return self.candidates, self.horizon, self.imagined.scene.num_actions

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Transform that clears the plan when an episode begins, for the environment that is acted in.

        Of a recurrent model it also carries what that remembers.
        """
        hidden_state = (
            cast(TensorDictBase, self.imagined.world_model.initial_hidden_state()) if self._remembers else None
        )
        return plan_primer(self.plan_shape, torch.float32, self.imagined.device, hidden_state, step_size=(1,))

    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        """The action to take now, ``[*B, A]``, where the states are; what is left of the plan; and hidden state."""
        if torch.is_inference_mode_enabled():
            raise RuntimeError(
                "GradientPlanner needs gradients, which torch.inference_mode() rules out; use torch.no_grad() there."
            )
        batch, device = tensordict.shape, self.imagined.device
        flat = tensordict.reshape(-1)
        plan, planned = read_plan(flat, self.plan_shape, torch.float32)
        states_at = cast(Tensor, tensordict.get("state", plan)).device
        plan, planned = self._scaled(plan.to(device)), planned.flatten().to(device)
        entries = self._entries(flat)
        if self._remembers and "hidden_state" not in entries.keys() and bool(planned.any()):
            raise KeyError(
                "The model remembers past states, and the environment drops its entry 'hidden_state' between steps: append"
                " the planner's make_tensordict_primer() to the environment that is acted in."
            )
        best, size = plan.clone(), self._step_size(flat).to(device)
        with frozen(self.imagined):
            first = (~planned, self.warm_up, "there is no plan yet, and nothing is done")
            for rows, iterations, otherwise in (first, (planned, self.iterations, "their last plan is kept")):
                where = rows.nonzero().flatten()
                if len(where) == 0:
                    continue
                some = entries if len(where) == len(flat) else cast(TensorDictBase, entries[where])
                begin = self._renewed(plan[where]) if bool(planned[where[0]]) else self._first(some)
                best[where], better = self._improve(some, begin, iterations, otherwise, size[where])
                if rows is planned:
                    size[where] *= torch.where(better, 2.0, self.shrink)
        actions, size = self._actions(best), size.clamp(SMALLEST_STEP, 1.0)
        left = plan_left(
            batch,
            actions.reshape(*batch, *self.plan_shape).to(states_at),
            step_size=size.reshape(*batch, 1).to(states_at),
        )
        beside: dict[NestedKey, TensorDictBase] = {KEY: left}
        if self._remembers:
            beside["next", "hidden_state"] = self._remember(entries, actions[:, 0, 0]).reshape(batch).to(states_at)
        return actions[:, 0, 0].reshape(*batch, -1).to(states_at), beside

    def _step_size(self, flat: TensorDictBase) -> Tensor:
        """Of every state ``[B, 1]``, as a share of the optimiser's; whole where there is no plan."""
        size = cast("Tensor | None", flat.get((KEY, "step_size"), None))
        if size is None:
            return torch.ones(len(flat), 1)
        return size.where(size > 0, 1.0)  # a primer's is 0

    def _scaled(self, actions: Tensor) -> Tensor:
        """Actions ``[*B, A]`` in units of half their range, from -1 to 1 around its middle; 0 where they are fixed."""
        return torch.where(self.half_range > 0, (actions - self.middle) / self.half_range, 0.0)

    def _actions(self, scaled: Tensor) -> Tensor:
        """Actions ``[*B, A]`` in the actuators' units."""
        return scaled * self.half_range + self.middle

    @property
    def _remembers(self) -> bool:
        return "hidden_state" in self.imagined.world_model.in_keys

    @torch.no_grad()
    def _remember(self, entries: TensorDictBase, action: Tensor) -> TensorDictBase:
        """What the model remembers once it has seen this state and action."""
        action = self.env.action_spec.project(action)
        return self.imagined.world_model(entries.copy().set("action", action))["next", "hidden_state"]

    def _entries(self, flat: TensorDictBase) -> TensorDictBase:
        """What imagining reads, detached."""
        model = cast(object, self.imagined.world_model)
        if isinstance(model, Predictor):
            model.parameters_in(flat)  # refuses other variants, of which the entries below tell nothing any more
        keys = [key for key in (*self.imagined.world_model.in_keys, "task") if key != "action"]
        read = flat.select(*keys, strict=False).detach()
        # Of what was made in inference mode, which autograd refuses, copies.
        usable = read.apply(lambda entry: entry.clone() if entry.is_inference() else entry)
        return cast(TensorDictBase, usable).to(self.imagined.device)

    def _imagine(self, many: TensorDictBase, plan: Tensor) -> Tensor:
        """Returns ``[B, K]`` of sequences ``[B, K, H, A]`` in units of half their range, from ``[B K]`` states.

        Minus infinity where a prediction is not finite: a reward may look at another body.
        """
        states, rewards = self.imagined.imagine(many, self._actions(plan).flatten(0, 1))
        finite = states.isfinite().flatten(1).all(1)
        total = torch.where(finite, rewards.sum((-2, -1)), -torch.inf).reshape(plan.shape[:2])
        return total - self.action_cost * plan.square().mean(-1).sum(-1) if self.action_cost else total

    def _first(self, entries: TensorDictBase) -> Tensor:
        """The best of random sequences ``[B, K, H, A]``; doing nothing is among them, and first if none is finite."""
        rows = len(entries)
        drawn = self._splines(rows, self.samples)
        drawn[:, 0] = self._scaled(torch.zeros_like(self.middle)).clamp(-1, 1)
        # A compiled model is compiled for every number of rows, in minutes: give it the one that it gets later.
        size = self.candidates if getattr(self.imagined.world_model, "compile_steps", False) else self.samples
        drawn = drawn[:, : self.samples // size * size]
        many = _repeated(entries, size)
        with torch.no_grad():
            total = torch.cat([self._imagine(many, part) for part in drawn.split(size, dim=1)], dim=1)
        total = total.nan_to_num(-torch.inf, -torch.inf, -torch.inf)
        best = total.argsort(dim=1, descending=True, stable=True)[:, : self.candidates]
        return drawn.gather(1, best[..., None, None].expand(-1, -1, *drawn.shape[2:]))

    def _splines(self, rows: int, count: int) -> Tensor:
        drawn = spline_controls(self.imagined.scene, rows * count, self.horizon, self._rng)
        controls = torch.from_numpy(drawn).float().to(self.half_range.device)
        return self._scaled(controls).reshape(rows, count, self.horizon, -1)

    def _renewed(self, plan: Tensor) -> Tensor:
        """Sequences ``[B, K, H, A]``, of which the worse half starts anew close to the first, the best."""
        renewed = self.candidates // 2
        if not renewed:
            return plan
        noise = self.noise * self._splines(len(plan), renewed)
        return torch.cat([plan[:, : self.candidates - renewed], (plan[:, :1] + noise).clamp(-1, 1)], dim=1)

    def _improve(
        self, entries: TensorDictBase, plan: Tensor, iterations: int, otherwise: str, size: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Sequences ``[B, K, H, A]`` improved, the best one first, and ``[B, 1]`` whether that is a better one.

        As given, and a warning, where none is finite. Steps are ``size`` ``[B, 1]`` times the optimiser's.
        """
        # The same tensors in every iteration: what the model folds of them is folded once.
        many = _repeated(entries, self.candidates)
        best, record = plan.clone(), plan.new_full(plan.shape[:2], -torch.inf)
        began = record
        # What the optimiser sees: a step of it is one of the actions times the step size.
        size = size[..., None, None]
        moved = torch.zeros_like(plan, requires_grad=True)
        optimizer = self.optimizer([moved])
        for iteration in range(iterations):
            with torch.enable_grad():
                actions = plan + size * moved
                total = self._imagine(many, actions)
                depends = total.requires_grad
                gradient = torch.autograd.grad(-total.sum(), moved, allow_unused=True)[0] if depends else None
                if gradient is None:
                    raise ValueError(
                        f"The rewards that {self.imagined} imagines do not depend on the actions. Has its model been"
                        " trained, and is the horizon long enough for the reward to show what actions do?"
                    )
            best, record = _keep_better(best, record, actions, total)
            began = record if iteration == 0 else began
            # A sequence whose rollout leaves all bounds has no usable gradient: it stays where it is.
            usable = gradient.isfinite().flatten(2).all(-1)[..., None, None]
            moved.grad = torch.where(usable, gradient, 0.0)
            optimizer.step()
            with torch.no_grad():
                moved.copy_(((plan + size * moved).clamp(-1, 1) - plan) / size)
        with torch.no_grad():
            actions = plan + size * moved
            best, record = _keep_better(best, record, actions, self._imagine(many, actions))
        lost = int((record == -torch.inf).all(1).sum())
        if lost:
            warnings.warn(
                f"{self.imagined}: every imagined rollout of {lost} of {len(plan)} states has predictions or rewards"
                f" that are not finite; {otherwise}.",
                RuntimeWarning,
                stacklevel=2,
            )
        order = record.argsort(dim=1, descending=True, stable=True)
        better = record.amax(1, keepdim=True) > began.amax(1, keepdim=True)
        return best.gather(1, order[..., None, None].expand_as(best)).clamp(-1, 1), better


def _repeated(entries: TensorDictBase, count: int) -> TensorDictBase:
    return entries if count == 1 else entries.repeat_interleave(count, dim=0)


def _keep_better(best: Tensor, record: Tensor, actions: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """The better of sequences seen before and now, each by its return; one that is not finite is never better."""
    total = total.detach()
    better = total.isfinite() & (total > record)
    return torch.where(better[..., None, None], actions.detach(), best), torch.where(better, total, record)
