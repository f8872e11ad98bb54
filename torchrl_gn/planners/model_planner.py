"""Base of planners that improve action sequences in a learned model."""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from typing import ClassVar, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from torchrl_gn.data.controls import numpy_generator, spline_controls
from torchrl_gn.dynamics.ensemble import check_pessimism, lower_bound
from torchrl_gn.dynamics.program import PreparedStep
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.networks.frozen_weights import frozen
from torchrl_gn.planners.plan import (
    KEY,
    RecedingHorizonPlanner,
    check_plannable,
    device_of,
    flat_rows,
    plan_primer,
    read_plan,
    repeated,
    shift_plan,
)
from torchrl_gn.planners.proposal import check_proposal, propose


class ModelPlanner(RecedingHorizonPlanner):
    """MPC planner that improves ``candidates`` action sequences in a learned model.

    Subclasses write :meth:`improve`. Every control step executes the first action of the best candidate; the other
    actions, shifted by a step, warm-start the next plan. The TensorDict carries them in its entry ``plan``. If episodes
    auto-reset, append :meth:`make_tensordict_primer` to the environment. Actions are detached.

    Args:
        env: environment of the learned model, with the reward.
        horizon: ``H``, number of actions of a plan.
        candidates: ``K``, number of sequences that are improved in parallel.
        action_cost: cost per step of the mean squared action, in units of half the range.
        pessimism: for an ensemble: plans maximise the mean of the members' returns minus this many standard deviations.
        proposal: policy whose actions start plans.
        seed: seed of random numbers. Default: drawn from torch's global generator.

    Raises:
        TypeError: ``env`` is not of a learned model, or ``proposal`` writes no ``action``.
        ValueError: an option is out of range, or reward, bounded actions or an ensemble are missing; when planning, the
            time in ``physics`` is not one control step after the last plan.
        KeyError: when planning, the real environment does not carry a model's hidden state or past actions.
    """

    middle: Tensor
    half_range: Tensor

    memory: ClassVar[dict[str, int]] = {}
    """Names and lengths of vectors that are kept in the entry ``plan`` besides the actions; zeros at first."""

    def __init__(
        self,
        env: ModelEnv,
        horizon: int,
        *,
        candidates: int = 1,
        action_cost: float = 0.0,
        pessimism: float = 0.0,
        proposal: TensorDictModuleBase | None = None,
        seed: int | None = None,
    ) -> None:
        if not isinstance(env, ModelEnv):
            raise TypeError(
                f"{type(self).__name__} needs a ModelEnv, of a learned model; got {type(env).__name__}."
                " On the true physics use ILQGPlanner."
            )
        check_plannable(env, None, horizon=horizon, candidates=candidates)
        if not 0 <= action_cost < math.inf:
            raise ValueError(f"action_cost={action_cost} must be finite and not negative.")
        check_pessimism(pessimism, env.members)
        check_proposal(proposal, env)
        super().__init__(env)
        self.horizon, self.candidates, self.action_cost = int(horizon), int(candidates), action_cost
        self.pessimism, self.proposal = pessimism, proposal
        low, high = torch.as_tensor(env.scene.action_low), torch.as_tensor(env.scene.action_high)
        self.register_buffer("middle", ((low + high) / 2).float())
        self.register_buffer("half_range", ((high - low) / 2).float())
        self.to(env.device)
        self.set_seed(seed)

    @abstractmethod
    def improve(
        self, entries: TensorDictBase, plan: Tensor, memory: dict[str, Tensor], *, resumed: bool
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return better sequences ``[B, K, H, A]``, the best first, and the new memory.

        Args:
            entries: ``[B]`` entries that a rollout reads.
            plan: ``[B, K, H, A]`` sequences of the last plan, in units of half the actions' range.
            memory: ``[B, n]`` vectors of :attr:`memory`.
            resumed: False in an episode's first plan; ``plan`` and ``memory`` are then zeros.
        """

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
        memory = {name: (length,) for name, length in self.memory.items()}
        return plan_primer(self.plan_shape, torch.float32, self.imagined.device, carried, **memory)

    def decide(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[NestedKey, TensorDictBase]]:
        batch, device = tensordict.shape, self.imagined.device
        flat = flat_rows(tensordict)
        plan, planned = read_plan(flat, self.plan_shape, torch.float32, self.imagined.scene.timestep)
        states_at = device_of(tensordict)
        plan, planned = self.scaled(plan.to(device)), planned.flatten().to(device)
        entries = self._entries(flat)
        lost = [key for key in self.imagined.carried_keys if key not in entries.keys()]
        if lost and bool(planned.any()):
            raise KeyError(
                f"The model carries {lost[0]!r} from step to step, and the environment drops it: append the planner's"
                " make_tensordict_primer() to the real environment."
            )
        memory = self._memory(flat, device)
        best = plan.clone()
        with frozen(self.imagined):
            for resumed in (False, True):
                rows = (planned == resumed).nonzero().flatten()
                if len(rows) == 0:
                    continue
                some = entries if len(rows) == len(flat) else cast(TensorDictBase, entries[rows])
                of_rows = {name: values[rows] for name, values in memory.items()}
                best[rows], of_rows = self.improve(some, plan[rows], of_rows, resumed=resumed)
                for name, values in of_rows.items():
                    memory[name][rows] = values
        actions = self.actions(best).float()  # as the primer's, also of a planner that was cast to another dtype
        plan = actions.reshape(*batch, *self.plan_shape)
        memory = {name: values.reshape(*batch, values.shape[-1]).to(states_at) for name, values in memory.items()}
        written: dict[NestedKey, TensorDictBase] = {KEY: shift_plan(tensordict, plan.to(states_at), **memory)}
        if self.imagined.carried_keys:
            executed = entries.copy().set("action", self.env.action_spec.project(actions[:, 0, 0]))
            with torch.no_grad():
                for key, value in self.imagined.carried(executed).items():
                    written["next", key] = value.reshape(*batch, *value.shape[1:]).to(states_at)
        return plan[..., 0, 0, :].to(states_at), written

    def _memory(self, flat: TensorDictBase, device: torch.device | None) -> dict[str, Tensor]:
        """Return copies of the vectors of :attr:`memory`, ``[B, n]``; zeros without a plan."""
        memory: dict[str, Tensor] = {}
        for name, length in self.memory.items():
            before = cast("Tensor | None", flat.get((KEY, name), None))
            if before is None:
                before = torch.zeros(len(flat), length, dtype=torch.float32)
            memory[name] = before.clone().to(device)
        return memory

    def scaled(self, actions: Tensor) -> Tensor:
        """Scale actions ``[*B, A]`` to units of half their range, -1 to 1; 0 where they are fixed."""
        return torch.where(self.half_range > 0, (actions - self.middle) / self.half_range, 0.0)

    def actions(self, scaled: Tensor) -> Tensor:
        """Convert scaled actions ``[*B, A]`` to the actuators' units."""
        return torch.addcmul(self.middle, scaled, self.half_range)

    @property
    def rest_action(self) -> Tensor:
        """Scaled zero action ``[A]``, within the bounds."""
        return self.scaled(torch.zeros_like(self.middle)).clamp(-1, 1)

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

        Args:
            starts: ``[B K]``, the candidates of a state adjacent.
            prepared: see :meth:`ModelEnv.prepared`.
        """
        members = self.imagined.members
        imagined = self.imagined.imagine_by_member(starts, self.actions(plan).flatten(0, 1), prepared)
        total = torch.where(imagined.diverged, -torch.inf, imagined.rewards.sum((-2, -1)))
        total = total.reshape(members, *plan.shape[:2])
        if self.action_cost:
            alive = imagined.alive[:, :-1, 0].reshape(members, *plan.shape[:3])
            total = total - self.action_cost * torch.where(alive, plan.square().mean(-1), 0.0).sum(-1)
        return lower_bound(total, self.pessimism)

    def random_plans(self, rows: int, count: int) -> Tensor:
        """Draw scaled smooth random sequences ``[rows, count, H, A]``."""
        drawn = torch.from_numpy(spline_controls(self.imagined.scene, rows * count, self.horizon, self._rng))
        return self.scaled(drawn.float().to(self.half_range.device)).reshape(rows, count, self.horizon, -1)

    def proposed_plans(self, entries: TensorDictBase, count: int, *, explore: bool = False) -> Tensor:
        """Return scaled action sequences ``[B, count, H, A]`` of the policy.

        Args:
            entries: start of the sequences ``[B]``.
            count: number of sequences per start.
            explore: let the policy explore in all sequences but the first.
        """
        assert self.proposal is not None
        starts, explores = repeated(entries, count), None
        if explore:
            explores = torch.arange(len(starts), device=self.imagined.device) % count > 0
        actions = propose(self.proposal, self.imagined, starts, self.horizon, explores)
        return self.scaled(actions.to(self.half_range.dtype)).clamp(-1, 1).unflatten(0, (-1, count))

    def warn_of_divergence(self, returns: Tensor, *, resumed: bool) -> None:
        """Warn if all returns ``[B, K]`` of a state are minus infinity."""
        failed = int((returns == -torch.inf).all(1).sum())
        if failed:
            fallback = "their last plan is kept" if resumed else "there is no plan yet, and nothing is done"
            warnings.warn(
                f"{self.imagined}: every imagined rollout of {failed} of {len(returns)} states has predictions or"
                f" rewards that are not finite; {fallback}.",
                RuntimeWarning,
                stacklevel=2,
            )
