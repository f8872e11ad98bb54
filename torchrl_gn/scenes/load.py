"""Load scenes by name, from MJCF, or from their description."""

from __future__ import annotations

import difflib
import os
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco

from torchrl_gn.scenes.articulation import Articulation, require_bodies
from torchrl_gn.scenes.build import build_scene
from torchrl_gn.scenes.control_bounds import ActionBounds, plain_bounds
from torchrl_gn.scenes.files import MissingMeshWarning, drop_missing_visuals, is_package_path, package_path
from torchrl_gn.scenes.kinematic_tree import KinematicTree
from torchrl_gn.scenes.mjcf_text import inlined, read_text, urdf_files, with_flat_files
from torchrl_gn.scenes.scaled import variant_of
from torchrl_gn.scenes.scene import Scene, SceneChangedWarning, SceneError
from torchrl_gn.scenes.stored_mjcf import checked, model_files, packed, require_stored, unpacked
from torchrl_gn.scenes.suite_tasks import suite_model_file, suite_name
from torchrl_gn.scenes.systems import SYSTEMS, find_system
from torchrl_gn.scenes.urdf import add_motors, is_urdf, refuse_xacro, with_local_meshes
from torchrl_gn.scenes.variants import build_system, make_variant

_SUFFIXES = (".xml", ".mjcf", ".urdf")
_MOST_SETTLE_STEPS = 1_000_000  # in a description


def load_scene(
    source: str | os.PathLike | mujoco.MjSpec,
    *,
    timestep: float | None = None,
    name: str | None = None,
    parameters: Mapping[str, float] | None = None,
    action_bounds: ActionBounds | None = None,
    wide_starts: float = 0.5,
    mocap_actions: bool = False,
    motors: bool = False,
) -> Scene:
    """Load a scene.

    Args:
        source: a system of the paper (``"pendulum"``, ``"cartpole"``, ``"acrobot"``, ``"swimmerN"`` with N of at least
            3, ``"cheetah"``, ``"walker2d"``, ``"jaco"``), a task of the control suite (``"suite:cheetah/run"``), an
            MJCF or URDF file, ``"package://NAME/PATH"`` for a file in an installed Python package, MJCF or URDF text,
            or an ``MjSpec``. Missing visual meshes give a warning.
        timestep: control step, seconds, a multiple of the physics step. Default: the paper's for its systems, the
            suite's for its tasks; for other models the multiple nearest to 20 ms and at most 25 ms (one physics step
            if that is longer).
        name: name of the scene; default: the name of the system, file or model.
        parameters: parameters of a variant (:func:`~torchrl_gn.scenes.parameter_ranges`), also beyond their ranges;
            those not given keep the standard system's values.
        action_bounds: for MJCF models, ``{actuator: (low, high)}``, or one pair for all actuators without bounds of
            their own (``ctrlrange``, the ``forcerange`` of a motor or the ``actuatorfrcrange`` of its joint, the range
            of a position servo's joint).
        wide_starts: for MJCF models, the share of :class:`~torchrl_gn.data.StartPoses` anywhere within the joint
            limits; the others stay near the reference pose.
        mocap_actions: for MJCF models, add actions for the poses of mocap bodies that lead others by a weld or connect:
            7 numbers each after the controls, position and quaternion. ``action_bounds`` can bound them by names such
            as ``"hand.x"``; default: positions within 0.15 m of the model's. Other mocap bodies keep the model's poses.
        motors: give each joint a motor named after it, in a model without actuators (URDF files have none). The joint's
            effort, else ``action_bounds``, bounds the motor's torque or force.

    Raises:
        ValueError: if the name or a parameter is unknown.
        FileNotFoundError: if the file does not exist.
        SceneError: if the MJCF is invalid or ``timestep`` does not fit.
        UnsupportedSceneError: if the graph cannot represent an element, which the message names.
    """
    suite = suite_name(source)
    is_system = isinstance(source, str) and not _is_mjcf(source) and find_system(source) is not None
    is_system = is_system or suite is not None
    if action_bounds is not None and (is_system or parameters is not None):
        raise ValueError(f"{source!r} has bounds of its own; action_bounds go with MJCF models.")
    if wide_starts != 0.5 and (is_system or parameters is not None):
        raise ValueError(f"{source!r} has start states of its own; wide_starts goes with MJCF models.")
    if not 0 <= wide_starts <= 1:
        raise ValueError(f"wide_starts must be a share, 0 to 1, got {wide_starts!r}")
    if mocap_actions and (is_system or parameters is not None):
        raise ValueError(f"{source!r} has no mocap bodies; mocap_actions goes with MJCF models.")
    if motors and (is_system or parameters is not None):
        raise ValueError(f"{source!r} has motors of its own; motors goes with URDF and MJCF models.")
    bounds = None if action_bounds is None else plain_bounds(action_bounds)
    chosen: dict[str, Any] = {"action_bounds": bounds, "wide_starts": wide_starts}
    chosen["mocap_actions"] = mocap_actions
    if parameters is not None:
        return make_variant(source, parameters, timestep=timestep, name=name)
    if isinstance(source, mujoco.MjSpec):
        spec: Any = source
        if motors:
            add_motors(spec := spec.copy())
        return build_scene(spec, name=name or spec.modelname, timestep=timestep, **chosen)
    if isinstance(source, mujoco.MjModel):
        raise TypeError("load_scene needs MJCF, not a compiled MjModel; give its file, text or MjSpec.")
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(f"load_scene takes a name, a path, MJCF text or an MjSpec, got {type(source).__name__}.")
    if suite is not None:
        return _suite_scene(*suite, name=name, timestep=timestep)
    if isinstance(source, str) and is_package_path(source):
        source = package_path(source)
    if isinstance(source, str) and not _is_mjcf(source):
        system = find_system(source)
        if system is not None:
            return build_system(system, system.build(), name, timestep)
        if not (source.lower().endswith(_SUFFIXES) or set("/\\") & set(source) or Path(source).is_file()):
            raise ValueError(_unknown(source))
    spec, origin = _read_mjcf(source if isinstance(source, str) else Path(source))
    own_name = spec.modelname if isinstance(source, str) and _is_mjcf(source) else Path(source).stem
    if bounds is not None:
        origin["action_bounds"] = bounds
    if wide_starts != 0.5:
        origin["wide_starts"] = float(wide_starts)
    if mocap_actions:
        origin["mocap_actions"] = True
    if motors:
        add_motors(spec)
        origin["motors"] = True
    return build_scene(spec, name=name or own_name, timestep=timestep, origin=origin, **chosen)


def as_scene(scene: Any) -> Any:
    """Return the scene of a name, path, MJCF text or ``MjSpec``, or a list of scenes of a sequence of these.

    Scenes are returned as they are.

    Raises:
        TypeError: it is none of these.
        ValueError: the sequence is empty.
    """
    if isinstance(scene, Articulation):
        return scene
    if isinstance(scene, (str, os.PathLike, mujoco.MjSpec)):
        return load_scene(scene)
    if isinstance(scene, Sequence):
        if not scene:
            raise ValueError("There must be at least one scene.")
        return [as_scene(each) for each in scene]
    call = ": call it" if callable(scene) else ""
    raise TypeError(f"A scene must be a Scene, a KinematicTree, a name or a path, got {scene!r}{call}.")


def scene_from_description(description: dict) -> Articulation:
    """Rebuild a scene from its :meth:`Scene.description`; SceneChangedWarning if its physics differ here.

    Descriptions are not trusted: stored MJCF may read its stored files only, and excessive sizes are refused.

    Raises:
        SceneError: if the description is damaged, of another version, or exceeds a size limit.
        ValueError: if the description names an unknown system, or a robot without joints.
    """
    try:
        scene = _rebuilt(description)
        expected = description["fingerprint"]
    except ValueError:
        raise
    except (LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, mujoco.FatalError) as error:
        raise SceneError(
            f"The description of a scene is damaged, or of another version of torchrl_gn ({type(error).__name__}:"
            f" {error})."
        ) from error
    if scene.fingerprint() != expected:
        warnings.warn(
            f"Scene {scene.name!r} has other physics than its description; results may differ "
            f"(MuJoCo {mujoco.__version__} here).",
            SceneChangedWarning,
            stacklevel=2,
        )
    return scene


def _rebuilt(description: dict) -> Articulation:
    if "kinematic_tree" in description:
        return KinematicTree.from_description(description)
    system = find_system(description["system"]) if "system" in description else None
    if system is None and "system" in description:
        raise ValueError(_unknown(description["system"]))
    name, timestep, settle_steps = description["name"], description["timestep"], description["settle_steps"]
    if not isinstance(name, str) or not 0 <= settle_steps <= _MOST_SETTLE_STEPS:
        raise SceneError(f"A stored scene has name={name!r} and settle_steps={settle_steps!r}, which are not valid.")
    if "factors" in description:
        unchanged = {key: value for key, value in description.items() if key != "factors"}
        factors = [(str(array), [int(row) for row in rows], float(by)) for array, rows, by in description["factors"]]
        return variant_of(require_bodies(_rebuilt(unchanged), "A variant"), factors)
    if system and "parameters" in description:
        return make_variant(system.name, description["parameters"], timestep=timestep, name=name)
    keys = ("system", "suite", "mjcf", "assets", "action_bounds", "wide_starts", "mocap_actions", "motors")
    return build_scene(
        system.build() if system else _rebuild_mjcf(description),
        name=name,
        timestep=timestep,
        settle_steps=settle_steps,
        action_bounds=description.get("action_bounds"),
        wide_starts=description.get("wide_starts", 0.5),
        mocap_actions=description.get("mocap_actions", False),
        origin={key: description[key] for key in keys if key in description},
    )


def _suite_scene(domain: str, task: str, *, name: str | None, timestep: float | None) -> Scene:
    """Load the scene of a task of the control suite."""
    with suite_model_file(domain, task) as (path, step):
        spec, origin = _read_mjcf(path)
        origin["suite"] = f"{domain}/{task}"
        return build_scene(spec, name=name or f"{domain}-{task}", timestep=timestep or step, origin=origin)


def _unknown(name: str) -> str:
    names = ["swimmerN" if known == "swimmer6" else known for known in SYSTEMS]
    close = difflib.get_close_matches(name.lower(), SYSTEMS, n=1)
    hint = f" Did you mean {close[0]!r}?" if close else ""
    return (
        f"Unknown scene {name!r}.{hint} Known systems: {', '.join(names)} (N of at least 3); "
        "or give the path of an MJCF or URDF file."
    )


def _read_mjcf(source: str | Path) -> tuple[mujoco.MjSpec, dict]:
    """Parse an MJCF file or text; also return ``{"mjcf": text, "assets": {path: base64}}`` to rebuild it from."""
    path = None if isinstance(source, str) and _is_mjcf(source) else Path(source)
    if path is not None and not path.is_file():
        raise FileNotFoundError(f"MJCF file not found: {path}")
    if path is not None and zipfile.is_zipfile(path):
        raise SceneError(f"{path} is an archive: unpack it, and load the XML file in it.")
    text, folder = (str(source).lstrip("\ufeff"), Path()) if path is None else (read_text(path), path.parent)
    renamed: dict[str, bytes] = {}
    if urdf := is_urdf(text):
        refuse_xacro(text)
        text, renamed = with_local_meshes(text, folder)
    try:
        if path is not None and path.suffix == ".xml" and not urdf:
            spec = mujoco.MjSpec.from_file(str(path))
        else:  # MuJoCo reads no files with other suffixes, such as .mjcf or .URDF
            spec = mujoco.MjSpec.from_string(text if path is None else inlined(text, folder), assets=renamed)
            spec.modelfiledir = "" if path is None else str(folder)
    except ValueError as error:
        label = "string" if path is None else f"file {path}"
        raise SceneError(f"MuJoCo cannot read the {'URDF' if urdf else 'MJCF'} {label}: {error}") from error
    if urdf:
        contents = urdf_files(spec, folder) | renamed
        dropped = drop_missing_visuals(spec, lambda file: str(file) in contents)
    else:
        text, flat = with_flat_files(text, folder)
        contents, dropped = flat.contents, drop_missing_visuals(spec, flat.has)
    checked(text, contents)  # fail now, not when the stored scene is read again
    if dropped:
        few = ", ".join(dropped[:3]) + ", ..." * (len(dropped) > 3)
        warnings.warn(
            f"{len(dropped)} visual meshes of {path or 'the MJCF text'} are missing ({few}): drawn without them.",
            MissingMeshWarning,
            stacklevel=3,
        )
    return spec, {"mjcf": text, "assets": packed(contents)}


def _rebuild_mjcf(origin: dict) -> mujoco.MjSpec:
    """Parse the model that :func:`_read_mjcf` stored."""
    text, assets = checked(origin["mjcf"], unpacked(origin["assets"]))
    # MuJoCo reads attached models and flexes with the text, other files when compiling.
    early: dict[str, Any] = {"include": assets} if "<model" in text or "<flexcomp" in text else {}
    if early and not hasattr(mujoco, "MjVfs"):
        raise SceneError(
            f"MuJoCo {mujoco.__version__} cannot read a stored scene with attached models or files of flexes, which"
            " it looks for on disk alone: update to 3.4."
        )
    try:
        spec = mujoco.MjSpec.from_string(text, assets=assets, **early)
    except ValueError as error:
        raise SceneError(f"MuJoCo {mujoco.__version__} cannot read a stored scene: {error}") from error
    drop_missing_visuals(spec, lambda file: str(file) in assets)
    require_stored(model_files(spec), assets)
    if origin.get("motors"):
        add_motors(spec)
    return spec


def _is_mjcf(source: str) -> bool:
    """Return True if a string is MJCF or URDF text, not a name or a path."""
    return source.lstrip("\ufeff \t\r\n").startswith("<")
