"""Load trained models: those that come with the package, and your own."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

import torchrl_gn
from torchrl_gn.training.checkpoint import Checkpoint, CheckpointError, read_checkpoint

WEIGHTS = Path(torchrl_gn.__file__).with_name("weights")  # the models that come with the package


def pretrained_names() -> list[str]:
    """Names of all models that come with the package."""
    return sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))


def load_pretrained(source: str | os.PathLike) -> Checkpoint:
    """Load a trained model: one of :func:`pretrained_names`, or the path of a run folder or checkpoint file.

    ``"./cheetah"`` is a folder that has the name of a model. The checkpoint's ``metrics`` hold the model's errors.
    CheckpointError if there is no such source, or the file cannot be used.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> from torchrl_gn.training import load_pretrained
        >>> checkpoint = load_pretrained("swimmer6")
        >>> predictor = checkpoint.bind(load_scene("swimmer6"))
        >>> checkpoint.metrics["swimmer6"]["rollout_error_100"] < 0.01
        True
    """
    names = pretrained_names()
    if source in names:
        return read_checkpoint(WEIGHTS / f"{source}.safetensors")
    if not Path(source).exists():
        near = difflib.get_close_matches(str(source), names, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise CheckpointError(
            f"There is no checkpoint at {source}, and no trained model of that name comes with the package; those that"
            f" do are {names}.{hint}"
        )
    return read_checkpoint(source)
