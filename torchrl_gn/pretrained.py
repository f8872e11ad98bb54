"""Trained models that come with the package."""

from __future__ import annotations

import difflib
from pathlib import Path

from torchrl_gn.training.checkpoint import Checkpoint, CheckpointError, load_checkpoint

WEIGHTS = Path(__file__).with_name("weights")
"""Where they lie."""


def pretrained_names() -> list[str]:
    """Names of all models that come with the package."""
    return sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))


def load_pretrained(name: str) -> Checkpoint:
    """Load a trained model that comes with the package.

    Weights are stored in half precision, which costs nothing that can be seen in their errors.

    Args:
        name: one of :func:`pretrained_names`: the system that it was trained on, or what else it is for.

    Returns:
        The checkpoint: model, scenes it was trained on, and its errors in ``metrics``.

    Raises:
        ValueError: if there is none of that name.

    Example:
        >>> from torchrl_gn.pretrained import load_pretrained
        >>> checkpoint = load_pretrained("swimmer6")
        >>> bound = checkpoint.model.bind(checkpoint.scene())
        >>> checkpoint.metrics["swimmer6"]["rollout_error_100"] < 0.01
        True
    """
    names = pretrained_names()
    if name not in names:
        near = difflib.get_close_matches(name, names, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"There is no trained model {name!r}; use one of {names}.{hint}")
    return load_checkpoint(WEIGHTS / f"{name}.safetensors")


def load_model(source: str | Path) -> Checkpoint:
    """Load a trained model by the name that it comes with the package under, or from a run folder or checkpoint file.

    Args:
        source: the name, or the path; ``"./cheetah"`` where a folder has the name of a model.

    Raises:
        CheckpointError: if it is neither, or the file cannot be used.
    """
    if source in pretrained_names():
        return load_pretrained(str(source))
    if not Path(source).exists():
        raise CheckpointError(
            f"There is no checkpoint at {source}, and no model of that name comes with the package; those that do are"
            f" {pretrained_names()}."
        )
    return load_checkpoint(source)
