"""Data sets on disk: repeatable, resumable, refused when damaged."""

from __future__ import annotations

import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock, Timeout
from tensordict import TensorDict

from torchrl_gn.atomic import parse_json, read_json, write_json
from torchrl_gn.data import (
    DatasetError,
    Simulator,
    UnstableSimulationError,
    collect_trajectories,
    create_dataset,
    dataset_files,
    load_dataset,
)
from torchrl_gn.scenes import Scene, load_scene

from .. import zoo
from .conftest import contents, equal, repelled_hinge

SIZES: dict[str, Any] = {"train": 10, "validation": 5, "test": 4, "steps": 6, "seed": 3}


pytestmark = pytest.mark.usefixtures("small_chunks")


def test_collected_data_repeat_and_replay(pendulum: Scene) -> None:
    data = collect_trajectories(pendulum, 10, 6, seed=3)
    assert data["state"].shape == (10, 7, 2, 13) and data["action"].shape == (10, 6, 1)
    assert equal(data, collect_trajectories(pendulum, 10, 6, seed=3, simulator=Simulator(pendulum, 1)))
    again = Simulator(pendulum).rollout(data["physics"][:, 2], data["action"][:, 2:])
    assert torch.equal(again["state"], data["state"][:, 2:])
    starts = torch.cat([collect_trajectories(pendulum, 10, 1, 3, split=split)["physics"][:, 0] for split in range(3)])
    assert len(starts.unique(dim=0)) == 30


def test_collected_data_are_in_no_split_of_a_data_set(tmp_path: Path, pendulum: Scene) -> None:
    dataset = create_dataset(tmp_path / "d", pendulum, **SIZES)
    collected = collect_trajectories(pendulum, SIZES["train"], SIZES["steps"], seed=SIZES["seed"])
    for split in ("train", "validation", "test"):
        starts = torch.cat([getattr(dataset, split)["physics"][:, 0], collected["physics"][:, 0]])
        assert len(starts.unique(dim=0)) == len(starts)


def test_a_simulator_of_another_scene_is_refused(pendulum: Scene) -> None:
    heavy = load_scene("pendulum", parameters={"mass": 2.0})
    for simulated in (heavy, [pendulum, heavy]):
        with pytest.raises(ValueError, match="simulator's 'pendulum' is not the given scene"):
            collect_trajectories(pendulum, 3, 2, simulator=Simulator(simulated, 1))


def test_on_disk_as_in_memory(tmp_path: Path, pendulum: Scene) -> None:
    seen = []
    made = create_dataset(tmp_path / "d", pendulum, **SIZES, progress=lambda *counts: seen.append(counts))
    assert seen == [(4, 19), (8, 19), (10, 19), (14, 19), (15, 19), (19, 19)]
    loaded = load_dataset(tmp_path / "d")
    assert loaded.scene.fingerprint() == pendulum.fingerprint()
    for number, split in enumerate(("train", "validation", "test")):
        assert equal(getattr(made, split), getattr(loaded, split))
        expected = collect_trajectories(pendulum, SIZES[split], 6, seed=3, split=number)
        assert equal(getattr(loaded, split), expected)
        assert equal(TensorDict.load_memmap(tmp_path / "d" / split), expected)
    assert {path.suffix for path in (tmp_path / "d").rglob("*") if path.is_file()} == {".memmap", ".json"}
    assert loaded.rejected == {"train": 0, "validation": 0, "test": 0}
    assert load_dataset(tmp_path / "d", pendulum).scene is pendulum
    before = contents(tmp_path)
    loaded.train["state"].zero_()
    assert equal(create_dataset(tmp_path / "d", pendulum, **SIZES).train, made.train)
    assert contents(tmp_path) == before


@pytest.mark.slow
def test_chunks_made_elsewhere_are_the_same(tmp_path: Path, pendulum: Scene) -> None:
    def elsewhere(function, items):
        """Copies for every piece of work, as in a pool of processes."""
        for item in items:
            there, job = pickle.loads(pickle.dumps((function, item)))
            yield pickle.loads(pickle.dumps(there(job)))

    for name, variants in (("same", None), ("variants", 3)):
        here = create_dataset(tmp_path / name, pendulum, **SIZES, variants=variants)
        made = create_dataset(
            tmp_path / f"{name} elsewhere", pendulum, **SIZES, variants=variants, map_chunks=elsewhere
        )
        for split in ("train", "validation", "test"):
            assert equal(getattr(here, split), getattr(made, split))


@pytest.mark.parametrize("after", [1, 3, 5])
@pytest.mark.parametrize("where", ["progress", "write"])
def test_interrupted_resumes_to_identical_data(after: int, where: str, tmp_path: Path, pendulum: Scene, ctrl_c) -> None:
    create_dataset(tmp_path / "whole", pendulum, **SIZES)
    watched = SimpleNamespace(progress=lambda *_: None)
    if where == "progress":
        ctrl_c(watched, "progress", after)
    else:  # the rows are on disk, the manifest is not
        ctrl_c(dataset_files, "sync_all", after)
    with pytest.raises(KeyboardInterrupt):
        create_dataset(tmp_path / "parts", pendulum, **SIZES, progress=watched.progress)
    with pytest.raises(DatasetError, match=r"unfinished.*create_dataset"):
        load_dataset(tmp_path / "parts")
    seen = []
    create_dataset(tmp_path / "parts", pendulum, **SIZES, progress=lambda done, _: seen.append(done))
    assert len(seen) == 6 - after + (where == "write")
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal")
def test_killed_resumes_to_identical_data(tmp_path: Path, pendulum: Scene) -> None:
    script = f"""if True:
        import os
        from torchrl_gn.data import collect, create_dataset, dataset
        from torchrl_gn.data.dataset_files import DatasetFiles
        from torchrl_gn.scenes import load_scene
        collect.CHUNK = dataset.CHUNK = 4
        write = DatasetFiles._write
        def killed(files):  # while the second chunk's rows are in the file and its checksums are not
            if len(files.manifest["chunks"]["train"]) == 2:
                os.kill(os.getpid(), {int(signal.SIGKILL)})
            write(files)
        DatasetFiles._write = killed
        create_dataset({str(tmp_path / "parts")!r}, load_scene("pendulum"), **{SIZES})
    """
    assert subprocess.run([sys.executable, "-c", script]).returncode == -signal.SIGKILL
    seen = []
    parts = create_dataset(tmp_path / "parts", pendulum, **SIZES, progress=lambda done, _: seen.append(done))
    assert seen == [8, 10, 14, 15, 19]
    whole = create_dataset(tmp_path / "whole", pendulum, **SIZES)
    assert all(equal(getattr(parts, split), getattr(whole, split)) for split in ("train", "validation", "test"))


def test_a_full_disk_leaves_it_to_be_gone_on_with(
    tmp_path: Path, pendulum: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as patch:
        patch.setattr("os.posix_fallocate", full, raising=False)
        with pytest.raises(OSError, match=r"d/train/.*\.memmap cannot be written: .* free some space"):
            create_dataset(tmp_path / "d", pendulum, **SIZES)
    assert len(create_dataset(tmp_path / "d", pendulum, **SIZES).train) == 10


def test_files_that_may_not_be_so_large_are_named(tmp_path: Path, pendulum: Scene, files_end_at) -> None:
    with files_end_at(5000):
        with pytest.raises(OSError, match=r"d/train cannot be written: File too large\. Make room"):
            create_dataset(tmp_path / "d", pendulum, **SIZES)
    assert len(create_dataset(tmp_path / "d", pendulum, **SIZES).train) == 10


def test_others_wait_while_it_is_made(tmp_path: Path, pendulum: Scene) -> None:
    def locked(*_) -> None:
        with pytest.raises(Timeout), FileLock(tmp_path / ".d.lock", timeout=0):
            pass

    create_dataset(tmp_path / "d", pendulum, **SIZES, progress=locked)
    with FileLock(tmp_path / ".d.lock", timeout=0):
        assert len(load_dataset(tmp_path / "d").train) == 10


def test_interrupted_before_its_manifest_it_can_be_made_again(tmp_path: Path, pendulum: Scene, ctrl_c) -> None:
    ctrl_c(os, "fsync", 1)
    with pytest.raises(KeyboardInterrupt):
        create_dataset(tmp_path / "d", pendulum, **SIZES)
    assert [*(tmp_path / "d").iterdir()] == []
    assert len(create_dataset(tmp_path / "d", pendulum, **SIZES).train) == 10


def _truncate(folder: Path) -> Path:
    file = folder / "train" / "state.memmap"
    file.write_bytes(file.read_bytes()[:-8])
    return file


def _extend(folder: Path) -> Path:
    file = folder / "test" / "physics.memmap"
    file.write_bytes(file.read_bytes() + b"\0" * 8)
    return file


def _flip(folder: Path) -> Path:
    file = folder / "validation" / "action.memmap"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    return file


def _remove(folder: Path) -> Path:
    (folder / "test" / "action.memmap").unlink()
    return folder / "test" / "action.memmap"


def _edit_shapes(folder: Path) -> Path:
    file = folder / "train" / "meta.json"
    file.write_text(file.read_text().replace("[10,7,2,13]", "[10,7,13,2]"))
    return file


def _remove_shapes(folder: Path) -> Path:
    (folder / "test" / "meta.json").unlink()
    return folder / "test" / "meta.json"


def _break_manifest(folder: Path) -> Path:
    file = folder / "manifest.json"
    file.write_text(file.read_text()[:-20])
    return file


def _drop_from_manifest(folder: Path) -> Path:
    file = folder / "manifest.json"
    manifest = read_json(file)
    del manifest["chunks"]
    file.write_text(json.dumps(manifest))
    return file


def _empty_request(folder: Path) -> Path:
    file = folder / "manifest.json"
    file.write_text(json.dumps({**read_json(file), "request": {"sizes": {}, "chunk": 0}}))
    return file


def _grow(folder: Path) -> Path:
    """More sequences than the manifest lists, with a file and checksums that fit."""
    file, manifest_file = folder / "test" / "meta.json", folder / "manifest.json"
    for leaf in file.parent.glob("*.memmap"):
        leaf.write_bytes(leaf.read_bytes() * 2)
    file.write_text(file.read_text().replace("[4", "[8"))
    manifest = read_json(manifest_file)
    chunk = manifest["chunks"]["test"][0]
    chunk["crc32"]["meta.json"] = zlib.crc32(file.read_bytes())
    manifest["chunks"]["test"].append(chunk)
    manifest_file.write_text(json.dumps(manifest))
    return folder / "test"


def _newer(folder: Path) -> Path:
    file = folder / "manifest.json"
    file.write_text(json.dumps({**read_json(file), "format": 99}))
    return file


def _older(folder: Path) -> Path:
    file = folder / "manifest.json"
    file.write_text(json.dumps({**read_json(file), "format": 3}))
    return file


@pytest.mark.parametrize(
    "damage",
    [
        _truncate,
        _extend,
        _flip,
        _remove,
        _edit_shapes,
        _remove_shapes,
        _break_manifest,
        _drop_from_manifest,
        _empty_request,
        _grow,
        _newer,
        _older,
    ],
)
def test_damaged_is_refused_named_and_kept(damage, tmp_path: Path, pendulum: Scene) -> None:
    create_dataset(tmp_path / "d", pendulum, **SIZES)
    file = damage(tmp_path / "d")
    before = contents(tmp_path)
    for attempt in (
        lambda: load_dataset(tmp_path / "d"),
        lambda: create_dataset(tmp_path / "d", pendulum, **SIZES),
        *([] if damage is _flip else [lambda: load_dataset(tmp_path / "d", verify=False)]),
    ):
        with pytest.raises(DatasetError) as caught:
            attempt()
        assert str(file) in str(caught.value)
        assert ("Update torchrl_gn" if damage is _newer else "create it again") in str(caught.value)
    assert contents(tmp_path) == before


def test_another_is_not_overwritten(tmp_path: Path, pendulum: Scene) -> None:
    create_dataset(tmp_path / "d", pendulum, **SIZES)
    before = contents(tmp_path)
    with pytest.raises(DatasetError, match="seed is 3, not 4"):
        create_dataset(tmp_path / "d", pendulum, **{**SIZES, "seed": 4})
    with pytest.raises(DatasetError, match="scene is pendulum, not acrobot"):
        create_dataset(tmp_path / "d", load_scene("acrobot"), **SIZES)
    with pytest.raises(DatasetError, match="'pendulum'.*not of 'acrobot'"):
        load_dataset(tmp_path / "d", load_scene("acrobot"))
    assert contents(tmp_path) == before
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "thesis.txt").write_text("important")
    with pytest.raises(DatasetError, match="not empty and has no manifest"):
        create_dataset(tmp_path / "notes", pendulum, **SIZES)
    with pytest.raises(DatasetError, match="no such file"):
        load_dataset(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="validation=0 must be a whole number"):
        create_dataset(tmp_path / "e", pendulum, validation=0)
    with pytest.raises(ValueError, match="seed=-1 must be a whole number from 0"):
        create_dataset(tmp_path / "e", pendulum, seed=-1)
    assert not (tmp_path / "e").exists()


def test_data_of_an_edited_model_are_refused(tmp_path: Path) -> None:
    """A changed shape is refused; a changed colour is accepted."""
    model = zoo.mjcf("plane")
    (tmp_path / "ball.xml").write_text(model)
    create_dataset(tmp_path / "d", load_scene(tmp_path / "ball.xml"), **SIZES)
    assert load_dataset(tmp_path / "d", load_scene(model)).train.shape == (10,)
    (tmp_path / "ball.xml").write_text(zoo.mjcf("plane", ("0.5", "1.5")))
    edited = load_scene(tmp_path / "ball.xml")
    for attempt, message in (
        (lambda: create_dataset(tmp_path / "d", edited, **SIZES), r"another data set is there \(fingerprint is"),
        (lambda: load_dataset(tmp_path / "d", edited), "the data set is of scene 'ball' .*, not of 'ball'"),
    ):
        with pytest.raises(DatasetError, match=message):
            attempt()
    painted = zoo.load("plane", ('size=".1"', 'size=".1" rgba="1 0 0 1"'), name="ball")
    assert len(create_dataset(tmp_path / "d", painted, **SIZES).train) == 10


def test_data_around_another_keyframe_are_refused(tmp_path: Path) -> None:
    text = zoo.mjcf("point").replace("</mujoco>", '<keyframe><key qpos="{}"/></keyframe></mujoco>')
    count = load_scene(zoo.mjcf("point")).model.nq
    here, there = (load_scene(text.format(" ".join([at] * count)), name="point") for at in ("0.1", "0.2"))
    assert here.fingerprint() == there.fingerprint()
    sizes = {"train": 2, "validation": 1, "test": 1, "steps": 2}
    create_dataset(tmp_path / "data", here, **sizes)
    with pytest.raises(DatasetError, match="another data set is there .keyframe is "):
        create_dataset(tmp_path / "data", there, **sizes)
    # Data sets of versions that did not store it are still read.
    manifest = tmp_path / "data" / "manifest.json"
    stored = parse_json(manifest.read_text())
    del stored["request"]["keyframe"]
    write_json(manifest, stored, checked=True)
    create_dataset(tmp_path / "data", there, **sizes)


def test_resuming_with_other_versions_is_refused(tmp_path: Path, pendulum: Scene) -> None:
    def interrupt(*_) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        create_dataset(tmp_path / "d", pendulum, **SIZES, progress=interrupt)
    manifest = tmp_path / "d" / "manifest.json"
    stored = parse_json(manifest.read_text())
    stored["versions"]["mujoco"] = "2"
    write_json(manifest, stored, checked=True)
    with pytest.raises(DatasetError, match="was started with {'mujoco': '2', .* would go on differently with"):
        create_dataset(tmp_path / "d", pendulum, **SIZES)


def test_unstable_sequences_are_drawn_again_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()  # chunks of the usual size
    scene = repelled_hinge(3.0)  # 4.5 % of the starts are beyond
    made = create_dataset(tmp_path / "d", scene, train=300, validation=20, test=20, steps=2)
    assert 3 <= made.rejected["train"] < 40
    assert (made.train["physics"][..., 1].abs() < 3.001).all()
    assert len(np.unique(made.train["physics"][:, 0], axis=0)) == 300
    with pytest.raises(UnstableSimulationError, match="'repelled' became unstable"):
        collect_trajectories(repelled_hinge(1.5), 100, 2)
