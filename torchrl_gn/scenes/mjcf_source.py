"""Read MJCF with everything that rebuilds it: includes inlined, assets in base64."""

from __future__ import annotations

import base64
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from torchrl_gn.scenes.scene import SceneError


def read_mjcf(source: str | Path) -> tuple[mujoco.MjSpec, dict]:
    """Parse an MJCF file or text; also return ``{"mjcf": text, "assets": {path: base64}}`` for :func:`rebuild_mjcf`.

    Raises FileNotFoundError if the file does not exist, SceneError if MuJoCo cannot parse it.
    """
    path = None if isinstance(source, str) and is_mjcf_text(source) else Path(source)
    if path is not None and not path.is_file():
        raise FileNotFoundError(f"MJCF file not found: {path}")
    try:
        kind = mujoco.MjSpec
        spec = kind.from_string(str(source)) if path is None else kind.from_file(str(path))
    except ValueError as error:
        label = "string" if path is None else f"file {path}"
        raise SceneError(f"MuJoCo cannot read the MJCF {label}: {error}") from error
    text = str(source) if path is None else path.read_text()
    folder = Path() if path is None else path.parent
    return spec, {"mjcf": _inline(text, folder), "assets": _assets(spec, folder)}


def rebuild_mjcf(origin: dict) -> mujoco.MjSpec:
    """Parse what :func:`read_mjcf` stored."""
    assets = {name: base64.b64decode(content) for name, content in origin["assets"].items()}
    return mujoco.MjSpec.from_string(origin["mjcf"], assets=assets)


def is_mjcf_text(source: str) -> bool:
    """Whether a string is MJCF text rather than a name or a path."""
    return source.lstrip().startswith("<")


def _inline(text: str, folder: Path) -> str:
    """Replace every ``<include file=.../>`` by the content of its file."""
    if "<include" not in text:
        return text
    root = ElementTree.fromstring(text)
    _inline_children(root, folder)
    return ElementTree.tostring(root, encoding="unicode")


def _inline_children(element: ElementTree.Element, folder: Path) -> None:
    children = list(element)
    element[:] = []
    for child in children:
        included = child.tag == "include"  # always relative to the main file
        if included:
            child = ElementTree.parse(folder / child.attrib["file"]).getroot()
        _inline_children(child, folder)
        element.extend(list(child) if included else [child])


def _assets(spec: mujoco.MjSpec, folder: Path) -> dict[str, str]:
    """Encode the files that a model reads, by the path under which MuJoCo asks for them."""
    textures = [texture.file for texture in spec.textures]
    textures += [file for texture in spec.textures for file in texture.cubefiles]
    wanted = [(spec.meshdir, mesh.file) for mesh in [*spec.meshes, *spec.hfields, *spec.skins]]
    wanted += [(spec.texturedir, file) for file in textures]
    assets = {}
    for directory, file in wanted:
        path = folder / directory / file
        if file and path.is_file():
            assets[str(Path(directory, file))] = base64.b64encode(path.read_bytes()).decode("ascii")
    return assets
