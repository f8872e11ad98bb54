"""Loss of an inference model and the forward model that reads its estimates."""

from __future__ import annotations

from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_gn.checks import check_count, check_counts
from torchrl_gn.dynamics import BoundPredictor
from torchrl_gn.identification import BoundInferenceModel, IdentifyingModel
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.objectives.checks import (
    COLLECTED,
    ends_of,
    importance_weights,
    read_entries,
    require_fitted,
    require_steps,
    require_unpadded,
)
from torchrl_gn.objectives.forward_model_loss import FIT_NORMALIZERS, ForwardModelLoss
from torchrl_gn.scenes import Scene


class IdentificationLoss(LossModule):
    """Prediction error on query windows, given an estimate from a context window of the same trajectory.

    Paper, SM "End-to-end training algorithm for System ID". One loss trains both models.

    Args:
        context_length: steps to identify a system from.
        shortest: least context length in training. Each batch draws a length from this to ``context_length`` and keeps
            the last steps of the context. Default: always ``context_length`` (paper).
        num_queries: windows to predict with each estimate.
        generator: source of the noise and of the context lengths. Default: torch's global generator.

    Input: ``state``, ``action`` and ``("next", "state")`` ``[B, context_length + num_queries * H, ...]``, as
    ``trajectory_buffer(..., window=context_length, query_windows=(num_queries, H))`` draws them.

    See :class:`ForwardModelLoss` for the output and ``noise``, and for ``priority_weight`` and ``td_error``, whose keys
    ``prediction.set_keys`` changes.
    """

    prediction: ForwardModelLoss
    inference: BoundInferenceModel

    def __init__(
        self,
        model: IdentifyingModel,
        scene: Scene,
        *,
        context_length: int = 20,
        shortest: int | None = None,
        num_queries: int = 1,
        noise: float = 0.0,
        generator=None,
    ) -> None:
        super().__init__()
        check_counts(context_length=context_length, num_queries=num_queries)
        shortest = context_length if shortest is None else shortest
        check_count("shortest", shortest, 0)
        if not 1 <= shortest <= context_length:
            raise ValueError(f"shortest={shortest} must be from 1 to context_length={context_length}.")
        self.identifying = model
        bound, self.inference = model.bind(scene)
        self.prediction = ForwardModelLoss(bound, noise=noise, generator=generator)
        self.context_length, self.shortest, self.num_queries = context_length, shortest, num_queries

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @property
    def trained(self) -> IdentifyingModel:
        """The model to train."""
        return self.identifying

    @property
    def bound(self) -> BoundPredictor:
        """The forward model, bound to the scene."""
        return self.prediction.model

    @property
    def in_keys(self) -> list:
        return ["state", "action", ("next", "state")]

    @property
    def out_keys(self) -> list[str]:
        return self.prediction.out_keys

    def fit_normalizers(self, tensordict: TensorDictBase) -> None:
        """Fit the loss's scales and the models' normalisers; see :meth:`ForwardModelLoss.fit_normalizers`."""
        self.prediction.fit_normalizers(tensordict.select(*self.in_keys, *COLLECTED, strict=False))

    def fit_scales(self, tensordict: TensorDictBase) -> None:
        """Fit only the loss's scales; see :meth:`ForwardModelLoss.fit_scales`."""
        self.prediction.fit_scales(tensordict.select(*self.in_keys, *COLLECTED, strict=False))

    @without_autocast
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses of a batch of sequences; raises the errors of :meth:`ForwardModelLoss.forward`."""
        require_fitted(self, self.trained, remedy=FIT_NORMALIZERS)
        length = tensordict.shape[1] if tensordict.ndim == 2 else 0
        window, remainder = divmod(max(length - self.context_length, 0), self.num_queries)
        if window < 1 or remainder:
            raise ValueError(
                f"The batch must be [B, {self.context_length} + {self.num_queries} * H], got {list(tensordict.shape)};"
                f" draw it with trajectory_buffer(..., window={self.context_length},"
                f" query_windows=({self.num_queries}, H))."
            )
        require_steps(type(self).__name__, tensordict)
        require_unpadded(type(self).__name__, tensordict)
        state, action, next_state = read_entries(self, tensordict, self.in_keys)
        start, most, generator = 0, self.context_length - self.shortest, self.prediction.generator
        if most and self.training:
            device = None if generator is None else generator.device
            start = int(torch.randint(most + 1, (), generator=generator, device=device))
        context = slice(start, self.context_length)
        parameters = self.inference.infer(state[:, context], action[:, context], next_state[:, context]).parameters
        # Each query is a sample: [B * num_queries, H, ...].
        state, action, next_state = (
            entry[:, self.context_length :].unflatten(1, (self.num_queries, window)).flatten(0, 1)
            for entry in (state, action, next_state)
        )
        batch = len(state), window
        parameters = parameters.repeat_interleave(self.num_queries, 0).unsqueeze(1).expand(*batch)
        after = {"state": next_state}
        if (done := ends_of(tensordict)) is not None:
            after["done"] = done[:, self.context_length :].unflatten(1, (self.num_queries, window)).flatten(0, 1)
        entries: dict[Any, Any] = {"state": state, "action": action, "next": after, "parameters": parameters}
        keys, weights = self.prediction.tensor_keys, importance_weights(self.prediction, tensordict, tensordict.shape)
        if weights is not None:
            queries = weights[:, self.context_length :].unflatten(1, (self.num_queries, window)).flatten(0, 1)
            entries[keys.priority_weight] = queries
        queries = TensorDict(entries, batch_size=batch)
        losses = self.prediction(queries)
        if weights is not None:
            each = cast(Tensor, queries.get(keys.priority)).unflatten(0, (-1, self.num_queries)).flatten(1).mean(1)
            tensordict.set(keys.priority, each.view(-1, 1, 1).expand(*tensordict.shape, 1).clone())
        return losses

    def training_state(self) -> dict:
        return self.prediction.training_state()

    def load_training_state(self, state: dict) -> None:
        self.prediction.load_training_state(state)
