"""Scene and model that a user names: a system, a file, a run folder, or a trained model of the package."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from torchrl_gn.dynamics import Ensemble, ForwardModel, specialize
from torchrl_gn.policies import BoundedPolicy
from torchrl_gn.scenes import SYSTEMS, Scene, load_scene
from torchrl_gn.training import Checkpoint, load_pretrained, pretrained_names
from torchrl_gn.training.checkpoint import POLICY_FILE
from torchrl_gn.viewer.world import Model

_BOUNDS = (-1.0, 1.0)  # bounds of actuators without any, for their sliders


def load_source(source: str, model: str | None = None) -> tuple[Scene, Model | None]:
    """Return the scene of ``source`` and its trained model, specialised for the scene; None without a model.

    Args:
        source: a system, an MJCF or URDF file, a run folder, a checkpoint, or a trained model of the package.
        model: run folder, checkpoint, or name of a trained model of the package; default: the model of the source; of a
            system, the package's model.

    Raises:
        ValueError: if there is no such scene or model, or they do not go together, or the scene has no shapes.
        OSError: if a file cannot be read.
    """
    checkpoint: Checkpoint | None = None
    if _is_checkpoint(source):
        checkpoint = load_pretrained(source)
        scene = checkpoint.scene()
    else:
        scene = load_scene(source)
        if scene.unbounded:
            scene = load_scene(source, action_bounds=_BOUNDS)
    if not isinstance(scene, Scene):
        raise ValueError(
            f"{source} is of a robot that is known by its joints alone, which has no shapes to show; give its MJCF or"
            " URDF file."
        )
    if model is not None:
        checkpoint = load_pretrained(model)
    elif checkpoint is None and (name := _shipped(scene)) is not None:
        checkpoint = load_pretrained(name)
    if checkpoint is None:
        return scene, None
    if not isinstance(checkpoint.trained, (ForwardModel, Ensemble)):
        if model is None:
            return scene, None
        raise ValueError(f"{model} holds a {type(checkpoint.trained).__name__}, no forward model to predict with.")
    bound: Any = checkpoint.trained.bind(scene)
    return scene, specialize(bound)


def load_policy(source: str, policy: str | None = None) -> BoundedPolicy | None:
    """Load ``policy``, by default the policy of ``source``; None if ``source`` has none.

    Args:
        source: as for :func:`load_source`; a run folder of ``recipes/shac.py`` has a policy.
        policy: run folder, or checkpoint of a policy over states. Default: the policy of ``source``.

    Raises:
        CheckpointError: if ``policy`` holds no policy over states, or is damaged.
    """
    folder = Path(source if policy is None else policy)
    path = folder / POLICY_FILE if folder.is_dir() else folder
    if policy is None and not (folder.is_dir() and path.is_file()):
        return None
    return load_pretrained(path).policy


def _is_checkpoint(source: str) -> bool:
    if source in SYSTEMS:
        return False
    return source in pretrained_names() or Path(source).is_dir() or Path(source).suffix == ".safetensors"


def _shipped(scene: Scene) -> str | None:
    """Return the name of the package's own model of a system; None for variants, other robots and other steps."""
    system = scene.origin.get("system")
    if system is None or "parameters" in scene.origin or scene.fingerprint() != load_scene(system).fingerprint():
        return None
    names = [system, re.sub(r"^swimmer\d+$", "swimmerN", system)]
    return next((name for name in names if name in pretrained_names()), None)
