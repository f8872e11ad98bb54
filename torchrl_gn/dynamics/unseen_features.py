"""Warn of scenes with values that a forward model never saw in its training."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchrl_gn.dynamics.predictor import Predictor
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class UnseenFeatureWarning(UserWarning):
    """A scene has a static value that the model never saw vary in training."""


def check_seen(bound: Predictor, values: PhysicalParameters, name: str, *, stacklevel: int) -> None:
    """Warn, or raise if bound ``strict``, where a scene differs in what was the same in all of a model's training.

    Args:
        bound: the model.
        values: numbers of the scene that it is bound to, or of a variant.
        name: that scene's.
        stacklevel: of the warning.

    Raises:
        ValueError: if it does and ``strict``; the message names the features.
    """
    model, unseen = bound.model, []
    for part, normalizer in model.parameter_normalizers.items() if model.parameter_source == "scene" else ():
        seen = normalizer.mean
        given = getattr(values, part).to(seen.device)
        if given.shape[-1] == 0 or not bool((normalizer.count > 0).all()):
            continue
        # 1e-6: the same model compiled on another machine may differ in the last digits.
        differs = ((given - seen).abs() > 1e-6 * seen.abs().clamp(min=1e-12)).reshape(-1, given.shape[-1]).any(0)
        for index in (normalizer.constant & differs).nonzero().flatten().tolist():
            unseen.append(getattr(model.features, part)[index])
    residual = model.residual_normalizer
    if bool((residual.count > 0).any()):
        dead = (bound.movable & residual.constant).any(0).nonzero().flatten().tolist()
        unseen += [f"state change {index}" for index in dead]
    if not unseen:
        return
    message = (
        f"Scene {name!r} has values that the model never saw, in features that never varied in its"
        f" training: {', '.join(unseen)}. They are ignored and predictions may be wrong."
    )
    if bound.strict:
        raise ValueError(message)
    warnings.warn(message, UnseenFeatureWarning, stacklevel=stacklevel)
