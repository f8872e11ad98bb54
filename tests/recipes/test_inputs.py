"""A run that resumes has the data that it began with."""

from __future__ import annotations

import pytest

from _common.inputs import INPUTS_FILE, keep_inputs
from torchrl_gn.training import RunFolder


@pytest.fixture
def run(tmp_path):
    yield RunFolder(tmp_path / "run", "test")
    RunFolder.release()


def test_a_resumed_run_refuses_a_file_that_changed(run, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("angle0\n1\n")
    keep_inputs(run, resumed=False, log=str(log))
    keep_inputs(run, resumed=True, log=str(log))
    log.write_text("angle0\n1\n2\n")
    with pytest.raises(ValueError, match=r"holds a run on other data: log= has changed since"):
        keep_inputs(run, resumed=True, log=str(log))
    keep_inputs(run, resumed=False, log=str(log))  # nothing was trained yet
    keep_inputs(run, resumed=True, log=str(log))


def test_folders_and_lists_of_sources(run, tmp_path):
    folder, file = tmp_path / "data", tmp_path / "more.safetensors"
    folder.mkdir()
    (folder / "all.parquet").write_bytes(b"1")
    file.write_bytes(b"2")
    keep_inputs(run, resumed=False, data__extra=[str(folder), str(file)])
    (folder / "video.mp4").write_bytes(b"seen by nobody")
    keep_inputs(run, resumed=True, data__extra=[str(folder), str(file)])
    (folder / "all.parquet").rename(folder / "part.parquet")
    with pytest.raises(ValueError, match=r"data\.extra= has changed"):
        keep_inputs(run, resumed=True, data__extra=[str(folder), str(file)])


def test_runs_without_files_or_of_before(run, tmp_path):
    keep_inputs(run, resumed=False, log=None)
    assert not (run.path / INPUTS_FILE).exists()
    log = tmp_path / "log.csv"
    log.write_text("1")
    keep_inputs(run, resumed=True, log=str(log))  # a run of an older version, whose data are not known
    (run.path / INPUTS_FILE).write_text("{")
    with pytest.raises(ValueError, match="inputs.json is damaged"):
        keep_inputs(run, resumed=True, log=str(log))
