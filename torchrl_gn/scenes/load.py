"""Load scenes by name, from MJCF, or from their description."""

from __future__ import annotations

import difflib
import os
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import mujoco

from torchrl_gn.scenes.build import build_scene
from torchrl_gn.scenes.control_bounds import ActionBounds, plain_bounds
from torchrl_gn.scenes.files import MissingMeshWarning, drop_missing_visuals, is_package_path, package_path
from torchrl_gn.scenes.kinematic_tree import KinematicTree
from torchrl_gn.scenes.mjcf_text import decoded_assets, encoded_assets, inlined, is_among, read_text, reads_files_early
from torchrl_gn.scenes.scene import Scene, SceneChangedWarning, SceneError
from torchrl_gn.scenes.systems import SYSTEMS, find_system
from torchrl_gn.scenes.variants import build_system, make_variant


def load_scene(
    source: str | os.PathLike | mujoco.MjSpec,
    *,
    timestep: float | None = None,
    name: str | None = None,
    parameters: Mapping[str, float] | None = None,
    action_bounds: ActionBounds | None = None,
    wide_starts: float = 0.5,
) -> Scene:
    """Load a scene.

    Args:
        source: a system of the paper (``"pendulum"``, ``"cartpole"``, ``"acrobot"``, ``"swimmerN"`` with N of at least
            3, ``"cheetah"``, ``"walker2d"``, ``"jaco"``), the path of an MJCF file, ``"package://NAME/PATH"`` of one in
            an installed Python package, MJCF text, or an ``MjSpec``. Visual meshes may be missing, which warns.
        timestep: control step, seconds, a multiple of the physics step; default: the paper's for its systems, the
            multiple nearest to 20 ms and at most 25 ms for other models (one physics step if that is longer).
        name: name of the scene; default: that of the system, file or model.
        parameters: parameters of a variant (:func:`~torchrl_gn.scenes.parameter_ranges`), also beyond their ranges; the
            others are the standard system's.
        action_bounds: of an MJCF model, ``{actuator: (low, high)}``, or one pair for all that have no bounds of their
            own (``ctrlrange``, a motor's ``forcerange``, the range of a position servo's joint).
        wide_starts: of an MJCF model, the share of :class:`~torchrl_gn.data.StartPoses` anywhere within the joint
            limits; the others stay near the reference pose.

    Raises:
        ValueError: if the name or a parameter is unknown; FileNotFoundError if the file does not exist.
        SceneError: if the MJCF is invalid or ``timestep`` does not fit.
        UnsupportedSceneError: if the graph cannot represent an element, which the message names.
    """
    is_system = isinstance(source, str) and not _is_mjcf(source) and find_system(source) is not None
    if action_bounds is not None and (is_system or parameters is not None):
        raise ValueError(f"{source!r} has bounds of its own; action_bounds go with MJCF models.")
    if wide_starts != 0.5 and (is_system or parameters is not None):
        raise ValueError(f"{source!r} has start states of its own; wide_starts goes with MJCF models.")
    if not 0 <= wide_starts <= 1:
        raise ValueError(f"wide_starts must be a share, 0 to 1, got {wide_starts!r}")
    chosen: dict[str, Any] = {"action_bounds": action_bounds, "wide_starts": wide_starts}
    if parameters is not None:
        return make_variant(source, parameters, timestep=timestep, name=name)
    if isinstance(source, mujoco.MjSpec):
        spec: Any = source
        return build_scene(spec, name=name or spec.modelname, timestep=timestep, **chosen)
    if isinstance(source, mujoco.MjModel):
        raise TypeError("load_scene needs MJCF, not a compiled MjModel; give its file, text or MjSpec.")
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(f"load_scene takes a name, a path, MJCF text or an MjSpec, got {type(source).__name__}.")
    if isinstance(source, str) and is_package_path(source):
        source = package_path(source)
    if isinstance(source, str) and not _is_mjcf(source):
        system = find_system(source)
        if system is not None:
            return build_system(system, system.build(), name, timestep)
        if not (source.endswith((".xml", ".mjcf")) or set("/\\") & set(source) or Path(source).is_file()):
            raise ValueError(_unknown(source))
    spec, origin = _read_mjcf(source if isinstance(source, str) else Path(source))
    own_name = spec.modelname if isinstance(source, str) and _is_mjcf(source) else Path(source).stem
    if action_bounds is not None:
        origin["action_bounds"] = plain_bounds(action_bounds)
    if wide_starts != 0.5:
        origin["wide_starts"] = float(wide_starts)
    return build_scene(spec, name=name or own_name, timestep=timestep, origin=origin, **chosen)


def as_scene(scene: Any) -> Any:
    """A scene, or several, as they are; that of a name, path or MJCF text."""
    return load_scene(scene) if isinstance(scene, (str, os.PathLike)) else scene


def scene_from_description(description: dict) -> Scene:
    """Rebuild the scene of a :meth:`Scene.description`; SceneChangedWarning if its physics differ here."""
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
        keys = ("system", "mjcf", "assets", "action_bounds", "wide_starts")
        scene = build_scene(
            system.build() if system else _rebuild_mjcf(description),
            name=name,
            timestep=timestep,
            settle_steps=description["settle_steps"],
            action_bounds=description.get("action_bounds"),
            wide_starts=description.get("wide_starts", 0.5),
            origin={key: description[key] for key in keys if key in description},
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


def _read_mjcf(source: str | Path) -> tuple[mujoco.MjSpec, dict]:
    """Parse an MJCF file or text; also return ``{"mjcf": text, "assets": {path: base64}}``, which rebuilds it."""
    path = None if isinstance(source, str) and _is_mjcf(source) else Path(source)
    if path is not None and not path.is_file():
        raise FileNotFoundError(f"MJCF file not found: {path}")
    if path is not None and zipfile.is_zipfile(path):
        raise SceneError(f"{path} is an archive: unpack it, and load the XML file in it.")
    try:
        kind = mujoco.MjSpec
        spec = kind.from_string(str(source)) if path is None else kind.from_file(str(path))
    except ValueError as error:
        label = "string" if path is None else f"file {path}"
        raise SceneError(f"MuJoCo cannot read the MJCF {label}: {error}") from error
    text, folder = (str(source), Path()) if path is None else (read_text(path), path.parent)
    text = inlined(text, folder)
    assets = encoded_assets(spec, text, folder)
    if dropped := drop_missing_visuals(spec, lambda file: is_among(file, assets, text)):
        few = ", ".join(dropped[:3]) + ", ..." * (len(dropped) > 3)
        warnings.warn(
            f"{len(dropped)} visual meshes of {path or 'the MJCF text'} are missing ({few}): drawn without them.",
            MissingMeshWarning,
            stacklevel=3,
        )
    return spec, {"mjcf": text, "assets": assets}


def _rebuild_mjcf(origin: dict) -> mujoco.MjSpec:
    """Parse what :func:`_read_mjcf` stored."""
    assets, text = decoded_assets(origin["assets"]), origin["mjcf"]
    # Attached models and flexes are read with the text, other files when it is compiled.
    early: dict[str, Any] = {"include": assets} if reads_files_early(text) else {}
    try:
        spec = mujoco.MjSpec.from_string(text, assets=assets, **early)
    except ValueError as error:
        raise SceneError(f"MuJoCo {mujoco.__version__} cannot read a stored scene: {error}") from error
    drop_missing_visuals(spec, lambda file: is_among(file, assets, text))
    return spec


def _is_mjcf(source: str) -> bool:
    """Whether a string is MJCF text rather than a name or a path."""
    return source.lstrip().startswith("<")
