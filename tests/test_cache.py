"""Nothing is read from a cache that another user can have written."""

from __future__ import annotations

import ast
import atexit
import os
import shlex
import stat
import subprocess
from pathlib import Path

import pytest
from torch._inductor import codecache
from torch._inductor.runtime import cache_dir_utils

from torchrl_gn import cache
from torchrl_gn.cache import (
    SharedCacheError,
    SharedCacheWarning,
    make_private,
    open_private,
    read_cached,
    write_cached,
    write_private,
)

from .sharing import SHARED, share

HEADERS = hasattr(codecache, "_HEADER_DIR")
ROOT = Path(__file__).parent.parent


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Return the cache's folder, of a user whose files the group can write."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a cache"))
    before = os.umask(0o002)
    yield tmp_path / "a cache/torchrl_gn"
    os.umask(before)


def test_what_is_written_is_read_whatever_the_umask(folder):
    assert read_cached("a.json") is None
    for content in (b"one", b"another"):
        write_cached("a.json", content)
        assert read_cached("a.json") == content
    assert [file.name for file in folder.iterdir()] == ["a.json"]
    for path in (folder, folder / "a.json"):
        assert not path.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def test_the_warning_says_how_to_use_a_folder_that_an_older_version_made(folder):
    folder.mkdir(parents=True)  # under the umask of private groups
    assert folder.stat().st_mode & stat.S_IWGRP
    with pytest.warns(SharedCacheWarning) as said:
        write_cached("a.json", b"one")
    subprocess.run(shlex.split(str(said[0].message).rpartition("run: ")[2]), check=True)
    write_cached("a.json", b"one")
    assert read_cached("a.json") == b"one"


@pytest.mark.parametrize("how", SHARED)
def test_a_folder_that_others_can_write_is_refused(folder, monkeypatch, how):
    write_cached("a.json", b"planted")
    share(folder, how, monkeypatch)
    assert read_cached("a.json") is None
    with pytest.warns(SharedCacheWarning, match=r"torchrl_gn is another user's or can be written by others.*Delete it"):
        write_cached("b.json", b"kept where others write")
    assert not (folder / "b.json").exists()
    for use in (
        make_private,
        lambda place: open_private(place / "a.json"),
        lambda place: write_private(place / "c", b""),
    ):
        with pytest.raises(SharedCacheError):
            use(folder)


@pytest.mark.parametrize("how", SHARED)
def test_a_file_that_others_can_write_is_written_anew(folder, monkeypatch, how):
    write_cached("a.json", b"planted")
    share(folder / "a.json", how, monkeypatch)
    assert read_cached("a.json") is None
    with pytest.raises(SharedCacheError, match="a.json is not a file that only this user can write: delete it"):
        open_private(folder / "a.json")
    write_cached("a.json", b"mine")
    assert read_cached("a.json") == b"mine"


def test_files_of_root_are_read(folder, monkeypatch):
    """An image's cache is filled by root."""
    write_cached("a.json", b"root's")
    share(folder, "another's", monkeypatch, user=0)
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1000)
    share(folder / "a.json", "another's", monkeypatch, user=0)
    assert read_cached("a.json") == b"root's"


@pytest.mark.parametrize("of", ["folder", "link", "file"])
def test_links_lead_nowhere_else(folder, tmp_path, monkeypatch, of):
    """A link of this user's to a folder of this user's is followed, any other is not."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o755)
    folder.parent.mkdir()
    folder.symlink_to(elsewhere)
    write_cached("a.json", b"mine")
    assert read_cached("a.json") == (elsewhere / "a.json").read_bytes() == b"mine"
    if of == "file":
        (elsewhere / "a.json").rename(elsewhere / "b.json")
        (elsewhere / "a.json").symlink_to(elsewhere / "b.json")
    else:
        share(elsewhere if of == "folder" else folder, "another's", monkeypatch)
    assert read_cached("a.json") is None


def test_a_pipe_is_not_waited_for(folder):
    write_cached("b.json", b"")
    os.mkfifo(folder / "a.json", 0o600)
    assert read_cached("a.json") is None


def test_a_write_that_fails_leaves_what_was_there(folder, files_end_at):
    write_cached("a.json", b"before")
    with files_end_at(3):
        write_cached("a.json", b"after")
    assert read_cached("a.json") == b"before" and len(list(folder.iterdir())) == 1


def test_without_a_home_nothing_is_kept(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", "~")  # as if no user had this number
    with pytest.raises(RuntimeError, match="home directory"):
        Path.home()
    write_cached("a.json", b"")
    assert read_cached("a.json") is None


@pytest.fixture
def inductor(tmp_path, monkeypatch) -> Path:
    """Inductor's default folder, and no other named."""
    monkeypatch.setattr(cache_dir_utils, "default_cache_dir", lambda: str(tmp_path / "torchinductor"))
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "")
    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR")
    if HEADERS:
        for name in ("_HEADER_DIR", "_HEADER_LOCK_DIR"):
            monkeypatch.setattr(codecache, name, "shared")
    cache._inductor_folder.cache_clear()
    yield tmp_path / "torchinductor"
    cache._inductor_folder.cache_clear()


def test_inductor_keeps_a_cache_that_is_private(folder, inductor, tmp_path, monkeypatch):
    for name in (None, str(tmp_path / "mine")):
        if name is not None:
            monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", name)
        cache.keep_inductor_private()
        assert os.environ.get("TORCHINDUCTOR_CACHE_DIR") == name
    for made in (inductor, tmp_path / "mine"):
        assert stat.S_IMODE(made.stat().st_mode) == 0o755


@pytest.mark.parametrize("how", SHARED)
@pytest.mark.parametrize("named", [False, True])
def test_inductor_gets_another_cache_if_others_can_write_its_own(folder, inductor, tmp_path, monkeypatch, named, how):
    place = tmp_path / "named" if named else inductor
    if named:
        monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(place))
    place.mkdir()
    share(place, how, monkeypatch)
    with pytest.warns(SharedCacheWarning, match=f"{place.name} is another user's"):
        cache.keep_inductor_private()
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(folder / "inductor") and (folder / "inductor").is_dir()
    # The default folder has compiled headers, whatever the variable says.
    assert not HEADERS or (codecache._HEADER_DIR == "shared") is named
    assert not HEADERS or named or folder in Path(codecache._HEADER_LOCK_DIR).parents


@pytest.mark.skipif(os.geteuid() == 0, reason="root can list any folder")
def test_a_folder_that_cannot_be_listed_is_refused(folder):
    folder.mkdir(parents=True)
    folder.chmod(0o333)
    with pytest.raises(SharedCacheError):
        make_private(folder)
    folder.chmod(0o755)


def test_inductor_gets_a_folder_for_a_while_if_no_cache_is_private(folder, inductor, monkeypatch, calls):
    for place in (inductor, folder):
        place.mkdir(parents=True)
        share(place, "all", monkeypatch)
    left = calls(atexit, "register", lambda _, place, **__: place)
    with pytest.warns(SharedCacheWarning):
        cache.keep_inductor_private()
    (place,) = left
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(place) and stat.S_IMODE(place.stat().st_mode) == 0o700
    place.rmdir()


@pytest.mark.parametrize("part", ["torchrl_gn", "recipes"])
def test_whatever_compiles_looks_at_the_cache_first(part):
    files = [file for file in (ROOT / part).rglob("*.py") if "torch.compile(" in file.read_text()]
    assert files
    for file in files:
        calls = [ast.unparse(node.func) for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)]
        assert calls.count("torch.compile") == calls.count("keep_inductor_private"), file
