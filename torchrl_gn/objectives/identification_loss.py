"""Loss of a forward model and the inference model that identifies its systems."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_gn.dynamics import Predictor
from torchrl_gn.finite import require_finite
from torchrl_gn.identification import BoundInferenceModel, IdentifyingModel
from torchrl_gn.objectives.fitted import require_fitted
from torchrl_gn.objectives.forward_model_loss import FIT_NORMALIZERS, ForwardModelLoss
from torchrl_gn.scenes import Scene


class IdentificationLoss(LossModule):
    """Error of predictions with what was inferred from another part of the same trajectory.

    Paper, SM "End-to-end training algorithm for System ID": a system is identified from a random sequence of some
    steps, and a different step of its trajectory is predicted with the inferred graph in the place of the static one;
    one loss trains both models. Here several other steps, or windows of several steps, are predicted with what was
    inferred once.

    Args:
        model: the two models.
        scene: the standard scene of the samples.
        phase: steps to identify a system from, the most ...
        shortest: ... and the fewest: every batch is identified from the last of its steps, a random number of them,
            which is quicker and teaches what few steps tell. Default: always ``phase`` (paper).
        parts: other parts of the trajectory that are predicted with what was inferred.
        noise: of the input state, see :class:`ForwardModelLoss`.
        generator: source of the noise and of these numbers; the global one if None.

    Input: ``state``, ``action`` and ``("next", "state")`` ``[B, phase + parts * H, ...]`` as
    ``trajectory_buffer(..., window=phase, elsewhere=(parts, H))`` draws them; over ``H`` steps the model is fed its own
    predictions. Physical parameters of the samples are not read.

    Output: as :class:`ForwardModelLoss`.
    """

    prediction: ForwardModelLoss
    inference: BoundInferenceModel
    _fitted = False  # until asked once: reading statistics waits for the device

    def __init__(
        self,
        model: IdentifyingModel,
        scene: Scene,
        *,
        phase: int = 20,
        shortest: int | None = None,
        parts: int = 1,
        noise: float = 0.0,
        generator=None,
    ) -> None:
        super().__init__()
        if phase < 1 or parts < 1:
            raise ValueError(f"phase={phase} and parts={parts} must be at least 1.")
        shortest = phase if shortest is None else shortest
        if not 1 <= shortest <= phase:
            raise ValueError(f"shortest={shortest} must be from 1 to phase={phase}.")
        self.identifying = model
        bound, self.inference = model.bind(scene)
        self.prediction = ForwardModelLoss(bound, noise=noise, generator=generator)
        self.phase, self.shortest, self.parts = phase, shortest, parts

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @property
    def trained(self) -> IdentifyingModel:
        """The weights that are trained."""
        return self.identifying

    @property
    def bound(self) -> Predictor:
        """The forward model, which reads what the inference model writes."""
        return self.prediction.model

    @property
    def in_keys(self) -> list:
        """Keys that the loss reads."""
        return ["state", "action", ("next", "state")]

    @property
    def out_keys(self) -> list[str]:
        """Keys that the loss writes."""
        return self.prediction.out_keys

    def fit_normalizers(self, tensordict: TensorDictBase) -> None:
        """Set the models' normalisers from clean transitions ``[B]``, some thousands; once before training."""
        self.prediction.fit_normalizers(tensordict.select(*self.in_keys))

    def fit_scales(self, tensordict: TensorDictBase) -> None:
        """Set the loss's scales alone, to go on from trained models; see :meth:`ForwardModelLoss.fit_scales`."""
        self.prediction.fit_scales(tensordict.select(*self.in_keys))

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Loss of a batch of sequences.

        Raises:
            KeyError: if the batch lacks an entry.
            ValueError: if it has no steps to predict, a shape is wrong, or it holds NaN or Inf.
            RuntimeError: if the models' normalisers have seen no data, or noise has no scale.
        """
        if not (self._fitted or torch.compiler.is_compiling()):
            require_fitted(self, self.trained, remedy=FIT_NORMALIZERS)
            self._fitted = True
        length = tensordict.shape[1] if tensordict.ndim == 2 else 0
        window, rest = divmod(max(length - self.phase, 0), self.parts)
        if window < 1 or rest:
            raise ValueError(
                f"The batch must be [B, {self.phase} + {self.parts} * H], got {list(tensordict.shape)}; draw it with"
                f" trajectory_buffer(..., window={self.phase}, elsewhere=({self.parts}, H))."
            )
        state, action, next_state = (self._entry(tensordict, key) for key in self.in_keys)
        seen = slice(self._skipped(), self.phase)
        parameters = self.inference.infer(state[:, seen], action[:, seen], next_state[:, seen]).parameters
        # Every part that is predicted is a sample of its own, [B * parts, H, ...].
        state, action, next_state = (
            entry[:, self.phase :].unflatten(1, (self.parts, window)).flatten(0, 1)
            for entry in (state, action, next_state)
        )
        steps = len(state), window
        parameters = parameters.apply(lambda value: value.repeat_interleave(self.parts, 0), batch_size=steps[:1])
        parameters = parameters.apply(
            lambda value: value.unsqueeze(1).expand(*steps, *value.shape[1:]), batch_size=steps
        )
        entries = {"state": state, "action": action, "next": {"state": next_state}, "parameters": parameters}
        return self.prediction(TensorDict(entries, batch_size=steps))

    def _skipped(self) -> int:
        """Steps of the phase that this batch is not identified from."""
        most = self.phase - self.shortest
        if not most or not self.training:
            return 0
        generator = self.prediction.generator
        device = None if generator is None else generator.device
        return int(torch.randint(most + 1, (), generator=generator, device=device))

    def _entry(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if not isinstance(value, Tensor):
            raise KeyError(
                f"IdentificationLoss needs {key!r}, the batch has {sorted(map(str, tensordict.keys(True)))}."
            )
        require_finite(value, f"{key!r} of the batch")
        return value

    def training_state(self) -> dict:
        """What a training that goes on later needs of this loss."""
        return self.prediction.training_state()

    def load_training_state(self, state: dict) -> None:
        """Go on from what :meth:`training_state` gave."""
        self.prediction.load_training_state(state)
