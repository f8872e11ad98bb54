"""Files that a model reads, under names without folders: its text and these files then need no folder."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path, PurePath
from xml.etree import ElementTree

_DIRECTORY = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "flexcomp": "meshdir", "texture": "texturedir"}
_FILES = ("file", "filename", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")
_NAMED = ("mesh", "hfield", "skin", "texture")  # elements that without a name have their file's
_MISSING = "missing/"  # a folder that no flat name has

Places = Mapping[ElementTree.Element, str]
"""Folders of the included files that elements come from; none for elements of the main file."""


class FlatFiles:
    """Names without folders for the files of a model and of the models that it attaches.

    Args:
        find: returns the path and the content of a file; None if there is none.
        read: returns the root element of an attached model, and the places of its elements, from path and content.
        digests: put a digest of the content into each name, as older versions of MuJoCo cache files from memory by
            their name alone.
    """

    def __init__(
        self,
        find: Callable[[str], tuple[str, bytes] | None],
        read: Callable[[str, bytes], tuple[ElementTree.Element, Places]],
        *,
        digests: bool = False,
    ) -> None:
        self.contents: dict[str, bytes] = {}  # by the new name
        self._find, self._read, self._digests = find, read, digests
        self._names: dict[str, str] = {}  # new names by path
        self._found: set[str] = set()  # files of the main model, as MuJoCo names them, and absolute
        self._found_inside: set[str] = set()  # base names of files of attached models, whose folders MuJoCo hides

    def has(self, file: Path) -> bool:
        """Return True if a file was found, given as the folder of MuJoCo's compiler with the file's name in the model.

        Files of attached models are known by their base name alone.
        """
        # MuJoCo gives files beside an included file as absolute paths.
        file = Path(with_slashes(str(file)))
        return bool({str(file), os.path.abspath(file)} & self._found) or file.name in self._found_inside

    def name(self, path: str) -> str:
        """Return the new name of the file at a path that was found."""
        return self._names[path]

    def flatten(self, root: ElementTree.Element, folder: str, places: Places | None = None) -> None:
        """Replace the names of files in a main model, in place; ``folder`` is where it looks for them."""
        self._flatten(root, folder, places or {}, attached=False)

    def _flatten(self, root: ElementTree.Element, folder: str, places: Places, *, attached: bool) -> None:
        directories, strips = _directories(root)
        for element in root.iter():
            if element.tag != "model" and element.tag not in _DIRECTORY:
                continue
            directory = "" if element.tag == "model" else directories[_DIRECTORY[element.tag]]
            for attribute in _FILES:
                if not (name := with_slashes(element.get(attribute, ""))):
                    continue
                if attribute == "file" and element.tag in _NAMED and not element.get("name"):
                    element.set("name", PurePath(name).stem)
                plain = PurePath(name).name if strips and element.tag != "model" else name
                # MuJoCo looks beside the main file, then beside an included one; for models beside the latter alone.
                beside = [os.path.join(places[element], plain)] if element in places else []
                main = [os.path.join(folder, directory, plain)]
                wanted = (beside or main) if element.tag == "model" else main + beside
                found = next((each for each in map(self._find, wanted) if each is not None), None)
                if found is None:
                    element.set(attribute, name if os.path.dirname(name) else _MISSING + name)
                    continue
                self._found_inside |= {PurePath(name).name} if attached else set()
                self._found |= set() if attached else {str(Path(directory, name)), os.path.abspath(found[0])}
                element.set(attribute, self._add(*found, is_model=element.tag == "model"))
        for compiler in root.iter("compiler"):
            for attribute in ("meshdir", "texturedir", "assetdir", "strippath"):
                compiler.attrib.pop(attribute, None)

    def _add(self, path: str, content: bytes, *, is_model: bool) -> str:
        if path not in self._names:
            self._names[path] = name = self._free(PurePath(path), content)
            if is_model:
                root, places = self._read(path, content)
                self._flatten(root, os.path.dirname(path), places, attached=True)
                content = ElementTree.tostring(root)
            self.contents[name] = content
        return self._names[path]

    def _free(self, path: PurePath, content: bytes) -> str:
        """Return a name that differs from all others, also in lower case, by which MuJoCo may compare."""
        stem = path.stem + f"-{hashlib.sha256(content).hexdigest()[:16]}" * self._digests
        taken, number, free = {each.lower() for each in self._names.values()}, 0, stem + path.suffix
        while free.lower() in taken:
            number += 1
            free = f"{stem}-{number}{path.suffix}"
        return free


def with_slashes(path: str) -> str:
    """Replace backslashes in a path, which MuJoCo takes for slashes, by slashes."""
    return path.replace("\\", "/")


def _directories(root: ElementTree.Element) -> tuple[dict[str, str], bool]:
    """Return the compiler's folders of meshes and of textures, and whether it strips the folders of files."""
    directories, strips = {"meshdir": "", "texturedir": ""}, False
    for compiler in root.iter("compiler"):
        both = compiler.get("assetdir")
        for name, before in directories.items():
            directories[name] = with_slashes(compiler.get(name, before if both is None else both))
        strips = compiler.get("strippath", str(strips).lower()) == "true"
    return directories, strips
