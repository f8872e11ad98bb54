"""Files of MJCF models: paths in Python packages, and visual meshes that are missing."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import mujoco

_PACKAGE = "package://"


class MissingMeshWarning(UserWarning):
    """A model's visual meshes are missing: physics is unaffected, and pictures lack them."""


def is_package_path(source: str) -> bool:
    """Return True if a source names a file of an installed Python package."""
    return source.startswith(_PACKAGE)


def package_path(source: str) -> Path:
    """Return the path of ``package://NAME/PATH``, a file of an installed Python package.

    Raises:
        ValueError: if the source names no file.
        FileNotFoundError: if the package is not installed, or has no such file.
    """
    package, _, file = source.removeprefix(_PACKAGE).partition("/")
    if not package or not file:
        raise ValueError(f"{source!r} must be {_PACKAGE}NAME/PATH, a file of an installed Python package.")
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise FileNotFoundError(f"{source} needs the Python package {package!r}, which is not installed.")
    path = Path(next(iter(spec.submodule_search_locations))) / file
    if not path.is_file():
        raise FileNotFoundError(f"The installed package {package!r} has no file {file!r}.")
    return path


def drop_missing_visuals(spec: mujoco.MjSpec, exists: Callable[[Path], bool]) -> list[str]:
    """Remove missing meshes that only pictures need, with their geoms; return the meshes' names.

    Only pictures need a mesh if none of its geoms can collide and their bodies have explicit inertias. Other missing
    meshes stay, and MuJoCo's error names them.
    """
    missing = {
        mesh.name or Path(mesh.file).stem
        for mesh in spec.meshes
        if mesh.file and not exists(Path(spec.meshdir, mesh.file))
    }
    if not missing:
        return []
    users: dict[str, list] = {name: [] for name in missing}
    for body in spec.bodies:
        for geom in body.geoms:
            if geom.meshname in missing:
                users[geom.meshname].append((body, geom))
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    droppable = [
        name
        for name in sorted(missing)
        if all(
            not geom.contype and not geom.conaffinity and geom.name not in paired and body.explicitinertial
            for body, geom in users[name]
        )
    ]
    for name in droppable:
        for _, geom in users[name]:
            _delete(spec, geom)
    for mesh in [mesh for mesh in spec.meshes if (mesh.name or Path(mesh.file).stem) in droppable]:
        _delete(spec, mesh)
    return droppable


def _delete(spec: mujoco.MjSpec, element) -> None:
    # MuJoCo before 3.3.3 deletes by the element itself.
    spec.delete(element) if hasattr(spec, "delete") else element.delete()
