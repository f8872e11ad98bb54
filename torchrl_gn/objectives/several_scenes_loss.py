"""Loss of one forward model on several scenes at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.maths.normalizer import unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.objectives.checks import require_fitted
from torchrl_gn.objectives.forward_model_loss import FIT_NORMALIZERS, ForwardModelLoss


class SeveralScenesLoss(LossModule):
    """Mean of the losses of several scenes that share a model (paper, "Learning a forward model for multiple systems").

    Input: TensorDict ``[S, B, ...]`` or a list of ``S`` sub-batches, in the order of ``losses``, as a
    ``ReplayBufferEnsemble(..., sample_from_all=True)`` draws them.

    Output: ``loss_forward_model`` and the detached ``error_<component>``, means over the scenes, and the detached loss
    of each scene as ``scene_<name>``.
    """

    losses: nn.ModuleList

    def __init__(self, losses: Sequence[ForwardModelLoss]) -> None:
        super().__init__()
        if not losses:
            raise ValueError("SeveralScenesLoss needs at least one loss.")
        if any(loss.trained is not losses[0].trained for loss in losses):
            raise ValueError("The losses must be of one model, bound to several scenes.")
        self.names = [loss.model.scene.name for loss in losses]
        if len(set(self.names)) < len(losses):
            raise ValueError(f"Scenes {self.names} must have different names.")
        self.losses = nn.ModuleList(losses)

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @property
    def scene_losses(self) -> list[ForwardModelLoss]:
        """Losses of the scenes."""
        return cast("list[ForwardModelLoss]", list(self.losses))

    @property
    def trained(self) -> ForwardModel:
        """The model to train."""
        return self.scene_losses[0].trained

    @property
    def in_keys(self) -> list:
        return list(dict.fromkeys(key for loss in self.scene_losses for key in loss.in_keys))

    @property
    def out_keys(self) -> list[str]:
        return [*self.scene_losses[0].out_keys, *(f"scene_{name}" for name in self.names)]

    @property
    def reason(self) -> str | None:
        """Reason why torch operations compute the loss of at least one scene; None if C++ computes all."""
        return next((loss.reason for loss in self.scene_losses if loss.reason is not None), None)

    def fit_normalizers(self, batches: TensorDictBase | Sequence[TensorDictBase]) -> None:
        """Fit the scales and the model's normalisers to transitions ``[B]`` without noise, thousands of each scene."""
        with unchanged_on_error(*self.scene_losses):
            for loss, batch in zip(self.scene_losses, self._sub_batches(batches), strict=True):
                loss.fit_normalizers(batch)

    def fit_scales(self, batches: TensorDictBase | Sequence[TensorDictBase]) -> None:
        """Fit only the scales; see :meth:`ForwardModelLoss.fit_scales`."""
        with unchanged_on_error(*self.scene_losses):
            for loss, batch in zip(self.scene_losses, self._sub_batches(batches), strict=True):
                loss.fit_scales(batch)

    @without_autocast
    def forward(self, tensordict: TensorDictBase | Sequence[TensorDictBase]) -> TensorDict:
        """Return the losses of a sub-batch of every scene; raises the errors of :meth:`ForwardModelLoss.forward`."""
        batches = self._sub_batches(tensordict)
        remedy = FIT_NORMALIZERS.replace("transitions [B]", "transitions [B] of each scene")
        require_fitted(self, self.trained, remedy=remedy)
        outs = [loss(batch) for loss, batch in zip(self.scene_losses, batches, strict=True)]
        key = self.scene_losses[0].tensor_keys.priority
        if isinstance(tensordict, TensorDictBase) and all(key in batch.keys(True) for batch in batches):
            tensordict.set(key, torch.stack([cast(Tensor, batch[key]) for batch in batches]))
        means: dict[str, Tensor] = {key: torch.stack([out[key] for out in outs]).mean() for key in outs[0].keys()}
        by_scene = {
            f"scene_{name}": out["loss_forward_model"].detach() for name, out in zip(self.names, outs, strict=True)
        }
        return TensorDict({**means, **by_scene}, [])

    def _sub_batches(self, batches: TensorDictBase | Sequence[TensorDictBase]) -> list[TensorDictBase]:
        each = list(batches.unbind(0) if isinstance(batches, TensorDictBase) else batches)
        if len(each) != len(self.losses):
            raise ValueError(f"The batch has {len(each)} sub-batches for {len(self.losses)} scenes {self.names}.")
        return each

    def training_state(self) -> dict:
        return {name: loss.training_state() for name, loss in zip(self.names, self.scene_losses, strict=True)}

    def load_training_state(self, state: dict) -> None:
        for name, loss in zip(self.names, self.scene_losses, strict=True):
            loss.load_training_state(state[name])
