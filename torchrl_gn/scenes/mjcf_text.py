"""The text of an MJCF model and of the files that it reads, from which its scene is rebuilt anywhere."""

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
    """Text of an MJCF file in any encoding: its elements are ASCII or UTF-8, only comments may be otherwise."""
    return path.read_bytes().decode("utf-8-sig", errors="replace")


def inlined(text: str, folder: Path) -> str:
    """The text with the content of every included file in place of its ``<include>``.

    Raises:
        SceneError: if an included file is not XML, or not found.
    """
    if "<include" not in _COMMENT.sub("", text):
        return text
    root = parsed(text, "the MJCF text")
    _inline_children(root, folder, folder)
    return ElementTree.tostring(root, encoding="unicode")


def _inline_children(element: ElementTree.Element, folder: Path, here: Path) -> None:
    """``folder`` is that of the main file, ``here`` that of the file with the element: MuJoCo looks in both."""
    children = list(element)
    element[:] = []
    for child in children:
        if child.tag != "include":
            _inline_children(child, folder, here)
            element.append(child)
            continue
        path = _found(child.attrib["file"], folder, here)
        if path is None:
            raise SceneError(f"The file {child.attrib['file']!r} that the model includes is not found from {folder}.")
        root = parsed(read_text(path), f"the included file {path}")
        _inline_children(root, folder, path.parent)
        element.extend(root)


def _found(file: str, *folders: Path) -> Path | None:
    """A file in one of some folders; paths are shortened before links are followed, as MuJoCo does."""
    for folder in folders:
        for path in (Path(os.path.normpath(folder / file)), folder / file):
            if path.is_file():
                return path
    return None


def model_assets(spec: mujoco.MjSpec, text: str, folder: Path) -> dict[str, bytes]:
    """Contents of the files that a model reads, by the path under which MuJoCo asks for them."""
    return dict(_files(spec, text, folder))


def reads_files_early(text: str) -> bool:
    """Whether a model attaches others, or has flexes, whose files MuJoCo reads with the text."""
    return "<model" in text or "<flexcomp" in text


def _files(spec: mujoco.MjSpec, text: str, folder: Path) -> Iterator[tuple[str, bytes]]:
    wanted = list(model_files(spec))
    root = parsed(text, "the MJCF text") if reads_files_early(text) else ElementTree.Element("none")
    flexes = [file for flex in root.iter("flexcomp") if (file := flex.get("file"))]
    wanted += [Path(place, file) for file in flexes for place in (spec.meshdir, "")]
    for file in wanted:
        if path := _found(str(file), folder):
            yield str(file), path.read_bytes()
    # Models that are attached, with what these read in turn.
    for model in root.iter("model"):
        if (file := model.get("file")) and (path := _found(file, folder)):
            own = inlined(read_text(path), path.parent)
            yield file, own.encode()
            for name, content in _files(mujoco.MjSpec.from_file(str(path)), own, path.parent):
                yield str(Path(file).parent / name), content
