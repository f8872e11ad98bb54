"""Short-horizon actor-critic: the policy's gradient through a learned model, with a value at the end."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule
from torchrl.objectives.value.functional import td_lambda_return_estimate

from torchrl_gn.checks import check_count
from torchrl_gn.dynamics.ensemble import check_pessimism, lower_bound
from torchrl_gn.envs import ModelEnv
from torchrl_gn.envs.episode_ends import alive_of, imagined_steps
from torchrl_gn.envs.starts import for_learning
from torchrl_gn.finite import require_finite
from torchrl_gn.maths.normalizer import unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.networks.frozen_weights import frozen
from torchrl_gn.networks.layer_norm_mlp import LayerNormMLP, renormalize
from torchrl_gn.objectives.checks import importance_weights, read_entries, require_some, require_unpadded
from torchrl_gn.policies import BoundedPolicy, StateValue
from torchrl_gn.scenes.articulation import require_bodies, require_same_nodes, require_timestep


class SHACLoss(LossModule):
    r"""Losses of a short-horizon actor-critic (SHAC, Xu et al. 2022) through a learned model.

    The policy acts for ``H`` steps in the model, from states of recorded episodes: :math:`a_k \sim \pi(\cdot | s_k)`,
    :math:`s_{k+1} = g(s_k, a_k)`. Each action maximises the return from its own step on,

    .. math::
        G_k = r_k + \gamma \big((1 - \lambda_\pi) V(s_{k+1}) + \lambda_\pi G_{k+1}\big), \quad G_H = V(s_H),

    and the entropy :math:`\alpha \mathcal{H}(\pi)`. Actions are reparameterised, and gradients flow through model,
    reward and value: this is the paper's SVG(:math:`H`), on states and with V instead of Q. With
    :math:`\lambda_\pi = 1`, as in SHAC, the gradient flows through all steps. After contacts this gradient is mostly
    noise, and the smooth value is the better guide beyond the next few steps. The value regresses on
    TD(:math:`\lambda`) targets of the same steps. The weight :math:`\alpha` is learned to keep the entropy of actions,
    in units of half their range, at ``target_entropy`` (as in SAC). If the model diverges, the episode ends with the
    unstable reward for learners (:class:`~torchrl_gn.envs.SceneEnv`). Steps after the end of an episode do not count.

    Each of an ensemble's ``K`` members predicts from every state, with the same noise of the actions: ``K B``
    trajectories. The policy maximises the members' mean return minus ``pessimism`` standard deviations.

    Input: ``state`` ``[*B, N, 13]`` and, if policy and value have a target, ``target`` ``[*B, 3]``. Entries that the
    model or the environment's ``done`` reads start imagination, too, if they are there: physical parameters (default:
    the scene's) and a hidden state (default: the initial one).

    ``priority_weight`` ``[*B]``, as a ``PrioritizedSampler`` gives it, weights the means over the states.

    Output: ``loss_actor``, ``loss_value`` and ``loss_alpha``, each with gradients to its own weights; ``reward``, the
    mean over imagined steps; ``entropy``; and ``imagined`` ``[K B, H]``, with ``B`` states in all, for further updates
    of the value with :meth:`value_loss`.

    Args:
        policy: policy to train, with its standard deviations.
        value: value to train; its discount is :math:`\gamma`.
        env: environment that predicts the control steps; its ``action_repeat`` makes them longer than the model's. No
            gradient reaches the weights of its model or reward.
        steps: ``H``, number of actions.
        lmbda: :math:`\lambda` of the value's targets.
        policy_lmbda: :math:`\lambda_\pi` of the policy's returns.
        outlier: at every control step, clip the norm of each trajectory's gradient in states and actions to this many
            times the batch's median norm. In contacts gradients grow from step to step, in some trajectories a
            thousandfold, and these would dominate the batch. Clipping biases the gradient. ``inf``: no clipping.
        target_entropy: target of the actions' entropy. Default: minus the number of an action's components.
        pessimism: standard deviations to subtract from the mean return; only 0 without an ensemble. Negative values
            explore where the members disagree.

    Raises:
        ValueError: if an option is out of range, or policy, value and environment do not fit together.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change."""

        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    env: ModelEnv

    def __init__(
        self,
        policy: BoundedPolicy,
        value: StateValue,
        env: ModelEnv,
        *,
        steps: int = 5,
        lmbda: float = 0.95,
        policy_lmbda: float = 0.6,
        outlier: float = 3.0,
        target_entropy: float | None = None,
        pessimism: float = 0.0,
    ) -> None:
        super().__init__()
        check_count("steps", steps, 1)
        if not outlier > 0:
            raise ValueError(f"outlier={outlier} must be above 0.")
        for name, share in (("lmbda", lmbda), ("policy_lmbda", policy_lmbda)):
            if not 0 <= share <= 1:
                raise ValueError(f"{name}={share} must be from 0 to 1.")
        if env.terminal is not None:
            raise ValueError(f"{env} adds a value to its rewards: leave its terminal= out, this loss has value=.")
        scene = require_bodies(env.scene, type(self).__name__)
        for network in (policy, value):
            require_same_nodes(scene, network.scene, f"{type(network).__name__}")
            require_timestep(scene, network.scene.timestep, f"{type(network).__name__}")
        policy.require_actions(scene)
        check_pessimism(pessimism, env.members)
        wanted = getattr(env.reward, "target_shape", None)
        if not (policy.targeted == value.features.target == (wanted is not None)):
            raise ValueError(
                f"Policy, value and reward must all have a target, or none: target={policy.targeted},"
                f" {value.features.target} and {wanted}."
            )
        self.targeted = policy.targeted
        self.policy, self.value, self.steps, self._fitted = policy, value, int(steps), False
        self.lmbda, self.policy_lmbda, self.outlier = float(lmbda), float(policy_lmbda), float(outlier)
        self.pessimism, self.members = pessimism, env.members
        self.log_alpha = nn.Parameter(torch.tensor(math.log(1e-2)))
        self.target_entropy = float(-policy.scene.num_actions if target_entropy is None else target_entropy)
        # Not registered, so that the model's weights stay out of parameters().
        object.__setattr__(self, "env", cast(ModelEnv, for_learning(env)).by_member())

    @property
    def in_keys(self) -> list[NestedKey]:
        return ["state", "target"] if self.targeted else ["state"]

    def _starts(self, tensordict: TensorDictBase) -> tuple[TensorDict, Tensor | None]:
        """Return the entries from which imagination starts ``[K B]``, and the targets ``[K B, 3]``."""
        state, *targets = read_entries(self, tensordict, self.in_keys)
        require_some(type(self).__name__, tensordict, state)
        count, env, known = math.prod(state.shape[:-2]), self.env, ("state", "action", "reward", "target")
        read = [key for each in (env.world_model, env.ends) for key in getattr(each, "in_keys", ()) if key not in known]
        if env.parameters_key is None:
            env.predictor.parameters_in(tensordict)  # refuses other variants; their entries are gone below
        extra = tensordict.select(*read, strict=False).detach()
        if not extra.is_empty():  # a batch of states alone may have no batch size
            extra = extra.reshape(count)
        entries = {**extra, "state": state.detach().reshape(count, *state.shape[-2:])}
        starts, target = TensorDict(entries, [count]), targets[0].reshape(count, 3) if targets else None
        if self.members > 1:
            starts = cast(TensorDict, torch.cat(cast(Any, [starts] * self.members)))
            target = None if target is None else target.repeat(self.members, 1)
        return starts, target

    @property
    def out_keys(self) -> list[str]:
        return ["loss_actor", "loss_value", "loss_alpha", "reward", "entropy", "imagined"]

    @without_autocast
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        require_unpadded(type(self).__name__, tensordict)
        starts, target = self._starts(tensordict)
        if not self._fitted:
            if not (self.policy.fitted and self.value.fitted):
                raise RuntimeError("Normalisers of policy or value have seen no data: call fit_normalizers first.")
            self._fitted = True  # check once: it waits for a device
        imagined, entropies = self._imagine(starts, target)
        reward, alive = imagined["next", "reward"], alive_of(imagined["next", "terminated"])
        states = torch.cat((imagined["state"], imagined["next", "state"][:, -1:]), 1)
        place = None if target is None else target.unsqueeze(1).expand(*states.shape[:2], 3)
        features = self.value.features(states, next(self.value.members.parameters()).dtype, place)
        with frozen(self.value):
            values = self.value.of_features(features[:, 1:]).to(reward.dtype)
        alive = alive.to(reward.dtype)
        share = self._shares(tensordict, alive)
        weight = share * alive[:, :-1]
        counted = weight / weight.mean()
        entropy = (counted.squeeze(-1) * entropies).mean()
        returns = self._returns(reward, values, alive)
        returns = lower_bound(returns.unflatten(0, (self.members, -1)), self.pessimism)
        alpha, scale = self.log_alpha.exp(), self.value.normalizer.std.to(reward.dtype)
        learned = self._value_batch(imagined, features[:, :-1].detach(), values.detach(), weight)
        return TensorDict(
            {
                "loss_actor": -(share[: len(returns), 0] * returns / scale).mean() - alpha.detach() * entropy,
                "loss_value": self.value_loss(learned),
                "loss_alpha": alpha * (entropy.detach() - self.target_entropy),
                "reward": (counted * reward.detach()).mean(),
                "entropy": entropy.detach(),
                "imagined": learned,
            }
        )

    def _shares(self, tensordict: TensorDictBase, alive: Tensor) -> Tensor:
        """Return factors ``[K B, 1, 1]`` of mean 1 by which trajectories count; 1 without importance weights."""
        state = cast(Tensor, tensordict["state"])
        weights = importance_weights(self, tensordict, state.shape[:-2])
        if weights is None:
            return alive.new_ones(1, 1, 1).expand(len(alive), 1, 1)
        weights = weights.to(alive.dtype).reshape(-1, 1, 1)
        return (weights / weights.mean()).repeat(self.members, 1, 1)

    def value_loss(self, imagined: TensorDictBase) -> Tensor:
        """Return the squared error of the value on its targets, in variances of its normaliser.

        Args:
            imagined: ``[*B]`` steps of the loss's ``imagined``: ``features`` ``[*B, F]``, ``target`` ``[*B, 1]`` and
                ``weight`` ``[*B, 1]``.
        """
        error = self.value.normalized(cast(Tensor, imagined["features"])) - imagined["target"]
        return (imagined["weight"] * error.square()).mean()

    def _returns(self, reward: Tensor, values: Tensor, alive: Tensor) -> Tensor:
        """Return discounted returns ``[K B, 1]`` from the first step, with the gradient of each action's own return.

        :meth:`_imagine` discounts the gradient of later returns in earlier actions, where the policy reads the state.
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
        """Add states ``[*B, N, 13]`` to the normalisers; scale values and the loss by rewards ``[*B, 1]``.

        The scale is the scale of returns that repeat one reward for ever. The value's predictions do not change:
        :func:`~torchrl_gn.networks.layer_norm_mlp.renormalize`. After an error all is as before.

        Raises:
            ValueError: if a shape does not fit, a number is not finite, or there is no state or reward.
        """
        require_finite(state, "The state")
        if not state.numel():
            raise ValueError(f"There is no state in {list(state.shape)} to fit normalisers to.")
        if reward is not None:
            if reward.shape[-1:] != (1,) or not reward.numel():
                raise ValueError(f"Rewards must be [*B, 1], at least one, got {list(reward.shape)}.")
            require_finite(reward, "The reward")
        with unchanged_on_error(self.policy, self.value):
            for network in (self.policy, self.value):
                network.features.update(state, *(() if target is None else (target,)))
            if reward is not None:
                members = cast(list[LayerNormMLP], list(self.value.members))
                returns = reward / max(1 - self.value.discount, 1e-3)
                renormalize(members, self.value.normalizer, returns, constant=1.0)  # 1 while rewards do not vary

    def _imagine(self, starts: TensorDict, target: Tensor | None = None) -> tuple[TensorDict, Tensor]:
        """Return control steps ``[K B, H]`` of the policy in the model, and estimates ``[K B, H]`` of its entropy."""
        # Not reset(): its check for ended episodes waits for a device.
        start = starts.update(self.env._reset(starts, set_state=True))
        env, now = self.env.of_states(), start.copy()
        states, actions, ended, entropies = [cast(Tensor, now["state"])], [], [], []
        if target is not None:
            start["task"] = cast(Any, self.env.reward).task_of(start["state"], target)
        with ExitStack() as stack:
            for each in (self.env.world_model, self.env.reward):
                if isinstance(each, nn.Module):
                    stack.enter_context(frozen(each))
            stack.enter_context(self.policy.prepared())
            stack.enter_context(set_exploration_type(ExplorationType.RANDOM))
            for _ in range(self.steps):
                # Policy and model read this copy: later returns reach earlier actions through it, scaled once a step.
                # Rewards and values read the original, so that each action's own return is not scaled.
                state = _Scaled.apply(states[-1], self.policy_lmbda * self.value.discount)
                now = now.set("state", state)
                action, log_prob = self.policy.sample(cast(Tensor, state), self.members, target)
                for each in (state, action):
                    if each.requires_grad:  # False under no_grad and for a frozen policy
                        each.register_hook(self._without_outliers)
                entropies.append(-log_prob)
                for _ in range(self.env.action_repeat):
                    after = env._step(now.set("action", action))  # step() also checks entries, a fifth of its time
                    actions.append(action)
                    ended.append(cast(Tensor, after["terminated"]).squeeze(-1))
                    states.append(cast(Tensor, after["state"]))
                    now = now.update(after.exclude("reward", "done", "terminated"))
            states, actions = torch.stack(states, 1), torch.stack(actions, 1)
            # Compute the rewards of all steps at once, with as many small operations as for one step.
            imagined = imagined_steps(self.env, start, states, actions, ~torch.stack(ended, 1))
        states, terminated = imagined.states, ~imagined.alive[:, 1:]
        after = {"state": states[:, 1:], "reward": imagined.rewards, "terminated": terminated}
        entries = {"state": states[:, :-1], "action": actions[:, :: self.env.action_repeat], "next": after}
        return TensorDict(entries, [len(states), self.steps]), torch.stack(entropies, 1)

    def _without_outliers(self, gradient: Tensor) -> Tensor:
        """Zero non-finite gradients ``[B, ...]`` and clip outliers, per sample."""
        gradient = _finite_rows(gradient)
        if self.outlier == math.inf:
            return gradient
        lengths = gradient.flatten(1).norm(dim=1)
        # Index of the non-zero lengths' median, without waiting for a device.
        middle = len(lengths) - 1 - torch.div((lengths > 0).sum(), 2, rounding_mode="floor")
        bound = self.outlier * lengths.sort().values.gather(0, middle.clamp(min=0).unsqueeze(0))
        factor = (bound / torch.where(lengths > 0, lengths, 1.0)).clamp(max=1.0)
        return gradient * factor.view(-1, *[1] * (gradient.ndim - 1))

    @torch.no_grad()
    def _value_batch(self, imagined: TensorDict, features: Tensor, values: Tensor, weight: Tensor) -> TensorDict:
        """Build the input of :meth:`value_loss`: features ``[K B, H, F]``, next values ``[K B, H, 1]``."""
        reward, terminated = imagined["next", "reward"], imagined["next", "terminated"]
        done = terminated.clone()
        done[:, -1] = True  # imagination ends
        returns = td_lambda_return_estimate(self.value.discount, self.lmbda, values, reward, done, terminated)
        entries = {"features": features, "target": self.value.normalizer(returns, features.dtype), "weight": weight}
        return TensorDict(entries, imagined.shape)


class _Scaled(torch.autograd.Function):
    """Identity that scales the gradient."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, scale: float) -> Tensor:
        ctx.scale = scale
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor, None]:
        return ctx.scale * gradients[0], None


def _finite_rows(gradient: Tensor) -> Tensor:
    """Zero non-finite gradients ``[B, ...]`` per sample, as one must not spoil the batch."""
    finite = gradient.flatten(1).isfinite().all(1)
    return gradient.where(finite.view(-1, *[1] * (gradient.ndim - 1)), 0.0)
