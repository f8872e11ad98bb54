"""Warn of scenes that differ from a model's training in what never varied there."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchrl_gn.dynamics.predictor import Predictor
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class UnseenParameterWarning(UserWarning):
    """A scene has a physical parameter that the model never saw vary in training."""


def warn_of_unseen(predictor: Predictor, values: PhysicalParameters, name: str, *, stacklevel: int) -> None:
    """Warn, or raise with ``strict``, where a scene differs in a parameter that was constant in training.

    Args:
        predictor: the model.
        values: physical parameters of its scene, or of a variant.
        name: that scene's.
        stacklevel: of the warning.

    Raises:
        ValueError: with ``strict``, naming the parameters.
    """
    model, unseen = predictor.model, []
    for part, normalizer in model.parameter_normalizers.items() if model.parameter_source == "scene" else ():
        mean = normalizer.mean
        given = getattr(values, part).to(mean.device)
        if given.shape[-1] == 0 or not bool((normalizer.count > 0).all()):
            continue
        # 1e-6: the same scene compiled on another machine may differ in the last digits.
        differs = ((given - mean).abs() > 1e-6 * mean.abs().clamp(min=1e-12)).reshape(-1, given.shape[-1]).any(0)
        for index in (normalizer.constant & differs).nonzero().flatten().tolist():
            unseen.append(getattr(model.parameter_names, part)[index])
    residual = model.residual_normalizer
    if bool((residual.count > 0).any()):
        fixed = (predictor.movable & residual.constant).any(0).nonzero().flatten().tolist()
        unseen += [f"state change {index}" for index in fixed]
    if not unseen:
        return
    message = (
        f"Scene {name!r} has values that the model never saw, in features that never varied in its"
        f" training: {', '.join(unseen)}. They are ignored and predictions may be wrong."
    )
    if predictor.strict:
        raise ValueError(message)
    warnings.warn(message, UnseenParameterWarning, stacklevel=stacklevel)
