"""Loss of a forward model: one step, or several steps unrolled."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_gn.dynamics import ForwardModel, Predictor, SpecializedPredictor
from torchrl_gn.finite import require_finite
from torchrl_gn.maths import Normalizer, quaternion
from torchrl_gn.objectives.fitted import require_fitted

FIT_NORMALIZERS = (
    "Call fit_normalizers(transitions) of the loss with some thousands of clean transitions [B], once before training;"
    " trajectory_buffer(trajectories, batch_size=5000).sample() draws them."
)


class ForwardModelLoss(LossModule):
    r"""Squared error of predicted state changes (paper, SM "Training algorithms" and "Loss").

    Noise is added to the input state and the target is the change from the *noisy*
    input to the clean next state, so the model also learns to put slightly
    dislocated bodies back together. With windows of several steps the model is
    fed its own predictions and each step's target is the change from what it was
    fed to the true next state; gradients flow through the whole window. The first ``forced`` steps are fed
    the true states instead ("teacher forcing"; paper, SM "Recurrent one-step predictions": all of them), which pays
    for a recurrent model, whose hidden state is carried through the window.

    Each component's error is divided by the variance of its change in this scene and averaged over
    movable channels, nodes and samples; the loss is the mean of the components.

    Orientation: the paper prints :math:`1 - \cos^2(q_e \cdot q_p)`, which is not zero for
    equal rotations; with :math:`\cos = q_e \cdot q_p` it is :math:`1 - (q_e \cdot q_p)^2`,
    which keeps no digits for the small rotations of one step. It equals the squared
    vector part of :math:`\bar q_e q_p`, computed here from the *change* quaternions.

    Differentiated: the model's weights, through predictions (and through predicted
    states over windows). The input TensorDict is never changed.

    Args:
        model: forward model bound to the scene of the samples.
        noise: standard deviation of the input noise, in units of each state channel's own
            standard deviation (radians for orientations). None on fixed components.
        generator: source of the noise; the global one if None (a run then cannot resume bit for bit).
        forced: steps of a window, at its begin, that are fed the true state, with noise.

    Input: ``state`` ``[B, N, 13]`` or ``[B, H, N, 13]`` with ``H`` steps in a row,
    ``action`` ``[B, (H,) A]``, ``("next", "state")`` like ``state``; with a model that reads them the
    physical parameters ``[B, (H)]`` of every sample, the same for a whole window.

    Output: ``loss_forward_model`` and the detached ``error_<component>``, scalars.

    Call :meth:`fit_normalizers` once before training. To go on from a trained model, whose statistics came with its
    weights, nothing need be fitted without noise; with noise, or on other scenes, call :meth:`fit_scales`.
    """

    _fitted = False  # until asked once: reading statistics waits for the device

    @dataclass
    class _AcceptedKeys:
        """Keys that :meth:`set_keys` can change.

        Attributes:
            state: read here and under ``"next"``.
            action: the control.
        """

        state: NestedKey = "state"
        action: NestedKey = "action"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    model: Predictor
    noise_scale: Tensor
    error_weight: Tensor

    def __init__(
        self,
        model: Predictor,
        *,
        noise: float = 0.0,
        generator: torch.Generator | None = None,
        forced: int = 1,
    ) -> None:
        super().__init__()
        if not 0 <= noise < math.inf:
            raise ValueError(f"noise={noise} must not be negative, NaN or infinite.")
        if isinstance(model, SpecializedPredictor):
            raise TypeError("A specialised model passes no gradient to the weights; train the bound model.")
        self.model = model
        self.noise = noise
        self.generator = generator
        if forced < 1:
            raise ValueError(f"forced={forced} must be at least 1: the first state is always a true one.")
        self.forced = forced
        scale = torch.zeros(model.layout.delta_size, dtype=torch.float64, device=model.movable.device)
        self.register_buffer("noise_scale", scale)
        self.register_buffer("error_weight", scale - 1)  # negative: not fitted (of None load_state_dict knows nothing)

    @property
    def trained(self) -> ForwardModel:
        """The weights that are trained."""
        return self.model.model

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that the loss reads."""
        state, action, parameters = self.tensor_keys.state, self.tensor_keys.action, self.model.parameters_key
        return [state, action, unravel_key(("next", state)), *([] if parameters is None else [parameters])]

    @property
    def out_keys(self) -> list[str]:
        """Keys that the loss writes."""
        return ["loss_forward_model", *(f"error_{name}" for name in self.model.layout.names)]

    @torch.no_grad()
    def fit_normalizers(self, tensordict: TensorDictBase) -> None:
        """Set this loss's scales from transitions, and take them into the model's statistics; once before training.

        Args:
            tensordict: ``[B]`` clean transitions, some thousands.
        """
        model = self.model
        state, action, next_state = self._read(tensordict)
        parameters = self._read_parameters(tensordict) if model.model.parameter_source == "scene" else None
        noisy = self._fit_scales(state, next_state)
        model.update_parameter_normalizers(parameters)
        model.update_dynamic_normalizers(noisy, action, next_state, parameters)

    @torch.no_grad()
    def fit_scales(self, tensordict: TensorDictBase) -> None:
        """Set this loss's scales of noise and errors alone, to go on from a trained model.

        Args:
            tensordict: ``[B]`` clean transitions, some thousands.
        """
        state, _, next_state = self._read(tensordict)
        self._fit_scales(state, next_state)

    def _fit_scales(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Measure scales; the states with noise."""
        model, layout = self.model, self.model.layout
        clean = Normalizer(layout.size, floor=1e-9)
        clean.update(self.model.frame.recentered(state)[..., model.incidence.predicted, :].cpu())
        scale = torch.ones(layout.delta_size, dtype=torch.float64)
        for component in layout.components:
            if component.kind == "add":
                scale[layout.delta_slices[component.name]] = clean.std[layout.slices[component.name]]
        self.noise_scale.copy_(scale)
        noisy = self._perturb(state)
        # The model's statistics are of all scenes that share it, and would make light of errors in slow ones.
        change = Normalizer(layout.delta_size, floor=1e-9)
        change.update(layout.delta(noisy, next_state).cpu(), model.movable.cpu())
        self.error_weight.copy_(change.inverse_std)
        return noisy

    def training_state(self) -> dict:
        """What a training that goes on later needs of this loss."""
        generator = None if self.generator is None else self.generator.get_state()
        return {"noise_scale": self.noise_scale, "error_weight": self.error_weight, "generator": generator}

    def load_training_state(self, state: dict) -> None:
        """Go on from what :meth:`training_state` gave."""
        self.noise_scale.copy_(state["noise_scale"])
        weight = state["error_weight"]  # of older files None, if it was not fitted
        self.error_weight.copy_(torch.tensor(-1.0) if weight is None else weight)
        if self.generator is not None and state["generator"] is not None:
            self.generator.set_state(state["generator"])

    @dispatch()
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of a batch of transitions or windows.

        Raises:
            KeyError: if the batch lacks an entry.
            ValueError: if an entry has a wrong shape, or holds NaN or Inf.
            RuntimeError: if the model's normalisers have seen no data, or the noise has no scale.
        """
        self._require_fitted()
        state, action, next_state = self._read(tensordict)
        if state.ndim not in (3, 4):
            raise ValueError(f"State must be [B, N, 13] or [B, H, N, 13] for the loss, got {list(state.shape)}.")
        parameters = self._read_parameters(tensordict, windows=state.ndim == 4)
        if state.ndim == 3:
            state, action, next_state = state.unsqueeze(1), action.unsqueeze(1), next_state.unsqueeze(1)
        layout, steps = self.model.layout, state.shape[1]
        current, hidden_state = self._perturb(state[:, 0]), None
        errors, folded = state.new_zeros(len(layout.components)), self.model.fold(parameters)
        for step in range(steps):
            target = layout.delta(current, next_state[:, step])
            delta, hidden_state = self.model.delta_and_hidden_state(current, action[:, step], folded, hidden_state)
            errors = errors + self._component_errors(delta, target)
            if step + 1 < steps:
                forced = step + 1 < self.forced
                current = self._perturb(state[:, step + 1]) if forced else layout.apply(current, delta)
        errors = errors / steps
        movable = self._movable_components()
        loss = errors.sum() / movable.sum().clamp(min=1)
        out: dict[str, Tensor] = {
            f"error_{name}": error for name, error in zip(layout.names, errors.detach(), strict=True)
        }
        return TensorDict({"loss_forward_model": loss, **out}, [])

    def _require_fitted(self) -> None:
        if self._fitted or torch.compiler.is_compiling():
            return
        require_fitted(self, self.trained, remedy=FIT_NORMALIZERS)
        if self.noise and not bool(self.noise_scale.any()):
            raise RuntimeError(
                f"{type(self).__name__}: noise={self.noise} is in standard deviations of the states, which are not"
                " known. Call fit_scales(transitions) with some thousands of clean transitions [B], or use noise=0."
            )
        self._fitted = True

    def _read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        state, action, next_state = (tensordict.get(key) for key in self.in_keys[:3])
        for key, value in zip(self.in_keys[:3], (state, action, next_state), strict=True):
            if value is None:
                raise KeyError(
                    f"ForwardModelLoss needs {key!r}, the batch has {sorted(map(str, tensordict.keys(True)))}."
                )
            require_finite(value, f"{key!r} of the batch")
        if next_state.shape != state.shape:
            raise ValueError(
                f"{self.in_keys[2]!r} must be {list(state.shape)} as {self.in_keys[0]!r}, got {list(next_state.shape)}."
            )
        return state, action, next_state

    def _read_parameters(self, tensordict: TensorDictBase, *, windows: bool = False) -> TensorDictBase | None:
        parameters = self.model.parameters_in(tensordict)
        if parameters is not None:
            parameters = parameters[:, 0] if windows else parameters
        # Inferred ones come from a network that is trained too: if it diverges, the loss says so.
        if parameters is not None and self.trained.parameter_source != "inferred":
            require_finite(parameters, f"{self.model.parameters_key!r} of the batch")
        return parameters

    def _perturb(self, state: Tensor) -> Tensor:
        if self.noise == 0:
            return state
        shape = (*state.shape[:-1], self.model.layout.delta_size)
        # A generator draws on its own device only, so that a seed gives the same noise on any.
        device = state.device if self.generator is None else self.generator.device
        noise = torch.randn(shape, generator=self.generator, dtype=state.dtype, device=device).to(state.device)
        scale = (self.noise * self.noise_scale).to(state.dtype) * self.model.movable
        return self.model.layout.apply(state, noise * scale)

    def _scale(self, like: Tensor) -> Tensor:
        """``[N, 12]`` weights: one over the spread of each movable channel, 0 for dead ones."""
        weight = torch.where(self.error_weight < 0, self.trained.delta_normalizer.inverse_std, self.error_weight)
        return (weight * self.model.movable).to(like.dtype)

    def _movable_components(self) -> Tensor:
        layout = self.model.layout
        scale = self._scale(self.noise_scale)
        return torch.stack([(scale[:, layout.delta_slices[name]] > 0).any() for name in layout.names])

    def _component_errors(self, delta: Tensor, target: Tensor) -> Tensor:
        layout, scale = self.model.layout, self._scale(delta)
        errors = []
        for component in layout.components:
            where = layout.delta_slices[component.name]
            if component.kind == "rotation":
                expected, predicted = quaternion.exp(target[..., where]), quaternion.exp(delta[..., where])
                # Twice the vector part: the rotation vector between the two, to third order.
                difference = 2 * quaternion.product(quaternion.conjugate(expected), predicted)[..., 1:]
            else:
                difference = delta[..., where] - target[..., where]
            weight = scale[:, where]
            count = (weight > 0).sum().clamp(min=1) * delta.shape[0]
            errors.append((difference * weight).square().sum() / count)
        return torch.stack(errors)
