"""Loss of one forward model on several scenes at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_gn.dynamics import ForwardModel
from torchrl_gn.objectives.fitted import require_fitted
from torchrl_gn.objectives.forward_model_loss import FIT_NORMALIZERS, ForwardModelLoss


class SeveralScenesLoss(LossModule):
    """Mean of the losses of several scenes that share a model (paper, "Learning a forward model for multiple systems").

    Every scene has a sub-batch of its own topology, so nothing is padded, and counts the same.

    Args:
        losses: loss of each scene, all of one model.

    Input: TensorDict ``[S, B, ...]`` or a list of ``S``: what the loss of each scene reads, in the order of ``losses``.
    A ``ReplayBufferEnsemble(..., sample_from_all=True)`` of their buffers draws it.

    Output: ``loss_forward_model`` and the detached ``error_<component>``, means over the scenes, and the detached
    ``scene_<name>``, the loss of each.

    Raises:
        ValueError: if there is no loss, or they are of different models or of scenes of one name.
    """

    losses: nn.ModuleList
    _fitted = False  # until asked once: reading statistics waits for the device

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
    def of_scenes(self) -> list[ForwardModelLoss]:
        """Loss of each scene."""
        return cast("list[ForwardModelLoss]", list(self.losses))

    @property
    def trained(self) -> ForwardModel:
        """The weights that are trained."""
        return self.of_scenes[0].trained

    @property
    def in_keys(self) -> list:
        """Keys that the losses read."""
        return list(dict.fromkeys(key for loss in self.of_scenes for key in loss.in_keys))

    @property
    def out_keys(self) -> list[str]:
        """Keys that the loss writes."""
        return [*self.of_scenes[0].out_keys, *(f"scene_{name}" for name in self.names)]

    def fit_normalizers(self, batches: TensorDictBase | Sequence[TensorDictBase]) -> None:
        """Set every loss's scales, and the model's statistics over all scenes; once before training.

        Args:
            batches: clean transitions ``[B]`` of each scene, some thousands.
        """
        for loss, batch in zip(self.of_scenes, self._parts(batches), strict=True):
            loss.fit_normalizers(batch)

    def fit_scales(self, batches: TensorDictBase | Sequence[TensorDictBase]) -> None:
        """Set every loss's scales alone, to go on from a trained model; see :meth:`ForwardModelLoss.fit_scales`."""
        for loss, batch in zip(self.of_scenes, self._parts(batches), strict=True):
            loss.fit_scales(batch)

    def forward(self, tensordict: TensorDictBase | Sequence[TensorDictBase]) -> TensorDict:
        """Loss of a sub-batch of every scene.

        Raises:
            KeyError: if a sub-batch lacks an entry.
            ValueError: if there is not one for every scene, an entry has a wrong shape, or holds NaN or Inf.
            RuntimeError: if the model's normalisers have seen no data, or noise has no scale.
        """
        parts = self._parts(tensordict)
        if not (self._fitted or torch.compiler.is_compiling()):
            remedy = FIT_NORMALIZERS.replace("transitions [B]", "transitions [B] of each scene")
            require_fitted(self, self.trained, remedy=remedy)
            self._fitted = True
        outs = [loss(part) for loss, part in zip(self.of_scenes, parts, strict=True)]
        means: dict[str, Tensor] = {key: torch.stack([out[key] for out in outs]).mean() for key in outs[0].keys()}
        own = {f"scene_{name}": out["loss_forward_model"].detach() for name, out in zip(self.names, outs, strict=True)}
        return TensorDict({**means, **own}, [])

    def _parts(self, batches: TensorDictBase | Sequence[TensorDictBase]) -> list[TensorDictBase]:
        parts = list(batches.unbind(0) if isinstance(batches, TensorDictBase) else batches)
        if len(parts) != len(self.losses):
            raise ValueError(f"The batch has {len(parts)} parts for {len(self.losses)} scenes {self.names}.")
        return parts

    def training_state(self) -> dict:
        """What a training that goes on later needs of the losses."""
        return {name: loss.training_state() for name, loss in zip(self.names, self.of_scenes, strict=True)}

    def load_training_state(self, state: dict) -> None:
        """Go on from what :meth:`training_state` gave."""
        for name, loss in zip(self.names, self.of_scenes, strict=True):
            loss.load_training_state(state[name])
