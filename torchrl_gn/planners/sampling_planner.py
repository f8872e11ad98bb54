"""Model-predictive control by sampling, with a policy's proposals (MPPI as in TD-MPC2)."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_gn.checks import check_counts
from torchrl_gn.dynamics.program import PreparedStep
from torchrl_gn.envs.model_env import ModelEnv
from torchrl_gn.planners.model_planner import ModelPlanner
from torchrl_gn.planners.plan import repeated


class SamplingPlanner(ModelPlanner):
    r"""MPC planner that samples action sequences and averages the best by their returns (MPPI).

    Every control step starts from the shifted mean of the last plan. In each of ``iterations``, it samples sequences
    around the mean :math:`\mu`, predicts their returns :math:`R_k` and averages the ``elites`` best:

    .. math:: \mu = \sum_k w_k a_k \qquad w_k \propto \exp\frac{R_k - \max_j R_j}{\tau\,\mathrm{std}_j R_j}

    The next samples have the elites' weighted standard deviation. The planner executes the first action of the mean.

    With ``proposal``, ``proposals`` sequences of the policy, sampled with its noise except for the first, compete in
    every iteration. With the policy's value as ``terminal`` of the environment, few short plans improve on a policy
    (TD-MPC2, Hansen et al. 2024). See :class:`GradientPlanner` for the entry ``plan`` and the end of episodes.

    The planner needs no gradients. Where rewards have useful gradients, :class:`GradientPlanner` is faster and plans
    better.

    Args:
        env: environment of the learned model, with the reward. A specialised model plans several times faster.
        horizon: ``H``, number of actions of a plan.
        iterations: rounds of sampling at each control step.
        samples: number of sequences that a round samples around the mean.
        elites: number of best sequences that are averaged; at most all.
        std: standard deviation of the first samples of a control step, in units of half the actions' range.
        min_std: lowest standard deviation of later samples.
        temperature: :math:`\tau`, in standard deviations of the elites' returns. Lower: closer to the best sequence.
        action_cost: cost per step of the mean squared action, in units of half the range.
        pessimism: for an ensemble: plans maximise the mean of the members' returns minus this many standard
            deviations.
        proposal: policy, for example a :class:`~torchrl_gn.policies.StatePolicy`.
        proposals: number of sequences of the policy.
        seed: seed of the samples. Default: drawn from torch's global generator, which also gives the policy's noise.

    Raises:
        TypeError, ValueError, KeyError: see :class:`GradientPlanner`.

    Example:
        >>> import torchrl_gn as gn
        >>> pretrained = gn.load_pretrained("pendulum")
        >>> scene = pretrained.scene()
        >>> reward = gn.make_reward("balance", scene)
        >>> imagined = gn.ModelEnv(gn.specialize(pretrained.bind(scene)), reward)
        >>> planner = gn.SamplingPlanner(imagined, horizon=5, seed=0)
        >>> gn.SceneEnv(scene, reward, seed=0).rollout(3, planner)["action"].shape
        torch.Size([3, 1])
    """

    def __init__(
        self,
        env: ModelEnv,
        horizon: int,
        iterations: int = 3,
        *,
        samples: int = 96,
        elites: int = 32,
        std: float = 0.5,
        min_std: float = 0.05,
        temperature: float = 1.0,
        action_cost: float = 0.0,
        pessimism: float = 0.0,
        proposal: TensorDictModuleBase | None = None,
        proposals: int = 24,
        seed: int | None = None,
    ) -> None:
        options = {"action_cost": action_cost, "pessimism": pessimism, "proposal": proposal}
        super().__init__(env, horizon, **options, seed=seed)
        check_counts(iterations=iterations, samples=samples, elites=elites, proposals=proposals)
        if not 0 < min_std <= std < math.inf:
            raise ValueError(f"min_std={min_std} must be above 0, and std={std} finite and at least that.")
        if not 0 < temperature < math.inf:
            raise ValueError(f"temperature={temperature} must be positive and finite.")
        self.iterations, self.samples, self.elites = int(iterations), int(samples), int(elites)
        self.std, self.min_std, self.temperature, self.proposals = std, min_std, temperature, int(proposals)

    @torch.no_grad()
    def improve(
        self, entries: TensorDictBase, plan: Tensor, memory: dict[str, Tensor], *, resumed: bool
    ) -> tuple[Tensor, dict[str, Tensor]]:
        proposed = None if self.proposal is None else self.proposed_plans(entries, self.proposals, explore=True)
        mean = plan[:, 0] if resumed else self.rest_action.expand_as(plan[:, 0])
        if not resumed and proposed is not None:
            mean = proposed[:, 0]
        std, starts = torch.full_like(mean, self.std), repeated(entries, self.samples)
        prepared = self.imagined.prepared(starts, self.horizon)  # the model folds its weights once
        known, known_returns = mean.new_empty(len(mean), 0, *mean.shape[1:]), mean.new_empty(len(mean), 0)
        if proposed is not None:
            known, known_returns = proposed, self._returns(repeated(entries, self.proposals), proposed)
        returns = known_returns
        for noise in self._noise(mean):
            sampled = (mean.unsqueeze(1) + std.unsqueeze(1) * noise).clamp(-1, 1)
            returns = torch.cat((self._returns(starts, sampled, prepared), known_returns), 1)
            mean, std = self._fit_elites(torch.cat((sampled, known), 1), returns, mean)
        self.warn_of_divergence(returns, resumed=resumed)
        return mean.unsqueeze(1), memory

    def _returns(self, starts: TensorDictBase, plan: Tensor, prepared: PreparedStep | None = None) -> Tensor:
        """Return :meth:`predicted_returns`, minus infinity where they are not finite."""
        returns = self.predicted_returns(starts, plan, prepared)
        return returns.nan_to_num(-torch.inf, -torch.inf, -torch.inf)

    def _noise(self, mean: Tensor) -> Tensor:
        """Draw noise ``[iterations, B, samples, H, A]`` of unit variance, zero in the first sample, the mean."""
        rows, *shape = mean.shape
        noise = self._rng.standard_normal((self.iterations, rows, self.samples, *shape))
        noise[:, :, 0] = 0.0
        return torch.from_numpy(noise).to(mean)  # all at once, as each transfer to a GPU waits

    def _fit_elites(self, sequences: Tensor, returns: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return weighted mean and standard deviation of the best sequences; ``mean`` where all have diverged."""
        best = returns.topk(min(self.elites, returns.shape[1]), dim=1)
        finite = best.values.isfinite()
        values = best.values.where(finite, 0.0)
        counted = finite.sum(1, keepdim=True).clamp(min=1)
        center = values.sum(1, keepdim=True) / counted
        variance = torch.where(finite, (values - center).square(), 0.0).sum(1, keepdim=True) / counted
        # Equal returns have equal weights.
        scale = self.temperature * variance.sqrt().clamp(min=torch.finfo(values.dtype).tiny)
        weights = torch.where(finite, ((values - values[:, :1]) / scale).exp(), 0.0)
        weights = (weights / weights.sum(1, keepdim=True).clamp(min=1.0))[..., None, None]
        elites = sequences.gather(1, best.indices[..., None, None].expand(-1, -1, *sequences.shape[2:]))
        found = (weights * elites).sum(1)
        std = (weights * (elites - found.unsqueeze(1)).square()).sum(1).sqrt().clamp(min=self.min_std)
        any_finite = finite[:, :1, None]
        return torch.where(any_finite, found, mean), torch.where(any_finite, std, self.std)
