"""Text and files of an MJCF model, enough to rebuild its scene on any machine."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from torchrl_gn.scenes.flat_files import FlatFiles, Places, with_slashes
from torchrl_gn.scenes.scene import SceneError
from torchrl_gn.scenes.stored_mjcf import decoded, model_files, parsed
from torchrl_gn.scenes.xml_comments import without_comments


def read_text(path: Path) -> str:
    """Read an MJCF file as UTF-8; replace bytes of other encodings, which only comments may have."""
    return decoded(path.read_bytes())


def inlined(text: str, folder: Path) -> str:
    """Return the text with every ``<include>`` replaced by the content of its file.

    Raises:
        SceneError: if the text or an included file is not XML, or an included file is not found.
    """
    if "<include" not in without_comments(text):
        return text
    return ElementTree.tostring(_inlined_root(text, folder)[0], encoding="unicode")


def with_flat_files(text: str, folder: Path) -> tuple[str, FlatFiles]:
    """Return MJCF text without includes, whose files have names without folders, and these files.

    Raises:
        SceneError: if the text, an included file or an attached model is not XML, or an included file is not found.
    """
    flat = FlatFiles(_read_file, lambda path, content: _inlined_root(decoded(content), Path(path).parent))
    if "file" not in text:
        return text, flat
    root, places = _inlined_root(text, folder)
    flat.flatten(root, str(folder), places)
    return ElementTree.tostring(root, encoding="unicode"), flat


def _inlined_root(text: str, folder: Path) -> tuple[ElementTree.Element, Places]:
    """Parse a text and replace its includes; also return the folders of the included elements' files."""
    root, places = parsed(text, "the MJCF text"), dict[ElementTree.Element, str]()
    _inline_children(root, folder, folder, places)
    return root, places


def _inline_children(
    element: ElementTree.Element, folder: Path, here: Path, places: dict[ElementTree.Element, str]
) -> None:
    """Replace includes below an element; MuJoCo looks in ``folder``, the main file's, and in ``here``, this file's."""
    children = list(element)
    element[:] = []
    for child in children:
        if child.tag != "include":
            if here is not folder:
                places[child] = str(here)
            _inline_children(child, folder, here, places)
            element.append(child)
            continue
        path = _find_file(with_slashes(child.attrib["file"]), folder, here)
        if path is None:
            raise SceneError(f"The file {child.attrib['file']!r} that the model includes is not found from {folder}.")
        root = parsed(read_text(path), f"the included file {path}")
        _inline_children(root, folder, path.parent, places)
        element.extend(root)


def _find_file(file: str, *folders: Path) -> Path | None:
    """Find a file in one of the folders; as MuJoCo does, resolve ``..`` in paths before following links."""
    for folder in folders:
        for path in (Path(os.path.normpath(folder / file)), folder / file):
            if path.is_file():
                return path
    return None


def _read_file(file: str) -> tuple[str, bytes] | None:
    path = _find_file(file, Path())
    return None if path is None else (str(path), path.read_bytes())


def urdf_files(spec: mujoco.MjSpec, folder: Path) -> dict[str, bytes]:
    """Return the contents of the files that a URDF model reads, by the path under which MuJoCo asks for them."""
    found = {str(file): _find_file(str(file), folder) for file in model_files(spec)}
    return {file: path.read_bytes() for file, path in found.items() if path is not None}
