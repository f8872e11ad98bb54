"""Text and files of an MJCF model, enough to rebuild its scene on any machine."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from torchrl_gn.scenes.scene import SceneError
from torchrl_gn.scenes.stored_mjcf import model_files, parsed

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


def read_text(path: Path) -> str:
    """Read an MJCF file as UTF-8; replace bytes of other encodings, which only comments may have."""
    return path.read_bytes().decode("utf-8-sig", errors="replace")


def inlined(text: str, folder: Path) -> str:
    """Return the text with every ``<include>`` replaced by the content of its file.

    Raises:
        SceneError: if the text or an included file is not XML, or an included file is not found.
    """
    if "<include" not in _COMMENT.sub("", text):
        return text
    root = parsed(text, "the MJCF text")
    _inline_children(root, folder, folder)
    return ElementTree.tostring(root, encoding="unicode")


def _inline_children(element: ElementTree.Element, folder: Path, here: Path) -> None:
    """Replace includes below an element; MuJoCo looks in ``folder``, the main file's, and in ``here``, this file's."""
    children = list(element)
    element[:] = []
    for child in children:
        if child.tag != "include":
            _inline_children(child, folder, here)
            element.append(child)
            continue
        path = _find_file(child.attrib["file"], folder, here)
        if path is None:
            raise SceneError(f"The file {child.attrib['file']!r} that the model includes is not found from {folder}.")
        root = parsed(read_text(path), f"the included file {path}")
        _inline_children(root, folder, path.parent)
        element.extend(root)


def _find_file(file: str, *folders: Path) -> Path | None:
    """Find a file in one of the folders; as MuJoCo does, resolve ``..`` in paths before following links."""
    for folder in folders:
        for path in (Path(os.path.normpath(folder / file)), folder / file):
            if path.is_file():
                return path
    return None


def model_assets(spec: mujoco.MjSpec, text: str, folder: Path) -> dict[str, bytes]:
    """Return the contents of the files that a model reads, by the path under which MuJoCo asks for them."""
    return dict(_files(spec, text, folder))


def reads_files_early(text: str) -> bool:
    """Return True if a model attaches others or has flexes, whose files MuJoCo reads with the text."""
    return "<model" in text or "<flexcomp" in text


def _files(spec: mujoco.MjSpec, text: str, folder: Path) -> Iterator[tuple[str, bytes]]:
    paths = list(model_files(spec))
    root = parsed(text, "the MJCF text") if reads_files_early(text) else ElementTree.Element("none")
    flexes = [file for flex in root.iter("flexcomp") if (file := flex.get("file"))]
    paths += [Path(place, file) for file in flexes for place in (spec.meshdir, "")]
    for file in paths:
        if path := _find_file(str(file), folder):
            yield str(file), path.read_bytes()
    # Attached models, with the files that they read in turn.
    for model in root.iter("model"):
        if (file := model.get("file")) and (path := _find_file(file, folder)):
            inlined_text = inlined(read_text(path), path.parent)
            yield file, inlined_text.encode()
            for name, content in _files(mujoco.MjSpec.from_file(str(path)), inlined_text, path.parent):
                yield str(Path(file).parent / name), content
