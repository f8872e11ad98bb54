"""Files are written completely or not at all."""

from __future__ import annotations

import json

import pytest

from torchrl_gn.atomic import atomic_path, write_json


def test_the_file_appears_once_the_block_succeeds(tmp_path):
    path = tmp_path / "new" / "folder" / "file.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("text")
        assert temporary.suffix == ".txt"
        assert temporary.parent == path.parent
        assert not path.exists()
    assert path.read_text() == "text"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_failing_write_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(error), atomic_path(path) as temporary:
        temporary.write_text("half a fi")
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_two_writers_do_not_meet(tmp_path):
    path = tmp_path / "file"
    with atomic_path(path) as first, atomic_path(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the outer block ends last
    assert list(tmp_path.iterdir()) == [path]


def test_json_round_trips_and_refuses_what_json_cannot_hold(tmp_path):
    path = tmp_path / "metrics.json"
    values = {"loss": 0.1, "steps": 3, "names": ["a", None, True]}
    write_json(path, values)
    assert json.loads(path.read_text()) == values
    for bad in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="metrics.json: .* finite numbers only"):
            write_json(path, {"loss": bad})
    assert json.loads(path.read_text()) == values


def test_the_file_is_as_readable_as_any(tmp_path):
    (tmp_path / "usual").write_text("text")
    with atomic_path(tmp_path / "file") as temporary:
        temporary.touch(mode=0o600)
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "usual").stat().st_mode
