"""Malicious checkpoints: they are refused by name, in seconds and little memory, and read no other file."""

from __future__ import annotations

import base64
import copy
import json
import resource
import time
import zlib
from collections.abc import Callable

import pytest
import torch
from safetensors.torch import save_file

from torchrl_gn.dynamics import Ensemble, ForwardModel
from torchrl_gn.dynamics.mujoco_physics import MujocoPhysics
from torchrl_gn.policies import Agent, StateValue
from torchrl_gn.scenes import ObservationGraph, load_scene
from torchrl_gn.training import CheckpointError, load_pretrained, save_checkpoint
from torchrl_gn.training.tensor_files import digest_of, read_tensors

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ROBOT = (
    '<mujoco><asset><mesh name="m" file="part.obj"/></asset><worldbody><body name="b"><joint name="j"/>'
    '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)
SECRET = '<mujoco><worldbody><body name="secret"><joint/><geom size="1"/></body></worldbody></mujoco>'
M2 = "model.node_normalizer.m2"
MOST_SECONDS, MOST_MEMORY = 10, 300_000  # kB


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, tuple[dict, dict]]:
    """Descriptions and tensors of honest checkpoints."""
    folder = tmp_path_factory.mktemp("honest")
    (folder / "part.obj").write_text(MESH)
    (folder / "robot.xml").write_text(ROBOT)
    scene = load_scene(folder / "robot.xml")
    small = {"hidden": 8, "layers": 1}
    models = {
        "model": ForwardModel.for_scene(scene, **small),
        "ensemble": Ensemble.for_scene(scene, count=2, **small),
        "physics": ForwardModel.for_scene(scene, physics=MujocoPhysics(scene), **small),
        "agent": Agent(ObservationGraph.swimmer(3), hidden=(8,)),
        "value": StateValue(scene, hidden=[8]),
    }
    found = {}
    for name, model in models.items():
        save_checkpoint(file := folder / f"{name}.safetensors", model, scene=scene, training={"best": 0.1})
        tensors, _ = read_tensors(file)
        found[name] = json.loads(tensors.pop("description").numpy().tobytes()), tensors
    return found


Change = Callable[[dict, dict], object]


def model(**options: object) -> Change:
    return lambda description, _: description["model"].update(options)


def core(**options: object) -> Change:
    return lambda description, _: description["model"]["core_options"].update(options)


def options(**changed: object) -> Change:
    return lambda description, _: description["model"]["options"].update(changed)


def at_top(**options: object) -> Change:
    return lambda description, _: description.update(options)


def without(name: str) -> Change:
    return lambda description, _: description.pop(name)


def tensor(name: str, value: torch.Tensor) -> Change:
    return lambda _, tensors: tensors.update({name: value})


# Of checkpoints: name, which, what is changed, what the refusal says.
FORGED = [
    ("wide", "model", core(hidden=20_000), "far larger network than its"),
    ("wide list", "model", core(hidden=[20_000, 20_000]), "far larger network than its"),
    ("many layers", "model", core(layers=10**9), "too large for a network"),
    ("many small layers", "model", core(hidden=[64] * 15_000), "far larger network than its"),
    ("wide latent", "model", core(latent=90_000), "far larger network than its"),
    ("huge latent", "model", core(latent=10**12), "too large for a network"),
    ("huge inferred graph", "model", model(parameters="inferred", inferred=[99_999] * 3), "far larger network than"),
    ("no width", "model", core(hidden=0), "core.hidden|hidden=|at least 1|forged|hidden layer|shape"),
    ("text for a width", "model", core(hidden="wide"), "cannot be used|forged"),
    ("unknown core", "model", model(core="os.system"), "core='os.system' is not known"),
    ("unknown option", "model", core(shell="id"), "or forged .TypeError"),
    ("unknown feature", "model", model(features=[{"feature": "exec"}]), "feature='exec' is not known"),
    ("no features", "model", lambda description, _: description["model"].pop("features"), "or forged .KeyError"),
    ("other kind", "model", at_top(kind="agent"), "forged|cannot be used"),
    ("unknown kind", "model", at_top(kind="pickle"), "or forged .KeyError: 'pickle'"),
    ("no kind", "model", without("kind"), "or forged .KeyError"),
    ("no training", "model", without("training"), "or forged .KeyError"),
    ("scenes of another type", "model", at_top(scenes=["swimmer6"]), "or forged .TypeError"),
    ("metrics of another type", "model", at_top(metrics=[1]), "or forged .TypeError"),
    ("a tensor that is not there", "model", at_top(training={"tensor": "training.x"}), "or forged .KeyError"),
    ("no weights", "model", lambda _, tensors: tensors.clear(), "weights are of dtype None"),
    ("weights of whole numbers", "model", tensor("model.core.a.weight", torch.ones(2, dtype=torch.int64)), "forged"),
    ("weights more", "model", tensor("model.core.more.weight", torch.zeros(2)), "or forged"),
    (
        "statistics below zero",
        "model",
        lambda _, tensors: tensors.update({M2: torch.full_like(tensors[M2], -1)}),
        "statistics 'node_normalizer' have no standard deviation",
    ),
    ("other agent", "agent", options(hidden=[9]), r"c\.safetensors is of a version .* with other networks, or forged"),
    ("option of another agent", "agent", options(no_such_option=1), "with other networks, or forged .*train again"),
    ("wide agent", "agent", options(hidden=[30_000] * 3), "far larger"),
    (
        "observations without end",
        "agent",
        lambda description, _: description["model"]["graph"]["observation"].update(joints=10**12),
        "too large for a network",
    ),
    ("wide value", "value", model(hidden=[20_000, 20_000]), "far larger network than"),
    ("members without end", "ensemble", model(count=99_000), "far larger network than"),
    ("one member", "ensemble", model(count=1), "two members or more, not 1"),
    ("steps without end", "ensemble", model(steps=99_000_000), "too large for a network"),
    ("steps more", "ensemble", model(steps=900), "forged"),
    ("ensemble without end", "value", model(members=99_000), "larger network|forged"),
    ("function that is not given", "physics", model(physics={"function": "os:system"}), "a function that a checkpoint"),
    ("physics of nothing", "physics", model(physics={}), "forged"),
]  # fmt: skip


def forge(original: tuple[dict, dict], change: Change, path, text: bytes | None = None, **metadata: str) -> None:
    """Write a checkpoint with a right checksum."""
    description, tensors = copy.deepcopy(original[0]), dict(original[1])
    change(description, tensors)
    text = json.dumps(description).encode() if text is None else text
    tensors["description"] = torch.frombuffer(bytearray(text), dtype=torch.uint8)
    save_file(tensors, path, {"format": "5", "sha256": digest_of(tensors), **metadata})


@pytest.fixture
def within_limits():
    """Time and memory that a refusal may take."""
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    yield
    assert time.process_time() - start < MOST_SECONDS
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_MEMORY


@pytest.mark.parametrize(
    ("which", "change", "message"), [each[1:] for each in FORGED], ids=[each[0] for each in FORGED]
)
def test_forged_descriptions_and_tensors_are_refused(tmp_path, originals, within_limits, which, change, message):
    forge(originals[which], change, path := tmp_path / "c.safetensors")
    with pytest.raises(CheckpointError, match=message) as caught:
        load_pretrained(path)
    assert str(path) in str(caught.value)


DEEP = b'{"kind": "forward_model", "training": ' + b'{"list": [' * 400_000


@pytest.mark.parametrize(
    "text", [b" ", b"[" * 100_000, DEEP, b"\xff\xfe", b"[]", b"null", b'{"kind": 1' + b"9" * 5000 + b"}"]
)
def test_texts_that_describe_nothing_are_refused(tmp_path, originals, within_limits, text):
    forge(originals["model"], lambda *_: None, path := tmp_path / "c.safetensors", text)
    with pytest.raises(CheckpointError, match=r"c\.safetensors"):
        load_pretrained(path)


@pytest.mark.parametrize("number", ["", "5.0", "five", "-5", "9" * 5000, "5" + "٥"])
def test_formats_that_are_no_numbers_are_refused(tmp_path, originals, number):
    forge(originals["model"], lambda *_: None, path := tmp_path / "c.safetensors", format=number)
    with pytest.raises(CheckpointError, match=r"c\.safetensors is a safetensors file, but no checkpoint"):
        load_pretrained(path)


@pytest.mark.parametrize(
    ("number", "message"),
    [
        ("6", "has format 6, this version reads formats 4 and 5; update torchrl_gn"),
        ("3", "has format 3, .* train again"),
    ],
)
def test_a_newer_or_older_format_says_what_to_do(tmp_path, originals, number, message):
    forge(originals["model"], lambda *_: None, path := tmp_path / "c.safetensors", format=number)
    with pytest.raises(CheckpointError, match=message):
        load_pretrained(path)


def test_what_is_not_forged_loads(tmp_path, originals):
    for name, original in originals.items():
        forge(original, lambda *_: None, path := tmp_path / f"{name}.safetensors")
        assert load_pretrained(path).scene_descriptions[0]["assets"].keys() == {"part.obj"}


BALL = '<body><joint/><geom size=".1"/></body>'


def world(inside: str, before: str = "") -> Change:
    text = f"<mujoco>{before}<worldbody>{inside}{BALL}</worldbody></mujoco>"
    return lambda scene, _: scene.update(mjcf=text, assets={})


def packed(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 9)).decode()


def lineage(scene: dict, _) -> None:
    """Ten models, each of which attaches the next ten times."""
    for number in range(10):
        each = f'<attach model="m{number + 1}" body="b" prefix="{{}}"/>'
        inside = "".join(each.format(f"p{copy}_") for copy in range(10))
        text = (
            f'<mujoco model="m{number}"><asset><model name="m{number + 1}" file="m{number + 1}.xml"/></asset>'
            f'<worldbody><body name="b"><joint/><geom size="1"/><frame>{inside}</frame></body></worldbody></mujoco>'
        )
        scene["assets"][f"m{number}.xml"] = packed(text.encode())
    scene["assets"]["m10.xml"] = packed(
        b'<mujoco><worldbody><body name="b"><geom size="1"/></body></worldbody></mujoco>'
    )
    scene["mjcf"] = zlib.decompress(base64.b64decode(scene["assets"]["m0.xml"])).decode()


BOMB = packed(b"v 0 0 0\n" * 10_000_000)
SCENES = [
    ("include", world('<include file="SECRET.xml"/>'), "includes other files"),
    (
        "mesh of the machine",
        world('<geom type="mesh" mesh="m"/>', '<asset><mesh name="m" file="SECRET.obj"/></asset>'),
        "SECRET.obj', which is not stored with it",
    ),
    (
        "picture of the machine",
        world("", '<asset><texture name="t" type="2d" file="SECRET.png"/></asset>'),
        "SECRET.png', which is not stored with it",
    ),
    (
        "side of a cube of the machine",
        world("", '<asset><texture name="t" type="cube" fileright="SECRET.png"/></asset>'),
        "SECRET.png', which is not stored with it",
    ),
    (
        "heights of the machine",
        world("", '<asset><hfield name="h" file="SECRET.png" size="1 1 1 1"/></asset>'),
        "SECRET.png', which is not stored with it",
    ),
    (
        "attached model of the machine",
        world('<attach model="a" body="secret" prefix="p"/>', '<asset><model name="a" file="SECRET.xml"/></asset>'),
        "SECRET.xml', which is not stored with it",
    ),
    (
        "flex of the machine",
        world('<body><flexcomp name="f" type="mesh" file="SECRET.obj" rigid="true"/></body>'),
        "SECRET.obj', which is not stored with it",
    ),
    ("replicate", world(f'<replicate count="1000000">{BALL}</replicate>'), "repeats elements .* 3e.06 times"),
    (
        "nested replicate",
        world('<replicate count="9">' * 9 + BALL + "</replicate>" * 9),
        "repeats elements",
    ),
    ("composite", world('<composite type="cable" count="900000 1 1" size="1"><geom/></composite>'), "repeats elements"),
    ("flexcomp", world('<flexcomp name="f" type="grid" count="500 500 500"/>'), "repeats elements"),
    ("attached by attached", lineage, "repeats elements"),
    ("entities", lambda scene, _: scene.update(mjcf='<!DOCTYPE a [<!ENTITY b "c">]>' + ROBOT), "document type"),
    ("height field", world("", '<asset><hfield name="h" nrow="90000" ncol="90000" size="1 1 1 1"/></asset>'), "cells"),
    (
        "pictures by default",
        world("", '<default><texture width="5000" height="5000"/></default><asset>'
              + '<texture type="2d" builtin="flat"/>' * 9 + "</asset>"),
        "cells",
    ),
    ("numbers for the user", world("", '<size nuser_body="1000000000"/>'), "nuser_body=1e.09 .* too much"),
    ("data for the user", world("", '<size nuserdata="1000000000"/>'), "nuserdata=1e.09 .* too much"),
    ("steps of the solver", world("", '<option iterations="2000000000" tolerance="0"/>'), "iterations=2e.09"),
    ("no step", world("", '<option timestep="1e-12"/>'), "physics step .* 1e-12 s"),
    ("deep bodies", world("<body>" * 2000 + "</body>" * 2000), "RecursionError|cannot read a stored"),
    ("no XML", lambda scene, _: scene.update(mjcf="\0" * 10), "is no XML"),
    ("no text", lambda scene, _: scene.update(mjcf=None), "damaged, or of another version"),
    ("bomb", lambda scene, _: scene["assets"].update({"part.obj": BOMB}), "unpack to too"),
    ("cut file", lambda scene, _: scene["assets"].update({"part.obj": packed(b"a" * 999)[:-8]}), "part.obj. .*damaged"),
    ("no base64", lambda scene, _: scene["assets"].update({"part.obj": "é"}), "'part.obj' .* damaged"),
    ("files that are no texts", lambda scene, _: scene["assets"].update({"part.obj": 5}), "damaged, or of another"),
    ("settling without end", lambda scene, _: scene.update(settle_steps=10**12), "settle_steps=1000000000000"),
    ("control step without end", lambda scene, _: scene.update(timestep=1e300), "may take at most"),
    ("no fingerprint", lambda scene, _: scene.pop("fingerprint"), "damaged, or of another version"),
    ("swimmer of a million links", lambda scene, _: scene.update(system="swimmer1000000"), "at most 500"),
    ("unknown system", lambda scene, _: scene.update(system="../secret"), "Unknown scene"),
    (
        "joints without end",
        lambda scene, _: scene.update(kinematic_tree={"name": "r", "joint_names": ["j"], "timestep": 0.1, "extras": [],
                                                      "commands": [[10**12]], "action_low": [], "action_high": []}),
        "must be indices from 0, below",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("change", "message"), [each[1:] for each in SCENES], ids=[each[0] for each in SCENES])
@pytest.mark.parametrize("where", ["scenes", "value"])
def test_forged_scenes_are_refused(tmp_path, originals, within_limits, monkeypatch, where, change, message):
    """The forgery is in the list of scenes, or in the description of an object that reads a scene."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "SECRET.xml").write_text(SECRET)
    (tmp_path / "SECRET.obj").write_text(MESH)
    path = tmp_path / "c.safetensors"
    if where == "scenes":
        forge(originals["model"], lambda description, _: change(description["scenes"][0], {}), path)
        refusing, load = ValueError, load_pretrained(path).scene
    else:
        forge(originals["value"], lambda description, _: change(description["model"]["scene"], {}), path)
        refusing, load = CheckpointError, lambda: load_pretrained(path)
    with pytest.raises(refusing, match=message):
        load()
