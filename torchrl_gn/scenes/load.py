"""Load scenes by name, from MJCF, or from their description."""

from __future__ import annotations

import difflib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import mujoco

from torchrl_gn.scenes.build import build_scene
from torchrl_gn.scenes.kinematic_tree import KinematicTree
from torchrl_gn.scenes.mjcf_source import is_mjcf_text, read_mjcf, rebuild_mjcf
from torchrl_gn.scenes.scene import Scene, SceneChangedWarning
from torchrl_gn.scenes.systems import SYSTEMS, find_system
from torchrl_gn.scenes.variants import make_variant


def load_scene(
    source: str | Path | mujoco.MjSpec,
    *,
    timestep: float | None = None,
    name: str | None = None,
    parameters: Mapping[str, float] | None = None,
) -> Scene:
    """Load a scene.

    Args:
        source: a system of the paper (``"pendulum"``, ``"cartpole"``, ``"acrobot"``, ``"swimmerN"`` with N of at least
            3, ``"cheetah"``, ``"walker2d"``, ``"jaco"``), the path of an MJCF file, MJCF text, or an ``MjSpec``.
        timestep: control step, seconds, a multiple of the physics step; default: the paper's for its systems, one
            physics step for other models.
        name: name of the scene; default: that of the system, file or model.
        parameters: parameters of a variant (:func:`~torchrl_gn.scenes.parameter_ranges`), also beyond their ranges; the
            others are the standard system's.

    Raises:
        ValueError: if the name or a parameter is unknown; FileNotFoundError if the file does not exist.
        SceneError: if the MJCF is invalid or ``timestep`` does not fit.
        UnsupportedSceneError: if the graph cannot represent an element, which the message names.
    """
    if parameters is not None:
        return make_variant(source, parameters, timestep=timestep, name=name)
    if isinstance(source, mujoco.MjSpec):
        spec: Any = source
        return build_scene(spec, name=name or spec.modelname, timestep=timestep)
    if isinstance(source, mujoco.MjModel):
        raise TypeError("load_scene needs MJCF, not a compiled MjModel; give its file, text or MjSpec.")
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(f"load_scene takes a name, a path, MJCF text or an MjSpec, got {type(source).__name__}.")
    if isinstance(source, str) and not is_mjcf_text(source):
        system = find_system(source)
        if system is not None:
            return build_scene(
                system.build(),
                name=name or system.name,
                timestep=system.timestep if timestep is None else timestep,
                settle_steps=system.settle_steps,
                origin={"system": system.name},
            )
        if not (source.endswith((".xml", ".mjcf")) or set("/\\") & set(source) or Path(source).is_file()):
            raise ValueError(_unknown(source))
    spec, origin = read_mjcf(source if isinstance(source, str) else Path(source))
    own_name = spec.modelname if isinstance(source, str) and is_mjcf_text(source) else Path(source).stem
    return build_scene(spec, name=name or own_name, timestep=timestep, origin=origin)


def scene_from_description(description: dict) -> Scene:
    """Rebuild the scene of a :meth:`Scene.description`.

    Warns SceneChangedWarning if its physics differ, as with another version of MuJoCo or of the model files.
    """
    if "kinematic_tree" in description:
        # It has every attribute of a scene that models and errors read.
        return cast(Scene, KinematicTree.from_description(description))
    system = find_system(description["system"]) if "system" in description else None
    if system is None and "system" in description:
        raise ValueError(_unknown(description["system"]))
    name, timestep = description["name"], description["timestep"]
    if system and "parameters" in description:
        scene = make_variant(system.name, description["parameters"], timestep=timestep, name=name)
    else:
        keys = ("system",) if system else ("mjcf", "assets")
        scene = build_scene(
            system.build() if system else rebuild_mjcf(description),
            name=name,
            timestep=timestep,
            settle_steps=description["settle_steps"],
            origin={key: description[key] for key in keys},
        )
    if scene.fingerprint() != description["fingerprint"]:
        warnings.warn(
            f"Scene {scene.name!r} has other physics than its description; results may differ "
            f"(MuJoCo {mujoco.__version__} here).",
            SceneChangedWarning,
            stacklevel=2,
        )
    return scene


def _unknown(name: str) -> str:
    names = ["swimmerN" if known == "swimmer6" else known for known in SYSTEMS]
    close = difflib.get_close_matches(name.lower(), SYSTEMS, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return (
        f"Unknown scene {name!r}.{hint} Known systems: {', '.join(names)} (N of at least 3); "
        "or give the path of an MJCF file."
    )
