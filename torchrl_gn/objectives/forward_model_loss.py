"""Loss of a forward model, over one step or unrolled over several."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_gn.checks import check_count
from torchrl_gn.dynamics import BoundPredictor, ForwardModel, SpecializedPredictor
from torchrl_gn.dynamics.bound import update_dynamic_normalizers, update_parameter_normalizers
from torchrl_gn.dynamics.predictor import check_shapes, require_bound
from torchrl_gn.dynamics.program import PreparedStep
from torchrl_gn.finite import require_finite
from torchrl_gn.maths import Normalizer, quaternion
from torchrl_gn.maths.normalizer import unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.objectives.checks import (
    collected_mask,
    ends_of,
    importance_weights,
    read_entries,
    require_consecutive,
    require_fitted,
    require_some,
    require_steps,
    usable_by_autograd,
)
from torchrl_gn.objectives.episodes_in_rows import Starts, choose, fill_padding, forget, require_constant, starts_of

FIT_NORMALIZERS = (
    "Call fit_normalizers(transitions) of the loss with thousands of clean transitions [B], once before training;"
    " trajectory_buffer(trajectories, batch_size=5000).sample() draws them."
)

_CORRECTED = 128  # number of a batch's states at which the correction of known physics is penalised


class ForwardModelLoss(LossModule):
    r"""Squared error of predicted state changes (paper, SM "Training algorithms" and "Loss").

    The target is the change from the *noisy* input state to the clean next state. In a window the model is fed true
    states for ``teacher_forced_steps`` (paper, SM "Recurrent one-step predictions": always), then its own predictions;
    its hidden state is carried along. Each component's error is divided by the variance of its change in this scene,
    and the loss is the mean over components. The error of orientations is :math:`1 - (q_e \cdot q_p)^2` of the *change*
    quaternions (the paper's formula as printed is not zero for equal ones).

    Robots move slowly most of the time and fast at times. Samples of fast motion then dominate the mean of squared
    errors. With a ``size_floor`` :math:`c`, each sample's errors are multiplied by :math:`(1 + c) / (c + s)`. Here
    :math:`s` is the mean square of the predicted change in the same units, about 1 on average. It is not
    differentiated. The factor depends only on the input, so noisy targets cause no bias.

    Gradients reach the model's weights through the whole window, or through ``bptt_steps`` of it.

    Args:
        noise: standard deviation of the input noise, in standard deviations of each movable state channel (radians for
            orientations).
        generator: source of the noise. Default: torch's global generator, with which a run cannot resume bit for bit.
        teacher_forced_steps: steps at the start of a window that are fed the true state, with noise.
        bptt_steps: steps between which states and hidden states are detached (truncated backpropagation through time);
            errors of the whole window count. Default: never.
        channel_weights: ``[N, 12]`` (or broadcast) factors of each channel's squared error, for example below 1 where
            measurement noise makes up most of a step's change. Default: all 1.
        size_floor: mean square below which changes count as equally small. Default (paper): all samples count alike.
        residual_weight: factor of a penalty on the correction of known physics, squared like an error, at up to 128 of
            the batch's states under other samples' actions. The penalty keeps a residual model from learning the
            controller of a log under feedback control as dynamics, and keeps it near the physics where the log has no
            data.
        residual_noise: standard deviation of the noise on those states, like ``noise``.

    Input: ``state`` ``[B, N, 13]`` or ``[B, H, N, 13]`` with ``H`` consecutive steps, ``action`` ``[B, (H,) A]``,
    ``("next", "state")`` like ``state``, and physical parameters ``[B, (H)]``, constant in a window, if the model reads
    them. With ``done``, ``terminated`` or ``truncated`` ``[B, H, 1]`` under ``"next"``, as collected, predictions
    restart from the true state after each end; rows that go on elsewhere without one raise ValueError.
    Padding that TorchRL's ``("collector", "mask")`` marks does not count. With ``priority_weight`` ``[B]`` or
    ``[B, H]``, as a ``PrioritizedSampler`` gives it, means are weighted, and each step's loss is written to the batch
    as ``td_error`` ``[B, (H,) 1]``, for ``update_tensordict_priority``.

    Output: ``loss_forward_model`` and the detached ``error_<component>``, scalars.

    Call :meth:`fit_normalizers` once before training; for a trained model on another scene, call :meth:`fit_scales`.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change; ``state`` is also read under ``"next"``, ``done`` only there."""

        state: NestedKey = "state"
        action: NestedKey = "action"
        done: NestedKey = "done"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    model: BoundPredictor
    noise_scale: Tensor
    error_weight: Tensor
    channel_scale: Tensor | None

    def __init__(
        self,
        model: BoundPredictor,
        *,
        noise: float = 0.0,
        generator: torch.Generator | None = None,
        teacher_forced_steps: int = 1,
        bptt_steps: int | None = None,
        channel_weights: Tensor | None = None,
        size_floor: float | None = None,
        residual_weight: float = 0.0,
        residual_noise: float = 0.0,
    ) -> None:
        super().__init__()
        require_bound(model)
        sizes = {"noise": noise, "residual_weight": residual_weight, "residual_noise": residual_noise}
        for name, size in sizes.items():
            if not 0 <= size < math.inf:
                raise ValueError(f"{name}={size} must not be negative, NaN or infinite.")
        if size_floor is not None and not 0 < size_floor < math.inf:
            raise ValueError(f"size_floor={size_floor} must be above 0 and finite, or None for equal weights.")
        if isinstance(model, SpecializedPredictor):
            raise TypeError("A specialised model passes no gradient to the weights; train the bound model.")
        check_count("teacher_forced_steps", teacher_forced_steps, 1)  # the first state is a true one
        if bptt_steps is not None:
            check_count("bptt_steps", bptt_steps, 1)
        if residual_weight and model.model.physics is None:
            raise ValueError(f"residual_weight={residual_weight} is for models with physics=, which this one lacks.")
        self.model, self.noise, self.generator = model, noise, generator
        self.size_floor, self.residual_weight, self.residual_noise = size_floor, residual_weight, residual_noise
        self.teacher_forced_steps, self.bptt_steps = teacher_forced_steps, bptt_steps
        scale = torch.zeros(model.layout.delta_size, dtype=torch.float64, device=model.movable.device)
        self.register_buffer("noise_scale", scale)
        if channel_weights is not None:
            if not bool((channel_weights > 0).all()):
                raise ValueError("channel_weights must be above 0.")
            channel_weights = channel_weights.to(scale).sqrt().expand(model.movable.shape).clone()
        self.register_buffer("channel_scale", channel_weights, persistent=False)
        self.register_buffer("error_weight", scale - 1)  # negative: not fitted; None would be lost in a state_dict

    @property
    def trained(self) -> ForwardModel:
        """The model to train."""
        return self.model.model

    @property
    def reason(self) -> str | None:
        """Reason why torch operations compute this scene's loss; None if C++ does."""
        with torch.no_grad():
            return self.model.prepared_for_training().executor.reason

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        state, action, parameters = self.tensor_keys.state, self.tensor_keys.action, self.model.parameters_key
        return [state, action, unravel_key(("next", state)), *([] if parameters is None else [parameters])]

    @property
    def out_keys(self) -> list[str]:
        return ["loss_forward_model", *(f"error_{name}" for name in self.model.layout.names)]

    @torch.no_grad()
    @without_autocast
    def fit_normalizers(self, tensordict: TensorDictBase) -> None:
        """Fit the loss's scales and the model's normalisers to thousands of clean transitions ``[B]``.

        After an error they are as before.
        """
        model, tensordict = self.model, self._unpadded(tensordict)
        state, action, next_state = self._read(tensordict)
        parameters = self._read_parameters(tensordict) if model.model.parameter_source == "scene" else None
        with unchanged_on_error(self, model):
            noisy = self._fit_scales(state, next_state)
            update_parameter_normalizers(model, parameters)
            update_dynamic_normalizers(model, noisy, action, next_state, parameters)

    @torch.no_grad()
    @without_autocast
    def fit_scales(self, tensordict: TensorDictBase) -> None:
        """Fit only the scales of noise and errors, to thousands of clean transitions ``[B]``."""
        state, _, next_state = self._read(self._unpadded(tensordict))
        with unchanged_on_error(self):
            self._fit_scales(state, next_state)

    def _fit_scales(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Fit the scales; return the states with noise."""
        model, layout = self.model, self.model.layout
        clean = Normalizer(layout.size, floor=1e-9).cpu()
        clean.update(model.canonicalizer.recentered(state)[..., model.incidence.predicted, :].cpu())
        scale = torch.ones_like(self.noise_scale, device="cpu")
        for component in layout.components:
            if component.adds:
                scale[layout.delta_slices[component.name]] = clean.std[layout.slices[component.name]]
        self.noise_scale.copy_(scale)
        noisy = self.perturb(state)
        # Not the model's statistics: shared by several scenes, they would underweight errors in slow ones.
        change = Normalizer(layout.delta_size, floor=1e-9).cpu()
        change.update(layout.delta(noisy, next_state).cpu(), model.movable.cpu())
        self.error_weight.copy_(change.inverse_std)
        return noisy

    def training_state(self) -> dict:
        generator = None if self.generator is None else self.generator.get_state()
        return {"noise_scale": self.noise_scale, "error_weight": self.error_weight, "generator": generator}

    def load_training_state(self, state: dict) -> None:
        loaded = {}
        for name in ("noise_scale", "error_weight"):
            buffer, saved = getattr(self, name), state[name]
            if saved is None and name == "error_weight":
                saved = torch.full_like(buffer, -1)  # older files: not fitted
            if not isinstance(saved, Tensor) or saved.shape != buffer.shape:
                raise ValueError(f"the loss's {name} is not a tensor {list(buffer.shape)}")
            loaded[name] = saved
        for name, saved in loaded.items():
            getattr(self, name).copy_(saved)
        if self.generator is not None and state["generator"] is not None:
            self.generator.set_state(state["generator"])

    @dispatch()
    @without_autocast
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses of transitions or windows; ValueError for a wrong shape, NaN or Inf.

        RuntimeError if the model's normalisers have seen no data, or the noise has no scale.
        """
        require_fitted(self, self.trained, remedy=FIT_NORMALIZERS, also=self._require_noise_scale)
        end, mask = unravel_key(("next", self.tensor_keys.done)), collected_mask(tensordict)
        given, rows = tensordict, None if mask is None else mask.any(1) if mask.ndim == 2 else mask
        if mask is not None and mask.ndim == 2:
            tensordict, mask = fill_padding(tensordict, mask, self.in_keys, end)
        elif mask is not None:
            tensordict, mask = cast(TensorDictBase, tensordict[mask]), None
        state, action, next_state = self._read(tensordict)
        if state.ndim not in (3, 4):
            raise ValueError(f"State must be [B, N, 13] or [B, H, N, 13] for the loss, got {list(state.shape)}.")
        require_some(type(self).__name__, tensordict, state)
        steps = state.shape[1] if state.ndim == 4 else 1
        done = ends_of(tensordict, end)
        if steps > self.teacher_forced_steps or (steps > 1 and self.model.recurrent):
            require_consecutive(type(self).__name__, state, next_state, done)
        starts = starts_of(done, steps, self.teacher_forced_steps)
        parameters = self._read_parameters(tensordict, starts if state.ndim == 4 else None)
        shape = state.shape[:-2]
        weights = importance_weights(self, tensordict, shape)
        if state.ndim == 3:
            state, action, next_state = (entry.unsqueeze(1) for entry in (state, action, next_state))
        if weights is None:
            return self._losses(state, action, next_state, starts, parameters, mask)[0]
        weights = weights.reshape(state.shape[:2])
        weights = weights if mask is None else torch.where(mask, weights, 0.0)
        losses, samples = self._losses(state, action, next_state, starts, parameters, mask, weights)
        samples = samples.reshape(*shape, 1)
        if rows is not None:  # rows that are padding alone are left out, and have no error
            samples = samples.new_zeros(len(rows), *samples.shape[1:]).index_put((rows,), samples)
        given.set(self.tensor_keys.priority, samples)
        return losses

    @without_autocast
    def unchecked(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses of a batch without ``done`` and parameters, without any check; never waits for a GPU."""
        keys = [tensordict.get(key) for key in self.in_keys[:3]]
        state, action, next_state = keys if keys[0].ndim == 4 else (entry.unsqueeze(1) for entry in keys)
        starts = starts_of(None, state.shape[1], self.teacher_forced_steps)
        return self._losses(state, action, next_state, starts, None)[0]

    def _losses(
        self,
        state: Tensor,
        action: Tensor,
        next_state: Tensor,
        starts: list[Starts],
        parameters: TensorDictBase | None,
        mask: Tensor | None = None,
        weights: Tensor | None = None,
    ) -> tuple[TensorDict, Tensor]:
        """Return the losses of windows ``[B, H, ...]``; steps where ``mask`` ``[B, H]`` is False do not count.

        With ``weights`` ``[B, H]``, 0 where the mask is False, also return the detached losses ``[B, H]`` of the steps;
        else none, ``[0]``.
        """
        layout, steps = self.model.layout, state.shape[1]
        current, hidden = self.perturb(state[:, 0]), None
        errors, samples = state.new_zeros(len(layout.components)), []
        prepared = self.model.prepared_for_training(parameters)
        for step in range(steps):
            delta, hidden = prepared.delta(current, action[:, step], hidden)
            target = layout.delta(current, next_state[:, step])
            if weights is not None:
                samples.append(self._sample_errors(delta, target))
            elif mask is None:
                errors = errors + self.component_errors(delta, target)
            elif bool((count := mask[:, step].sum()) > 0):
                errors = errors + count * self.component_errors(delta[mask[:, step]], target[mask[:, step]])
            if step + 1 < steps:
                true, fresh = starts[step + 1]
                predicted = current if true is True else layout.apply(current, delta)
                current = predicted if true is False else choose(true, self.perturb(state[:, step + 1]), predicted)
                hidden = forget(hidden, fresh)
                if self.bptt_steps is not None and (step + 1) % self.bptt_steps == 0:
                    current, hidden = current.detach(), None if hidden is None else hidden.detach()
        each, scale = state.new_zeros(0, len(layout.components)), self._scale(self.noise_scale)
        if weights is None:
            errors = errors / (steps if mask is None else mask.sum())
        else:
            each = torch.stack(samples, 1)
            each = torch.where((weights > 0).unsqueeze(-1), each, 0.0)
            errors = (weights.unsqueeze(-1) * each).sum((0, 1)) / weights.sum()
        movable = torch.stack([(scale[:, layout.delta_slices[name]] > 0).any() for name in layout.names])
        loss = errors.sum() / movable.sum().clamp(min=1)
        if self.residual_weight:
            correction = self._correction(prepared, state, action).sum() / movable.sum().clamp(min=1)
            loss = loss + self.residual_weight * correction
        out = {f"error_{name}": error for name, error in zip(layout.names, errors.detach(), strict=True)}
        samples_loss = each.detach().sum(-1) / movable.sum().clamp(min=1)
        return TensorDict({"loss_forward_model": loss, **out}, []), samples_loss

    def _correction(self, prepared: PreparedStep, state: Tensor, action: Tensor) -> Tensor:
        """Return the physics' squared correction by component, at states ``[B, H, N, 13]`` and shuffled actions."""
        state, action = state.flatten(0, 1), action.flatten(0, 1)
        device = state.device if self.generator is None else self.generator.device
        drawn = [
            torch.randperm(len(state), generator=self.generator, device=device)[:_CORRECTED].to(state.device)
            for _ in range(2)
        ]
        state, action = self.perturb(state[drawn[0]], self.residual_noise), action[drawn[1]]
        physics = self.trained.physics
        assert physics is not None
        after = physics(state, self.model.controls.commands(action)).to(state.dtype)
        return self.component_errors(prepared.delta(state, action)[0], self.model.layout.delta(state, after))

    @staticmethod
    def _unpadded(tensordict: TensorDictBase) -> TensorDictBase:
        """Return the transitions that are not padding."""
        mask = collected_mask(tensordict)
        return tensordict if mask is None else cast(TensorDictBase, tensordict[mask])

    def _require_noise_scale(self) -> None:
        noise = self.noise or (self.residual_noise if self.residual_weight else 0.0)
        if noise and not bool(self.noise_scale.any()):
            raise RuntimeError(
                f"{type(self).__name__}: noise={noise} is in standard deviations of the states, which are not"
                " known. Call fit_scales(transitions) with thousands of clean transitions [B], or use noise=0."
            )

    def _read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        require_steps(type(self).__name__, tensordict)
        state, action, next_state = read_entries(self, tensordict, self.in_keys[:3])
        if next_state.shape != state.shape:
            expected = f"{list(state.shape)} as {self.in_keys[0]!r}"
            raise ValueError(f"{self.in_keys[2]!r} must be {expected}, got {list(next_state.shape)}.")
        check_shapes(self.model.scene, state, action)
        return state, action, next_state.to(state.dtype)

    def _read_parameters(self, tensordict: TensorDictBase, starts: list[Starts] | None = None) -> TensorDictBase | None:
        parameters = self.model.parameters_in(tensordict)
        if parameters is not None and starts is not None:  # windows
            require_constant(parameters, starts, f"{self.model.parameters_key!r} of the batch:")
            parameters = parameters[:, 0]
        # Inferred parameters come from a network in training: if it diverges, the loss shows it.
        if parameters is not None and self.trained.parameter_source != "inferred":
            require_finite(parameters, f"{self.model.parameters_key!r} of the batch")
        return None if parameters is None else cast(TensorDictBase, parameters).apply(usable_by_autograd)

    def perturb(self, state: Tensor, noise: float | None = None) -> Tensor:
        """Add input noise to states ``[*B, N, 13]``; its standard deviation is ``noise`` if given, else the loss's."""
        size = self.noise if noise is None else noise
        if size == 0:
            return state
        shape = (*state.shape[:-1], self.model.layout.delta_size)
        # Draw on the generator's device, so that a seed gives the same noise on any device.
        device = state.device if self.generator is None else self.generator.device
        drawn = torch.randn(shape, generator=self.generator, dtype=state.dtype, device=device).to(state.device)
        scale = (size * self.noise_scale).to(state.dtype) * self.model.movable
        return self.model.layout.apply(state, drawn * scale)

    def _scale(self, like: Tensor) -> Tensor:
        """Return ``[N, 12]``: inverse standard deviation times weight of movable channels, 0 for fixed ones."""
        weight = torch.where(self.error_weight < 0, self.trained.delta_normalizer.inverse_std, self.error_weight)
        weight = weight if self.channel_scale is None else weight * self.channel_scale
        return (weight * self.model.movable).to(like.dtype)

    def component_errors(self, delta: Tensor, target: Tensor) -> Tensor:
        """Return each component's squared error over the variance of its change, averaged over samples and nodes."""
        return torch.stack([square.sum() / (count * len(delta)) for square, count in self._squares(delta, target)])

    def _sample_errors(self, delta: Tensor, target: Tensor) -> Tensor:
        """Return :meth:`component_errors` ``[B, C]`` of each sample."""
        return torch.stack([square.flatten(1).sum(1) / count for square, count in self._squares(delta, target)], -1)

    def _squares(self, delta: Tensor, target: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield each component's scaled squared errors ``[B, N, k]``, and how many of a sample's count."""
        layout, scale = self.model.layout, self._scale(delta)
        weight_of = self._sample_weights(delta, scale)
        for component in layout.components:
            where = layout.delta_slices[component.name]
            if component.kind == "rotation":
                expected, predicted = quaternion.exp(target[..., where]), quaternion.exp(delta[..., where])
                # Twice the vector part is the rotation vector between the two, to third order.
                difference = 2 * quaternion.product(quaternion.conjugate(expected), predicted)[..., 1:]
            else:
                difference = delta[..., where] - target[..., where]
            weight = scale[:, where]
            square = (difference * weight).square()
            yield square if weight_of is None else square * weight_of, (weight > 0).sum().clamp(min=1)

    def _sample_weights(self, delta: Tensor, scale: Tensor) -> Tensor | None:
        """Return sample weights ``[B, 1, 1]`` by the size of the predicted change; None if all samples count alike."""
        if (floor := self.size_floor) is None:
            return None
        size = (delta.detach() * scale).square().sum((-1, -2), keepdim=True) / (scale > 0).sum().clamp(min=1)
        return (1 + floor) / (floor + size)
