"""Numbers of a run in one file, which continues after any crash."""

from __future__ import annotations

import csv
import warnings

import pytest

from torchrl_gn.training.csv_log import CsvLog


def rows(path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def path(tmp_path):
    log = CsvLog(tmp_path / "numbers.csv")
    for step in range(5):
        log.log({"loss": step / 2, "a,b": step}, step)
    return log.path


def test_a_whole_file_goes_on(path):
    before = path.read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = CsvLog(path)
    assert path.read_bytes() == before
    log.log({"loss": 9, "a,b": 3}, 3)
    assert [(row["step"], row["loss"]) for row in rows(path)] == [
        ("0", "0.0"),
        ("1", "0.5"),
        ("2", "1.0"),
        ("3", "9.0"),
    ]


def test_a_name_that_is_logged_again_leaves_others_as_they_are(tmp_path):
    """Other names may be of a model that was trained before, or of a run that is only evaluated again."""
    path = tmp_path / "numbers.csv"
    log = CsvLog(path)
    for name in "ab":
        for step in (1, 2, 3):
            log.log({f"{name}/loss": step}, step)
    log.log({"error": 5}, 3)
    whole = rows(path)
    assert [(row["step"], row["a/loss"], row["b/loss"]) for row in whole] == [
        ("1", "1.0", "1.0"),
        ("2", "2.0", "2.0"),
        ("3", "3.0", "3.0"),
    ]
    log = CsvLog(path)
    log.log({"b/loss": 7}, 2)
    assert [row["a/loss"] for row in rows(path)] == ["1.0", "2.0", "3.0"]
    assert [row["b/loss"] for row in rows(path)] == ["1.0", "7.0", ""]
    for step in (2, 3):
        log.log({"b/loss": step}, step)
    log.log({"error": 5}, 3)
    assert rows(path) == whole


@pytest.mark.parametrize(
    ("damage", "kept"),
    [
        (lambda data: data[:-4], 4),  # a cut row
        (lambda data: data.replace(b"1.5", b"1.\0"), 4),
        (lambda data: data + b"\0" * 512, 5),  # what some file systems leave of the last block
        (lambda data: data.replace(b"2,1.0,2.0", b"2,1.0"), 4),
        (lambda data: data.replace(b"2,1.0,2.0", b"2,one,2.0"), 4),
        (lambda data: data.replace(b"2,1.0,2.0", b"\xff,1.0,2.0"), 4),
        (lambda data: b"\0" * len(data), 0),
        (lambda data: data[10:], 0),  # without its header
    ],
)
def test_damaged_rows_are_left_out_and_said(path, damage, kept):
    path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match=r"numbers\.csv: \d+ damaged rows are left out"):
        log = CsvLog(path)
    assert len(rows(path)) == kept
    log.log({"loss": 1}, 7)
    assert rows(path)[-1]["step"] == "7" and len(rows(path)) == kept + 1
    CsvLog(path)


def test_an_empty_file_begins_anew(tmp_path):
    (tmp_path / "numbers.csv").touch()
    CsvLog(tmp_path / "numbers.csv").log({"loss": 1}, 0)
    assert rows(tmp_path / "numbers.csv") == [{"step": "0", "loss": "1.0"}]


def test_a_full_disk_leaves_no_half_row(path, files_end_at):
    before = path.read_bytes()
    log = CsvLog(path)
    log.log({"loss": 1.0, "other": 1.0}, 10)
    whole = path.read_bytes()
    with files_end_at(len(whole) + 4), pytest.raises(OSError, match=r"csv cannot be written: .* free some space"):
        log.log({"loss": 2.0, "other": 1.0}, 11)
    assert path.read_bytes() == whole != before


def test_a_first_row_without_numbers_and_the_name_of_the_rows_number(tmp_path):
    log = CsvLog(tmp_path / "numbers.csv")
    log.log({}, 0)
    with pytest.raises(ValueError, match="the column 'step' is the number of the row; give the number another name"):
        log.log({"step": 7, "loss": 0.5}, 1)
    log.log({"loss": 0.5}, 1)
    assert rows(log.path) == [{"step": "0", "loss": ""}, {"step": "1", "loss": "0.5"}]
