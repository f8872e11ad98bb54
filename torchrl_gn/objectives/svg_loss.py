"""Stochastic value gradients of a policy, through a learned model or without one."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, cast

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import DDPGLoss

from torchrl_gn.checks import check_count
from torchrl_gn.envs.specs import checked_end, require_shape
from torchrl_gn.networks.frozen_weights import frozen, with_weights
from torchrl_gn.objectives.checks import require_fitted, require_some, require_unpadded
from torchrl_gn.objectives.observation_model_loss import UPDATE_NORMALIZERS

ObservedReward = Callable[[Tensor, Tensor, Tensor], Tensor]  # observations, actions, next observations to [*B, 1]


class SVGLoss(DDPGLoss):
    r"""Losses of SVG(N) (paper, SM "SVG"): TorchRL's DDPG with a stochastic policy and model rollouts.

    The policy maximises, from observations :math:`x_t` of the replay buffer,

    .. math::
        \mathbb{E}\Big[\sum_{k=0}^{N-1} \gamma^k r(x_{t+k}, a_{t+k}, x_{t+k+1}) + \gamma^N Q(x_{t+N}, a_{t+N})\Big],
        \quad a_{t+k} \sim \pi(\cdot | x_{t+k}), \quad x_{t+k+1} = g(x_{t+k}, a_{t+k})

    with reparameterised actions. ``steps=0`` is the model-free SVG(0), and DDPG with a deterministic policy. Rewards
    and value after an imagined end, ``done``, do not count. (The paper's last action :math:`a_t` is a misprint.) The
    value's loss is DDPG's with actions drawn from the target policy. Input, output and ``make_value_estimator``
    (gamma) are DDPG's.

    ``loss_actor`` has gradients in the policy's weights, through model, reward and value. ``loss_value`` has gradients
    in the value's weights. Model and reward are not submodules: they get no gradient, and ``parameters()`` and ``to()``
    leave them out.

    Args:
        value_network: TensorDict module that writes ``state_action_value``.
        model: TensorDict module from observation and action to ``("next", observation)``, for example an
            :class:`~torchrl_gn.policies.ObservationModel`. Other inputs of policy and value (a goal) stay constant.
        steps: ``N``, steps through the model.
        done: function of imagined next observations ``[*B, O]`` that returns where episodes end, bool ``[*B]`` or
            ``[*B, 1]``. Default: nowhere.
        **options: options of :class:`~torchrl.objectives.DDPGLoss`.
    """

    deterministic_sampling_mode: Any = ExplorationType.RANDOM  # actions are drawn
    model: TensorDictModuleBase | None
    reward: ObservedReward | None
    ends: Callable[[Tensor], Tensor] | None

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        model: TensorDictModuleBase | None = None,
        reward: ObservedReward | None = None,
        *,
        steps: int = 1,
        done: Callable[[Tensor], Tensor] | None = None,
        **options: Any,
    ) -> None:
        check_count("steps", steps, 0)
        if steps and (model is None or reward is None):
            raise ValueError(f"steps={steps} need a model and a reward; use steps=0 without.")
        if steps and model is not None:
            predicted = {unravel_key(key)[1:] for key in model.out_keys}
            for name, network in (("policy", actor_network), ("value", value_network)):
                read = {key if isinstance(key, tuple) else (key,) for key in map(unravel_key, network.in_keys)}
                if not read & predicted:
                    raise ValueError(
                        f"The model predicts {sorted(predicted)}, but the {name} reads only {sorted(read)}."
                    )
        super().__init__(actor_network, value_network, **options)
        self.steps = steps
        self._share_statistics()
        # Not registered, so that their weights stay out of parameters().
        object.__setattr__(self, "model", model)
        object.__setattr__(self, "reward", reward)
        object.__setattr__(self, "ends", done)

    def _share_statistics(self) -> None:
        """Let target networks read the buffers of their originals, since TorchRL's updaters copy only weights."""
        for name in ("actor_network", "value_network"):
            target = cast("TensorDictBase | None", self._modules.get(f"target_{name}_params"))
            if target is not None:
                own = cast(TensorDictBase, self._modules[f"{name}_params"])
                for buffer, _ in getattr(self, name).named_buffers(remove_duplicate=False):
                    key = tuple(buffer.split("."))
                    target.set(key, own.get(key))

    def __setstate__(self, state: dict[str, Any]) -> None:
        # TensorDicts copy their tensors apart from the networks of a copied or unpickled loss: take the networks' own.
        super().__setstate__(state)
        self._cache = {}
        for name in ("actor_network", "value_network"):
            own, network = cast(TensorDictBase, self._modules[f"{name}_params"]), getattr(self, name)
            for entry, tensor in (
                *network.named_parameters(remove_duplicate=False),
                *network.named_buffers(remove_duplicate=False),
            ):
                key = tuple(entry.split("."))
                trained = own.get(key).requires_grad  # False for layers that the policy's loss trains
                own.set(key, tensor if tensor.requires_grad == trained else tensor.detach())
        self._share_statistics()

    def _apply(self, fn, recurse: bool = True):
        # TorchRL casts and moves copies of the networks' buffers: restore the networks' own.
        super()._apply(fn)
        for name in ("actor_network", "value_network"):
            own = cast(TensorDictBase, self._modules[f"{name}_params"])
            for buffer, tensor in getattr(self, name)._apply(fn).named_buffers(remove_duplicate=False):
                own.set(tuple(buffer.split(".")), tensor)
        self._share_statistics()
        return self

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict]:
        self._require_usable(tensordict)
        with set_exploration_type(self.deterministic_sampling_mode):  # forward sets it too; direct calls do not
            return super().loss_value(tensordict)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict]:
        """Return the policy's loss.

        RuntimeError if normalisers of policy, value or model have seen no data; ValueError for padding or an empty
        batch.
        """
        self._require_usable(tensordict)
        weights = self._maybe_get_priority_weight(tensordict)
        keys = [*self.actor_in_keys, *self.value_exclusive_keys]
        now = tensordict.select(*keys, *self._carried, strict=False).detach()
        value, weight = cast("Tensor | float", 0.0), cast("Tensor | float", 1.0)  # weight: gamma^k, 0 after the end
        gamma = cast(Tensor, self.value_estimator.gamma) if self.steps else 1.0
        with set_exploration_type(self.deterministic_sampling_mode):
            for _ in range(self.steps):
                now, reward, alive = self._imagine(self._act(now))
                value = value + weight * reward
                weight = weight * gamma * alive
            now = self._act(now)
        # After the policy, not nested in it: layers that both share must have the value's weights here.
        with with_weights(self.value_network, self._cached_detached_value_params):
            now = self.value_network(now)
        value = value + weight * now.get(self.tensor_keys.state_action_value)
        loss = self._reduce_loss(-value.squeeze(-1), tensordict=tensordict, weights=weights)
        weak = [f"{target}{name}_network_params" for target in ("", "target_") for name in ("actor", "value")]
        self._clear_weakrefs(tensordict, loss, *weak)
        return loss, {}

    def _require_usable(self, tensordict: TensorDictBase) -> None:
        require_unpadded(type(self).__name__, tensordict)
        require_some(type(self).__name__, tensordict)
        model = [self.model] if self.steps and self.model is not None else []
        require_fitted(self, self.actor_network, self.value_network, *model, remedy=UPDATE_NORMALIZERS)

    def _act(self, now: TensorDictBase) -> TensorDictBase:
        with with_weights(self.actor_network, self.actor_network_params):
            return self.actor_network(now)

    @property
    def _carried(self) -> list[NestedKey]:
        """Model inputs that are carried from one imagined step to the next: all but the action."""
        keys = self.model.in_keys if self.steps and self.model is not None else []
        return [key for key in keys if key not in self.actor_network.out_keys]

    def _imagine(self, now: TensorDictBase) -> tuple[TensorDictBase, Tensor, Tensor | float]:
        """Return the next step's entries, the reward ``[*B, 1]``, and 1 where the episode goes on, 0 where it ended."""
        assert self.model is not None and self.reward is not None
        observation, action = (cast(Tensor, now.get(key)) for key in self.model.in_keys[:2])
        with ExitStack() as stack:
            for module in (self.model, self.reward):
                if isinstance(module, nn.Module):
                    stack.enter_context(frozen(module))
            predicted = cast(TensorDictBase, self.model(now.copy()).get("next"))
            after = cast(Tensor, predicted.get(self.model.in_keys[0]))
            reward = self.reward(observation, action, after)
        require_shape(reward, (*now.batch_size, 1), "the reward", self.reward)
        alive = 1.0 if self.ends is None else (~checked_end(self.ends(after), now.batch_size)).to(reward.dtype)
        # Inputs that are not predicted, a goal for example, stay constant.
        inputs = now.select(*self.actor_in_keys, *self.value_exclusive_keys, *self._carried, strict=False)
        return inputs.update(predicted), reward, alive
