"""A short-horizon actor-critic: the policy's gradient through a learned model, with a value at the end."""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from torchrl.objectives import LossModule
from torchrl.objectives.value import TDLambdaEstimator

from torchrl_gn.dynamics.ensemble import lower_bound
from torchrl_gn.envs import ModelEnv
from torchrl_gn.envs.episode_ends import alive_of, imagined_steps
from torchrl_gn.envs.starts import for_learning
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.frozen_weights import frozen
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP, renormalize
from torchrl_gn.objectives.checks import read_entries
from torchrl_gn.planners import BoundedPolicy, StateValue
from torchrl_gn.planners.plan import check_pessimism


class SHACLoss(LossModule):
    r"""Losses of a short-horizon actor-critic (SHAC, Xu et al. 2022) through a learned model.

    From states of played episodes the policy acts for ``H`` steps in the model, :math:`a_k \sim \pi(\cdot | s_k)`,
    :math:`s_{k+1} = g(s_k, a_k)`. Each action maximises the return from its own step on,

    .. math::
        G_k = r_k + \gamma \big((1 - \lambda_\pi) V(s_{k+1}) + \lambda_\pi G_{k+1}\big), \quad G_H = V(s_H),

    and the entropy :math:`\alpha \mathcal{H}(\pi)`, with reparameterised actions, differentiated through model, reward
    and value: the paper's SVG(:math:`H`), on states and with V instead of Q. With :math:`\lambda_\pi = 1`, as in SHAC,
    the gradient goes through all steps; behind contacts it is mostly noise, and the value, which is smooth, is the
    better guide beyond the next few. The value regresses on TD(:math:`\lambda`) targets of the same steps. The weight
    :math:`\alpha` is learned, so that the entropy of actions, in units of half their range, stays at
    ``target_entropy`` (as in SAC). Where the model diverges the episode ends, at what it costs a learner
    (:class:`~torchrl_gn.envs.SceneEnv`). Steps after the end of an episode do not count.

    In an ensemble every state is imagined from by every one of its ``K`` members, with the same noise of the actions:
    ``K B`` trajectories. The policy maximises the mean of their returns less ``pessimism`` standard deviations.

    Reads ``state`` ``[B, N, 13]`` and, for a policy and value with a target, ``target`` ``[B, 3]``. Writes
    ``loss_actor``, ``loss_value`` and ``loss_alpha``, each with gradients to weights of its own; ``reward``, the mean
    of imagined steps, and ``entropy``; and ``imagined`` ``[K B, H]``, for further steps of the value by
    :meth:`value_loss`.

    Args:
        policy: its network and standard deviations are learned.
        value: gives the discount :math:`\gamma`.
        env: imagines the steps. No gradient reaches the weights of its model or reward.
        steps: ``H``, of actions.
        action_repeat: steps of the model under each action, which pay the sum of their rewards: the control step of
            policy and value is so many of the model's.
        lmbda: :math:`\lambda` of the value's targets.
        policy_lmbda: :math:`\lambda_\pi` of the policy's returns.
        outlier: gradients in states and actions of one trajectory that are longer than so many times the batch's median
            are shortened to it at every control step. In contacts they grow from step to step, in some trajectories a
            thousandfold, and a batch's gradient is theirs alone; but what is shortened is biased. ``inf``: none are.
        target_entropy: default: minus one for every component of an action.
        pessimism: needs an ensemble; negative: explore what its members disagree on.

    Raises:
        ValueError: an option is out of range, or policy, value and environment do not fit together.
    """

    env: ModelEnv
    _estimator: TDLambdaEstimator

    def __init__(
        self,
        policy: BoundedPolicy,
        value: StateValue,
        env: ModelEnv,
        *,
        steps: int = 5,
        action_repeat: int = 1,
        lmbda: float = 0.95,
        policy_lmbda: float = 0.6,
        outlier: float = 3.0,
        target_entropy: float | None = None,
        pessimism: float = 0.0,
    ) -> None:
        super().__init__()
        for name, count in (("steps", steps), ("action_repeat", action_repeat)):
            if count < 1 or count != int(count):
                raise ValueError(f"{name}={count} must be a whole number of at least 1.")
        if not outlier > 0:
            raise ValueError(f"outlier={outlier} must be above 0.")
        for name, share in (("lmbda", lmbda), ("policy_lmbda", policy_lmbda)):
            if not 0 <= share <= 1:
                raise ValueError(f"{name}={share} must be from 0 to 1.")
        if env.terminal is not None:
            raise ValueError(f"{env} adds a value to its rewards: leave its terminal= out, this loss has value=.")
        for network in (policy, value):
            if network.scene.node_names != env.scene.node_names:
                raise ValueError(
                    f"{type(network).__name__} is of scene {network.scene.name!r}, not {env.scene.name!r}."
                )
            if abs(action_repeat * env.scene.timestep - network.scene.timestep) > 1e-9:
                raise ValueError(
                    f"{type(network).__name__} is for control steps of {network.scene.timestep:g} s, action_repeat="
                    f"{action_repeat} of the model's {env.scene.timestep:g} s is another."
                )
        check_pessimism(pessimism, env)
        wanted = getattr(env.reward, "target_shape", None)
        if not (policy.targeted == value.features.target == (wanted is not None)):
            raise ValueError(
                f"Policy, value and reward must all have a target, or none: target={policy.targeted},"
                f" {value.features.target} and {wanted}."
            )
        self.targeted = policy.targeted
        self.policy, self.value, self.steps, self._fitted = policy, value, int(steps), False
        self.action_repeat, self.policy_lmbda, self.outlier = int(action_repeat), float(policy_lmbda), float(outlier)
        self.pessimism, self.members = pessimism, env.members
        self.log_alpha = nn.Parameter(torch.tensor(math.log(1e-2)))
        self.target_entropy = float(-policy.scene.num_actions if target_entropy is None else target_entropy)
        # Not registered, so that the model's weights stay out of parameters().
        object.__setattr__(self, "env", cast(ModelEnv, for_learning(env)).by_member())
        network = TensorDictModule(value.of_features, ["features"], ["state_value"])
        estimator = TDLambdaEstimator(gamma=value.discount, lmbda=lmbda, value_network=network)
        object.__setattr__(self, "_estimator", estimator)

    @without_autocast
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        state, *targets = read_entries(self, tensordict, ["state", "target"] if self.targeted else ["state"])
        if not self._fitted:
            if not (self.policy.fitted and self.value.fitted):
                raise RuntimeError("Normalisers of policy or value have seen no data: call fit_normalizers first.")
            self._fitted = True  # asking waits for a device
        target = targets[0].repeat(self.members, 1) if targets else None
        imagined, entropies = self._imagine(state, target)
        reward, alive = imagined["next", "reward"], alive_of(imagined["next", "terminated"])
        states = torch.cat((imagined["state"], imagined["next", "state"][:, -1:]), 1)
        place = None if target is None else target.unsqueeze(1).expand(*states.shape[:2], 3)
        features = self.value.features(states, next(self.value.members.parameters()).dtype, place)
        with frozen(self.value):
            values = self.value.of_features(features[:, 1:]).to(reward.dtype)
        alive = alive.to(reward.dtype)
        counted = alive[:, :-1] / alive[:, :-1].mean()
        entropy = (counted.squeeze(-1) * entropies).mean()
        returns = self._returns(reward, values, alive)
        returns = lower_bound(returns.unflatten(0, (self.members, -1)), self.pessimism)
        alpha, scale = self.log_alpha.exp(), self.value.normalizer.std.to(reward.dtype)
        learned = self._value_batch(imagined, features.detach(), alive[:, :-1])
        return TensorDict(
            {
                "loss_actor": -(returns / scale).mean() - alpha.detach() * entropy,
                "loss_value": self.value_loss(learned),
                "loss_alpha": alpha * (entropy.detach() - self.target_entropy),
                "reward": (counted * reward.detach()).mean(),
                "entropy": entropy.detach(),
                "imagined": learned,
            }
        )

    def value_loss(self, imagined: TensorDictBase) -> Tensor:
        """Squared error of the value on its targets, in variances of its normaliser.

        Args:
            imagined: ``[*B]`` of the steps that the loss wrote: ``features`` ``[*B, F]``, ``target`` ``[*B, 1]`` and
                ``weight`` ``[*B, 1]``.
        """
        error = self.value.normalized(cast(Tensor, imagined["features"])) - imagined["target"]
        return (imagined["weight"] * error.square()).mean()

    def _returns(self, reward: Tensor, values: Tensor, alive: Tensor) -> Tensor:
        """Discounted returns ``[K B, 1]`` from the first step, whose gradient is that of every action's own return.

        What a later return owes to earlier actions is taken off where the policy reads the state (:meth:`_imagine`).
        """
        discount, share = self.value.discount, self.policy_lmbda
        later = discount * alive[:, 1:] * values
        own = alive[:, :-1] * reward + (1 - share) * later
        learned = own.sum(1) + share * later[:, -1]
        weight = discount ** torch.arange(self.steps, dtype=reward.dtype, device=reward.device).unsqueeze(-1)
        total = (weight * alive[:, :-1] * reward).sum(1) + weight[-1] * later[:, -1]
        return total.detach() + learned - learned.detach()

    @without_autocast
    def fit_normalizers(self, state: Tensor, reward: Tensor | None = None, target: Tensor | None = None) -> None:
        """Add states ``[*B, N, 13]`` to the normalisers; scale values, and the loss, by rewards ``[*B, 1]`` for ever.

        The value stays what it is: :func:`~torchrl_gn.networks.layer_norm_mlp.renormalize`.
        """
        for network in (self.policy, self.value):
            network.features.update(state, *(() if target is None else (target,)))
        if reward is not None:
            members = cast(list[LayerNormMLP], list(self.value.members))
            returns = reward / max(1 - self.value.discount, 1e-3)
            renormalize(members, self.value.normalizer, returns, constant=1.0)  # until something is paid

    def _imagine(self, state: Tensor, target: Tensor | None = None) -> tuple[TensorDict, Tensor]:
        """Control steps ``[K B, H]`` of the policy in the model, and estimates ``[K B, H]`` of its actions' entropy."""
        state = state.repeat(self.members, 1, 1)
        # Not reset(), which asks whether an episode has ended: it would wait for a device.
        start = self.env._reset(TensorDict({"state": state.detach()}, [len(state)]), set_state=True)
        env, now = self.env.of_states(), start.copy()
        states, actions, ended, entropies = [cast(Tensor, now["state"])], [], [], []
        if target is not None:
            start["task"] = cast(Any, self.env.reward).task_of(state, target)
        with ExitStack() as stack:
            for each in (self.env.world_model, self.env.reward):
                if isinstance(each, nn.Module):
                    stack.enter_context(frozen(each))
            stack.enter_context(self.policy.prepared())
            stack.enter_context(set_exploration_type(ExplorationType.RANDOM))
            for _ in range(self.steps):
                # All that follows reaches earlier actions through this; what they are paid and valued by does not.
                state = _Scaled.apply(states[-1], self.policy_lmbda * self.value.discount)
                now = now.set("state", state)
                action, log_prob = self.policy.sample(cast(Tensor, state), self.members, target)
                for each in (state, action):
                    if each.requires_grad:  # neither under no_grad, nor of a frozen policy
                        each.register_hook(self._calmed)
                entropies.append(-log_prob)
                for _ in range(self.action_repeat):
                    now = env.step(now.set("action", action))
                    actions.append(action)
                    ended.append(now["next", "terminated"].squeeze(-1))
                    now = step_mdp(now, exclude_done=True)
                    states.append(cast(Tensor, now["state"]))
            states, actions = torch.stack(states, 1), torch.stack(actions, 1)
            # The rewards of all steps at once: as many small operations as for one.
            imagined = imagined_steps(self.env, start, states, actions, ~torch.stack(ended, 1))
        each, rewards = self.action_repeat, imagined.rewards.unflatten(1, (self.steps, -1)).sum(2)
        after = {"state": states[:, each::each], "reward": rewards, "terminated": ~imagined.alive[:, each::each]}
        entries = {"state": states[:, :-1:each], "action": actions[:, ::each], "next": after}
        return TensorDict(entries, [len(states), self.steps]), torch.stack(entropies, 1)

    def _calmed(self, gradient: Tensor) -> Tensor:
        """The gradient ``[B, ...]`` without what overflowed, and with outliers shortened, sample by sample."""
        gradient = _finite_rows(gradient)
        if self.outlier == math.inf:
            return gradient
        lengths = gradient.flatten(1).norm(dim=1)
        # The median of those that are not 0, without waiting for a device.
        middle = len(lengths) - 1 - torch.div((lengths > 0).sum(), 2, rounding_mode="floor")
        bound = self.outlier * lengths.sort().values.gather(0, middle.clamp(min=0).unsqueeze(0))
        factor = (bound / torch.where(lengths > 0, lengths, 1.0)).clamp(max=1.0)
        return gradient * factor.view(-1, *[1] * (gradient.ndim - 1))

    @torch.no_grad()
    def _value_batch(self, imagined: TensorDict, features: Tensor, alive: Tensor) -> TensorDict:
        """What :meth:`value_loss` reads, of features ``[K B, H + 1, F]`` of the imagined steps' states."""
        reward, terminated = imagined["next", "reward"].to(features.dtype), imagined["next", "terminated"]
        done = terminated.clone()
        done[:, -1] = True  # imagination ends
        after = {"features": features[:, 1:], "reward": reward, "terminated": terminated, "done": done}
        batch = TensorDict({"features": features[:, :-1], "next": after}, imagined.shape)
        self._estimator.vectorized = features.is_cpu  # which looks for ends: it would wait for a device
        targets = self.value.normalizer(cast(Tensor, self._estimator.value_estimate(batch)))
        entries = {"features": features[:, :-1], "target": targets, "weight": alive}
        return TensorDict(entries, imagined.shape)


class _Scaled(torch.autograd.Function):
    """A tensor as it is, whose gradient is scaled."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, scale: float) -> Tensor:
        ctx.scale = scale
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:
        return ctx.scale * gradients[0], None


def _finite_rows(gradient: Tensor) -> Tensor:
    """The gradient ``[B, ...]`` without those samples that it overflowed for: one must not spoil a whole batch."""
    finite = gradient.flatten(1).isfinite().all(1)
    return gradient.where(finite.view(-1, *[1] * (gradient.ndim - 1)), 0.0)
