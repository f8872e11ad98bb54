"""Limits on the MJCF of checkpoints and data sets: on repeated elements, memory and files.

A few lines of MJCF can ask for millions of bodies, or for files of the machine that loads it. Models over these limits
are refused before MuJoCo reads them. The limits also hold when a scene is loaded from a file, so that every trained
scene can be read again.
"""

from __future__ import annotations

import base64
import math
import os
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePath
from xml.etree import ElementTree

import mujoco

from torchrl_gn.scenes.flat_files import FlatFiles, Places, with_slashes
from torchrl_gn.scenes.scene import SceneError
from torchrl_gn.scenes.xml_comments import without_comments

_MOST_COPIES = 5_000  # limit on elements added to those in the text; MuJoCo takes seconds for 5,000
_MOST_CELLS = 50_000_000  # of textures and height fields
_TOO_MUCH = "unpack to too many bytes for their packed size."
_FREE_BYTES, _RATIO = 64_000_000, 8  # unpacked files may have the first, plus the second times their packed size
# Largest values of attributes with these names, in any element.
_MOST = {
    **dict.fromkeys(("actdim", "nuser_actuator", "nuser_body", "nuser_cam", "nuser_geom", "nuser_jnt"), 1_000),
    **dict.fromkeys(("nuser_sensor", "nuser_site", "nuser_tendon", "cellcount", "subgrid"), 1_000),
    **dict.fromkeys(("nsample", "dim", "nkey", "maxhullvert"), 10_000),
    **dict.fromkeys(("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations"), 100_000),
    **dict.fromkeys(("sdf_iterations", "sdf_initpoints", "nuserdata"), 100_000),
}
_MOST_STEPS = 100_000  # of the simulation by which MuJoCo finds a muscle's length range
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")

_DECLARATION = re.compile(r"^\s*<\?xml.*?\?>", re.DOTALL)
_DOCTYPE = re.compile(r"<!DOCTYPE[^<>\[\]]*>")  # without entities


def parsed(text: str, what: str) -> ElementTree.Element:
    """Parse a model's text and return its root element; SceneError if it is not XML, even if MuJoCo reads it."""
    # MuJoCo accepts comments that contain "--", which XML forbids.
    plain = _DOCTYPE.sub("", _DECLARATION.sub("", without_comments(text)))
    if "<!" in plain and re.search(r"<!(DOCTYPE|ENTITY)", plain):
        raise SceneError(f"{what} defines a document type or entities, which MJCF does not have; remove them.")
    try:
        return ElementTree.fromstring(plain)
    except ElementTree.ParseError as error:
        raise SceneError(f"MuJoCo reads {what}, but it is no XML that can be stored: {error}") from error


def packed(contents: Mapping[str, bytes]) -> dict[str, str]:
    """Compress a model's files to texts; SceneError if :func:`unpacked` would refuse them."""
    files = {name: base64.b64encode(zlib.compress(content)).decode("ascii") for name, content in contents.items()}
    if sum(map(len, contents.values())) > _byte_limit(files):
        raise SceneError(f"The files of a scene, {list(files)}, {_TOO_MUCH}")
    return files


def unpacked(files: Mapping[str, str]) -> dict[str, bytes]:
    """Decompress :func:`packed` files; SceneError if they are damaged or unpack to too many bytes."""
    room, contents = _byte_limit(files), {}
    for name, text in files.items():
        try:
            stream = zlib.decompressobj()
            contents[name] = stream.decompress(base64.b64decode(text), room + 1)
        except (ValueError, zlib.error) as error:
            raise SceneError(f"The file {name!r} of a stored scene is damaged: {error}") from error
        if not stream.eof and len(contents[name]) <= room:
            raise SceneError(f"The file {name!r} of a stored scene is damaged: its end is missing.")
        room -= len(contents[name])
        if room < 0:
            raise SceneError(f"The files of a scene, with {name!r}, {_TOO_MUCH}")
    return contents


def _byte_limit(files: Mapping[str, str]) -> int:
    return _FREE_BYTES + _RATIO * sum(map(len, files.values()))


def checked(text: str, files: Mapping[str, bytes]) -> tuple[str, dict[str, bytes]]:
    """Check a stored model; return its text and files for MuJoCo to read, XML rewritten from the checked elements.

    The returned files have names without folders, except those of URDF.

    Raises:
        SceneError: if XML is invalid, includes files, repeats or reserves too much, or names files that are not stored.
    """
    main, roots = parsed(text, "a stored scene"), dict[str, ElementTree.Element]()
    if main.tag == "robot":
        check_size(main, {})
        return ElementTree.tostring(main, encoding="unicode"), dict(files)
    paths = {os.path.normpath(name): name for name in files}

    def find(file: str) -> tuple[str, bytes] | None:
        name = paths.get(os.path.normpath(file))
        return None if name is None else (name, files[name])

    def read(name: str, content: bytes) -> tuple[ElementTree.Element, Places]:
        roots[name] = parsed(decoded(content), f"the file {name!r}")
        return roots[name], {}

    flat = FlatFiles(find, read, digests=True)
    flat.flatten(main, "")
    for root in (main, *roots.values()):
        if next(root.iter("include"), None) is not None:
            raise SceneError("A stored scene includes other files; stored scenes have the files' content in place.")
        for element in (*root.iter("model"), *root.iter("flexcomp")):
            if (file := element.get("file")) and file not in flat.contents:
                raise SceneError(f"A stored scene reads the file {file!r}, which is not stored with it.")
    check_size(main, {flat.name(path): root for path, root in roots.items()})
    return ElementTree.tostring(main, encoding="unicode"), flat.contents


def check_size(main: ElementTree.Element, others: Mapping[str, ElementTree.Element]) -> None:
    """Raise SceneError if a model, with the ``others`` that it attaches, repeats or reserves too much."""
    by_name = {_base(name): root for name, root in others.items()}
    copies = _expanded(main, by_name, ()) - sum(1 for _ in main.iter())
    if copies > _MOST_COPIES:
        raise SceneError(
            f"The model repeats elements (replicate, composite, flexcomp, attach) {copies:.3g} times; at most"
            f" {_MOST_COPIES} can be stored and read again. Lower its counts."
        )
    for root in (main, *others.values()):
        for element in root.iter():
            for name, most in _MOST.items():
                if (text := element.get(name)) and (number := max(_numbers(text), default=0)) > most:
                    raise SceneError(f"{name}={number:g} of <{element.tag}> is too much: {most:g} at most.")
        for element in root.iter("lengthrange"):
            total, step = (
                max(_numbers(element.get(*each)), default=0) for each in (("inttotal", "10"), ("timestep", "0.01"))
            )
            if not total <= _MOST_STEPS * step:
                raise SceneError(f"inttotal={total:g} of <lengthrange> is too much for its timestep={step:g}.")
    cells = sum(map(_cells, (main, *others.values())))
    if cells > _MOST_CELLS:
        raise SceneError(
            f"Textures and height fields have {cells:.3g} cells; {_MOST_CELLS:.3g} at most. Lower their size."
        )


def require_stored(wanted: Iterator[Path], files: Mapping[str, object]) -> None:
    """Raise SceneError if a model would read a file that is not stored with it."""
    for file in wanted:
        if str(file) not in files:
            raise SceneError(f"A stored scene reads the file {str(file)!r}, which is not stored with it.")


def _expanded(root: ElementTree.Element, others: Mapping[str, ElementTree.Element], path: tuple[str, ...]) -> float:
    """Count the elements that MuJoCo makes of a model, including attached models."""
    files = {element.get("name"): _base(element.get("file", "")) for element in root.iter("model")}
    costs: dict[str, float] = {}
    for file in files.values():
        if file in path or len(path) > 20:
            raise SceneError(f"The model {file!r} attaches itself.")
        if file in others and file not in costs:
            costs[file] = _expanded(others[file], others, (*path, file))
    most, total, pending = max(costs.values(), default=0), 0.0, [(root, 1.0)]
    while pending:
        element, times = pending.pop()
        count = math.prod(max(1.0, number) for number in _numbers(element.get("count", "")))
        total += times
        if element.tag in ("composite", "flexcomp"):
            total += 4 * times * count  # a body, joints and a geom each
        elif element.tag == "attach":
            total += times * costs.get(files.get(element.get("model"), ""), most)
        if total > 1e9:
            return total
        inner = times * count if element.tag == "replicate" else times
        pending += [(child, inner) for child in element]
    return total


def _cells(root: ElementTree.Element) -> float:
    total, default = 0.0, {"texture": [0.0], "hfield": [0.0]}
    for parent in root.iter():
        for element in parent:
            if element.tag in default:
                names = ("width", "height") if element.tag == "texture" else ("nrow", "ncol")
                cells = math.prod(max(_numbers(element.get(name, "0")), default=0) for name in names)
                known = default[element.tag]
                known[0] = max(known[0], cells if parent.tag == "default" else 0)
                total += cells or known[0]
    return total


def _numbers(text: str) -> list[float]:
    return [abs(float(word)) for word in text.split() if _NUMBER.fullmatch(word)]


def _base(name: str) -> str:
    """Return the key by which MuJoCo finds a stored file: its base name in lower case."""
    return PurePath(with_slashes(name)).name.lower()


def decoded(content: bytes) -> str:
    """Decode XML as UTF-8; replace bytes of other encodings, which only comments may have."""
    return content.decode("utf-8-sig", errors="replace")


def model_files(spec: mujoco.MjSpec) -> Iterator[Path]:
    """Yield the files that a model reads when compiled, by the paths that MuJoCo looks up."""
    for element in [*spec.meshes, *spec.hfields, *spec.skins]:
        if element.file:
            yield Path(spec.meshdir, element.file)
    for texture in spec.textures:
        for file in (texture.file, *texture.cubefiles):
            if file:
                yield Path(spec.texturedir, file)
