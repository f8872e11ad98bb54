"""Files are written completely or not at all."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_gn.atomic import atomic_path, read_json, remove_leftovers, sync_all, write_json


def test_the_file_appears_once_the_block_succeeds(tmp_path):
    path = tmp_path / "new" / "folder" / "file.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("text")
        assert temporary.suffix == ".txt"
        assert temporary.parent == path.parent
        assert not path.exists()
    assert path.read_text() == "text"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("exists", [True, False])
def test_a_link_stays_and_its_target_is_written(tmp_path, exists):
    (tmp_path / "disk").mkdir()
    target, first, link = tmp_path / "disk" / "blob", tmp_path / "first.json", tmp_path / "link.json"
    if exists:
        target.write_text("old")
    first.symlink_to("disk/blob")
    link.symlink_to(first)
    with atomic_path(link) as temporary:
        temporary.write_text("new")
        assert temporary.parent == target.parent and temporary.suffix == ".json"
    assert link.is_symlink() and first.is_symlink() and target.read_text() == link.read_text() == "new"
    assert sorted(tmp_path.rglob("*")) == sorted((tmp_path / "disk", target, first, link))


def test_leftovers_beside_the_target_of_a_link_are_removed(tmp_path):
    (tmp_path / "disk").mkdir()
    (link := tmp_path / "link.json").symlink_to("disk/blob.json")
    left, other = (tmp_path / "disk" / name for name in (".blob.0123abcd.json", ".link.0123abcd.json"))
    left.touch(), other.touch()
    assert remove_leftovers(tmp_path, target=link) == [left] and not left.exists() and other.exists()


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
    assert json.loads(path.read_text()) == read_json(path) == values
    for bad in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="metrics.json: .* finite numbers only"):
            write_json(path, {"loss": bad})
    assert read_json(path) == values
    write_json(path, values, checked=True)
    assert read_json(path) == values and json.loads(path.read_text()).keys() - values.keys() == {"sha256"}
    path.write_text(path.read_text().replace("0.1", "0.2"))
    with pytest.raises(ValueError, match=r"metrics\.json is damaged \(checksum differs\); delete it"):
        read_json(path)
    for damaged in (b'{"loss": 0.', b"", b"\0\0", b"\xff{}"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"metrics\.json is damaged .*; delete it"):
            read_json(path)


def test_the_file_is_as_readable_as_any(tmp_path):
    (tmp_path / "usual").write_text("text")
    with atomic_path(tmp_path / "file") as temporary:
        temporary.touch(mode=0o600)
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_a_file_is_on_disk_before_it_takes_the_name_and_its_folders_after(tmp_path, calls):
    path = tmp_path / "new" / "folder" / "file"
    synced = calls(os, "fsync", lambda descriptor: (os.fstat(descriptor).st_ino, path.exists()))
    with atomic_path(path) as temporary:
        temporary.write_text("text")
    before = tmp_path, tmp_path / "new", path
    assert synced == [*((place.stat().st_ino, False) for place in before), (path.parent.stat().st_ino, True)]


def test_a_full_disk_is_named_and_leaves_the_old_file(tmp_path, files_end_at):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with files_end_at(1000):
        with pytest.raises(
            OSError, match=r"file\.txt cannot be written: .* old file is unchanged; free some space"
        ) as caught:
            with atomic_path(path) as temporary:
                temporary.write_text("long" * 1000)
    assert caught.value.errno == errno.EFBIG
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_what_a_killed_writer_left_is_removed_and_nothing_else(tmp_path):
    script = """
import os, sys
from pathlib import Path
from torchrl_gn.atomic import atomic_path
names = ("rollout.gif", "checkpoint/checkpoint.safetensors", "table")
writers = [atomic_path(Path(sys.argv[1]) / name) for name in names]
for writer in writers:
    writer.__enter__().write_text("half")
os._exit(9)
"""
    assert subprocess.run([sys.executable, "-c", script, str(tmp_path)]).returncode == 9
    others = [tmp_path / name for name in (".hidden.txt", ".data.lock", "rollout.0123abcd.gif", ".rollout.0123abc.gif")]
    for other in others:
        other.touch()
    left = remove_leftovers(tmp_path)
    assert sorted(path.name.split(".")[1] for path in left) == ["checkpoint", "rollout", "table"]
    assert sorted(path for path in Path(tmp_path).rglob("*") if path.is_file()) == sorted(others)


def test_all_of_a_folder_is_on_disk(tmp_path, calls):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "plain").write_text("text")
    (tmp_path / "a" / "file.memmap").write_text("text")
    synced = calls(os, "fsync", lambda descriptor: os.fstat(descriptor).st_ino)
    sync_all(tmp_path / "a")
    assert {*synced} == {place.stat().st_ino for place in (tmp_path, tmp_path / "a", *(tmp_path / "a").rglob("*"))}
