"""Loading refuses scenes that cannot be rebuilt from a description; all others are rebuilt."""

from __future__ import annotations

import pytest

from torchrl_gn.scenes import SceneError, load_scene, scene_from_description, stored_mjcf
from torchrl_gn.scenes.stored_mjcf import packed, unpacked

BALL = '<body><joint/><geom size=".1"/></body>'


def model(inside: str, before: str = "") -> str:
    return f"<mujoco>{before}<worldbody>{inside}{BALL}</worldbody></mujoco>"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (model(f'<replicate count="100"><replicate count="100">{BALL}</replicate></replicate>'), r"3\.01e\+04 times"),
        (model("", '<option iterations="1000000"/>'), r"iterations=1e\+06 of <option> is too much"),
        (
            model("", '<compiler><lengthrange inttotal="10" timestep="0.00001"/></compiler>'),
            "inttotal=10 of <lengthrange> is too much for its timestep=1e-05",
        ),
    ],
)
def test_too_much_is_refused_before_anything_is_trained(text, message):
    with pytest.raises(SceneError, match=message):
        load_scene(text)


@pytest.mark.parametrize("step", ["0", "nan", "inf", "-0.002", "1e-12"])
def test_physics_steps_that_nothing_can_be_simulated_with(step):
    with pytest.raises(
        SceneError, match=rf"physics step of scene 'name' is {float(step):g} s, .* set <option timestep="
    ):
        load_scene(model("", f'<option timestep="{step}"/>'), name="name")


def test_a_control_step_of_too_many_physics_steps():
    text = model("", '<option timestep="0.00001"/>')
    assert load_scene(text).substeps == 2000
    with pytest.raises(SceneError, match="a control step of 1 s may take at most 10000"):
        load_scene(text, timestep=1)


def test_copies_and_comments_that_only_mujoco_reads_come_back():
    text = model(f'<!-- a -- b --><replicate count="20" offset="1 0 0">{BALL}</replicate>')
    scene = load_scene(text)
    assert scene.num_nodes == 22
    assert scene_from_description(scene.description()).fingerprint() == scene.fingerprint()


@pytest.mark.slow
def test_files_are_unpacked_as_they_were_and_no_further_than_their_size():
    files = {"a": b"text", "b": bytes(range(256)) * 99, "c": b""}
    assert unpacked(packed(files)) == files
    with pytest.raises(SceneError, match="'b', unpack to too many bytes"):
        unpacked({name: packed({name: b"0" * 50_000_000})[name] for name in "ab"})


def test_files_that_could_not_be_unpacked_again_are_refused_when_they_are_loaded(tmp_path, monkeypatch):
    mesh = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "part.obj").write_text(mesh + 500 * "#\n")
    (tmp_path / "robot.xml").write_text(
        '<mujoco><asset><mesh name="m" file="part.obj"/></asset><worldbody><body><joint/><geom type="mesh" mesh="m"/>'
        "</body></worldbody></mujoco>"
    )
    scene = load_scene(tmp_path / "robot.xml")
    unpacks = stored_mjcf.unpacked(scene.description()["assets"])
    assert unpacks == {"part.obj": (tmp_path / "part.obj").read_bytes()}
    monkeypatch.setattr(stored_mjcf, "_FREE_BYTES", 0)
    monkeypatch.setattr(stored_mjcf, "_RATIO", 1)
    stored = scene.description()["assets"]
    for refuse in lambda: stored_mjcf.unpacked(stored), lambda: load_scene(tmp_path / "robot.xml"):
        with pytest.raises(SceneError, match=r"part\.obj.* unpack to too many bytes"):
            refuse()
