"""URDF files: paths of meshes that they name by package, and motors, which they lack."""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import unquote, urlparse
from xml.etree import ElementTree

import mujoco

from torchrl_gn.scenes.files import is_package_path, package_path
from torchrl_gn.scenes.flat_files import with_slashes
from torchrl_gn.scenes.scene import SceneError
from torchrl_gn.scenes.topology import free_name
from torchrl_gn.scenes.xml_comments import without_comments

_ROOT = re.compile(r"<([A-Za-z_][\w.-]*)")
_XACRO = re.compile(r"<(xacro:[\w.-]+)")
_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def is_urdf(text: str) -> bool:
    """Return True if a model's text is URDF, by its root element."""
    root = _ROOT.search(without_comments(text))
    return root is not None and root.group(1) == "robot"


def refuse_xacro(text: str) -> None:
    """Raise SceneError if URDF text has xacro elements, which MuJoCo skips with all the links that they stand for."""
    if element := _XACRO.search(without_comments(text)):
        raise SceneError(
            f"The URDF has the element <{element.group(1)}>, which MuJoCo would skip: write out the robot first, with"
            " `xacro FILE > robot.urdf`."
        )


def with_local_meshes(text: str, folder: Path) -> tuple[str, dict[str, bytes]]:
    """Replace meshes' ``package://``, ``model://`` and ``file://`` names in URDF text by relative paths.

    MuJoCo takes meshes of equal base names for one mesh. Of those in different folders, all but the first get new
    names: the second result holds their contents, by the path under which MuJoCo asks for them.

    ``package://NAME/PATH`` is looked up as NAME/PATH, or else PATH, in the nearest folder above the file that has it,
    then in the installed Python package NAME. Names that are not found stay: MuJoCo reads no visual meshes of a URDF,
    and names the others that it misses. The compiler is set to keep the folders of the paths.

    Raises:
        SceneError: if the text is no XML.
    """
    if "<mesh" not in text:
        return text, {}
    try:
        root = ElementTree.fromstring(without_comments(text).lstrip())
    except ElementTree.ParseError as error:
        raise SceneError(f"The URDF is no XML: {error}") from error
    compiler = root.find("mujoco/compiler")
    if compiler is None:
        extension = root.find("mujoco")
        extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
        compiler = ElementTree.SubElement(extension, "compiler")
    compiler.attrib.setdefault("strippath", "false")  # older versions of MuJoCo strip the folders of meshes
    if "meshdir" in compiler.attrib:
        compiler.set("meshdir", with_slashes(compiler.attrib["meshdir"]))
    base = os.path.join(os.path.abspath(folder), compiler.get("meshdir", ""))
    for mesh in root.iter("mesh"):
        mesh.set("filename", with_slashes(mesh.get("filename", "")))
        if (path := _mesh_path(mesh.get("filename", ""), folder)) is not None:
            mesh.set("filename", Path(os.path.relpath(path, base)).as_posix())
    renamed = {} if compiler.get("strippath") == "true" else _distinguish(root, compiler, base)
    return ElementTree.tostring(root, encoding="unicode"), renamed


def _distinguish(root: ElementTree.Element, compiler: ElementTree.Element, base: str) -> dict[str, bytes]:
    """Give meshes that MuJoCo reads names that differ where the files do; return the contents of those renamed."""
    files, renamed = dict[str, str](), dict[str, bytes]()  # path by name
    pictures = {mesh for visual in root.iter("visual") for mesh in visual.iter("mesh")}
    if compiler.get("discardvisual") == "false":
        pictures = set()
    for mesh in root.iter("mesh"):
        path = os.path.normpath(os.path.join(base, mesh.get("filename", "")))
        if mesh in pictures or not os.path.isfile(path):
            continue
        name = free_name(Path(path).stem, lambda name, path=path: files.get(name, path) != path)
        files[name] = path
        if name != Path(path).stem:
            mesh.set("filename", name + Path(path).suffix)
            renamed[str(Path(compiler.get("meshdir", ""), name + Path(path).suffix))] = Path(path).read_bytes()
    return renamed


def _mesh_path(name: str, folder: Path) -> Path | None:
    """Return the file that a mesh's URI names; None if it is no URI or is not found."""
    scheme, separator, relative = name.partition("://")
    if not separator:
        return None
    if scheme == "file":
        return Path(unquote(urlparse(name).path))
    inside = relative.partition("/")[2]
    above = Path(os.path.abspath(folder))
    for root in (above, *above.parents):
        for path in (root / relative, root / inside):
            if inside and path.is_file():
                return path
    try:
        return package_path(name) if is_package_path(name) else None
    except (FileNotFoundError, ValueError):
        return None


def add_motors(spec: mujoco.MjSpec) -> None:
    """Add a motor for every hinge and slide, and three for every ball joint, of a model without actuators.

    A motor has its joint's name, at a ball joint followed by the axis, as in ``hip_x``. Its control is the torque
    [N m] or force [N] within the joint's effort (``actfrcrange``); without an effort, and at ball joints, it has no
    bounds. Joints that follow others (``mimic``) and free joints get no motor.

    Raises:
        SceneError: if the model has actuators, or no joint for a motor.
    """
    if spec.actuators:
        raise SceneError("motors=True is for models without actuators; this one has some.")
    following = {
        equality.name1 for equality in spec.equalities if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.name2
    }
    for index, joint in enumerate(spec.joints):
        joint.name = joint.name or free_name(f"joint{index}", lambda name: spec.joint(name) is not None)
        if joint.name in following:
            continue
        if int(joint.type) in _SINGLE:
            low, high = (float(effort) for effort in joint.actfrcrange)
            limits = {"ctrllimited": True, "ctrlrange": [low, high]} if low < high else {}
            _add_motor(spec, joint.name, joint.name, (1, 0, 0), **limits)
        elif joint.type == mujoco.mjtJoint.mjJNT_BALL:
            for axis, direction in _AXES.items():
                _add_motor(spec, f"{joint.name}_{axis}", joint.name, direction)
    if not spec.actuators:
        raise SceneError("motors=True finds no joint for a motor: all are free, or follow others.")


def _add_motor(spec: mujoco.MjSpec, name: str, joint: str, direction: tuple[int, int, int], **limits) -> None:
    transmission = mujoco.mjtTrn.mjTRN_JOINT
    spec.add_actuator(name=name, target=joint, trntype=transmission, gear=[*direction, 0, 0, 0], **limits)
