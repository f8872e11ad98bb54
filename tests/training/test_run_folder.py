"""A run's folder: files are plain, complete and inside the folder."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from torchrl_gn.atomic import read_json
from torchrl_gn.training import RunFolder, package_versions


@pytest.fixture(autouse=True)
def left_to_others() -> Iterator[None]:
    yield
    RunFolder.release()


def test_metrics_are_flat_plain_numbers(tmp_path):
    folder = RunFolder(tmp_path / "run", "train")
    written = folder.write_metrics({"error": 0.1, "steps": 3, "diverged": math.inf, "nan": math.nan}, seed=7)
    read = read_json(tmp_path / "run" / "metrics.json")
    assert read == written
    assert (read["error"], read["steps"], read["diverged"], read["nan"]) == (0.1, 3, None, None)
    assert read["seed"] == 7 and read["wall_clock_seconds"] >= 0
    assert {name: read[f"version/{name}"] for name in package_versions()} == package_versions()


def test_only_files_that_exist_are_listed_once_and_in_order(tmp_path):
    folder = RunFolder(tmp_path / "run", "train")
    folder.write_config("a: 1\n")
    folder.write_config("a: 2\n")
    folder.file("never.png")
    folder.write_metrics({}, seed=0)
    assert folder.written == [tmp_path / "run" / "config.yaml", tmp_path / "run" / "metrics.json"]
    assert folder.written[0].read_text() == "# A run of train\na: 2\n"
    assert folder.checkpoint.is_relative_to(folder.path) and folder.data.is_relative_to(folder.path)


def test_a_run_is_continued_in_its_folder(tmp_path):
    RunFolder(tmp_path, "train").write_config("a: 1\n")
    again = RunFolder(tmp_path, "train")
    assert (again.path / "config.yaml").read_text() == "# A run of train\na: 1\n"


def test_leftovers_of_a_killed_run_are_gone_once_it_is_continued(tmp_path):
    left = [tmp_path / ".rollout.0a1b2c3d.gif", tmp_path / "checkpoint" / ".checkpoint.0a1b2c3d.safetensors"]
    left[1].parent.mkdir()
    for file in (*left, first := tmp_path / ".config.0a1b2c3d.yaml"):
        file.write_text("half")
    RunFolder(tmp_path, "train").write_config("a: 1\n")
    assert not first.exists()
    assert all(file.exists() for file in left)  # of whoever had a folder that was no run
    RunFolder(tmp_path, "train")
    assert not any(file.exists() for file in left)


def test_the_default_folder_is_named_after_recipe_and_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder(None, "train")
    assert folder.path.parts[:2] == ("runs", "train") and folder.path.is_dir()


def test_a_file_is_no_run_folder(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="run_dir=.*file is a file; name a folder"):
        RunFolder(tmp_path / "file", "train")


def test_a_run_goes_on_with_its_own_options_only(tmp_path):
    run = RunFolder(tmp_path, "recipe")
    before = {"system": "pendulum", "minutes": 1, "model": {"latent": 128, "parameters": "scene"}}
    run.refuse_changes(before, {**before, "minutes": 5}, free=["minutes"])
    with pytest.raises(ValueError, match=r"model\.latent=64 \(was 128\), system=jaco \(was pendulum\)"):
        run.refuse_changes(
            before, {**before, "system": "jaco", "model": {"latent": 64, "parameters": "scene"}}, free=[]
        )
    with pytest.raises(ValueError, match=r"model\.skip=True \(was None\)"):
        run.refuse_changes(before, {**before, "model": {**before["model"], "skip": True}}, free=[])


def test_single_options_of_a_group_may_be_free(tmp_path):
    run = RunFolder(tmp_path, "recipe")
    before = {"trainer": {"frames": 100, "seed": 1}, "frames": 5}
    more = {"trainer": {"frames": 200, "seed": 1}, "frames": 5}
    run.refuse_changes(before, more, free=["trainer.frames"])
    run.refuse_changes(before, more, free=["trainer"])
    for free in (["frames"], ["trainer.seed"], ["trainer.frame"]):
        with pytest.raises(ValueError, match=r"options: trainer\.frames=200 \(was 100\)\. To resume it, repeat"):
            run.refuse_changes(before, more, free=free)
    changed = r"options: frames=6 \(was 5\), trainer\.seed=2 \(was 1\)\. To resume it, repeat"
    with pytest.raises(ValueError, match=changed):
        run.refuse_changes(before, {"trainer": {"frames": 3, "seed": 2}, "frames": 6}, free=["trainer.frames"])


def test_a_run_of_another_recipe_is_not_written_over(tmp_path):
    RunFolder(tmp_path, "forward_model").write_config("seed: 0\n")
    RunFolder(tmp_path, "forward_model")
    with pytest.raises(ValueError, match="holds a run of forward_model, not of evaluate. Name a new run_dir"):
        RunFolder(tmp_path, "evaluate")
    (tmp_path / "config.yaml").write_text("seed: 0\n")  # of whoever wrote it
    RunFolder(tmp_path, "evaluate")


def test_metrics_of_before_go_when_a_run_goes_on(tmp_path):
    RunFolder(tmp_path, "train").write_metrics({"error": 0.1}, seed=0)
    run = RunFolder(tmp_path, "train")
    assert (tmp_path / "metrics.json").exists()  # it may still be refused
    run.write_config("steps: 9")
    assert not (tmp_path / "metrics.json").exists() and run.written == [tmp_path / "config.yaml"]


def another(folder: Path, then: str) -> subprocess.Popen:
    """A process that takes the folder."""
    program = f"from torchrl_gn.training import RunFolder; RunFolder({str(folder)!r}, 'train'); {then}"
    return subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_a_second_process_is_refused_until_the_first_ended(tmp_path):
    run = RunFolder(tmp_path, "train")
    assert RunFolder(tmp_path, "train").path == run.path  # this process may
    second = another(tmp_path, "")
    _, errors = second.communicate()
    assert second.returncode == 1 and "is in use by another process; wait for its end, or name a new run_dir" in errors
    assert RunFolder.what_is_kept() == "nothing was kept."
    RunFolder.release()
    first = another(tmp_path, "print('there', flush=True); input()")
    with first:
        assert first.stdout is not None and first.stdout.readline() == "there\n"
        with pytest.raises(ValueError, match="in use by another process"):
            RunFolder(tmp_path, "train")
        first.kill()
        first.wait()
        RunFolder(tmp_path, "train")
