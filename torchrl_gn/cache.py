"""Per-machine caches, in folders that no other user can write."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import shlex
import shutil
import stat
import tempfile
import uuid
import warnings
from pathlib import Path


class SharedCacheError(OSError):
    """Another user owns or can write a folder or file of a cache."""


class SharedCacheWarning(UserWarning):
    """A cache is not used because another user owns or can write it."""


def cache_folder() -> Path:
    """Return the folder for measurements and builds of this processor; RuntimeError without a home folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl_gn"


def make_private(folder: Path) -> None:
    """Make a folder that only this user can write, unless it exists.

    Raises:
        SharedCacheError: if another user owns or can write the existing folder.
    """
    if not os.path.lexists(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):  # another process made it just now
            folder.mkdir(mode=0o755)
    os.close(_open_folder(folder))


def open_private(file: Path) -> int:
    """Open a cache file for reading and return its descriptor.

    Returns a descriptor, not a path: a user who can write a parent folder could replace the file after the check.

    Raises:
        FileNotFoundError: if the file does not exist.
        SharedCacheError: if another user owns or can write the folder or the file, or the file is not a regular one.
        OSError: if the file is a link.
    """
    folder = _open_folder(file.parent)
    try:
        descriptor = os.open(file.name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
    finally:
        os.close(folder)
    state = os.fstat(descriptor)
    if stat.S_ISREG(state.st_mode) and _is_private(state):
        return descriptor
    os.close(descriptor)
    raise SharedCacheError(f"{file} is not a file that only this user can write: delete it.")


def write_private(file: Path, content: bytes) -> None:
    """Write a cache file atomically, replacing an existing one; OSError if that fails."""
    folder, temporary = _open_folder(file.parent), f".{file.stem}.{uuid.uuid4().hex[:8]}{file.suffix}"
    try:
        # Not 0o666: under a lax umask the group could write the file, and open_private would refuse it.
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        with open(os.open(temporary, flags, 0o644, dir_fd=folder), "wb") as out:
            out.write(content)
        os.replace(temporary, file.name, src_dir_fd=folder, dst_dir_fd=folder)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary, dir_fd=folder)
        os.close(folder)


def read_cached(name: str) -> bytes | None:
    """Return the content of a file in :func:`cache_folder`; None if it is missing or another user can write it."""
    try:
        with open(open_private(cache_folder() / name), "rb") as file:
            return file.read()
    except (OSError, RuntimeError):  # RuntimeError: no home
        return None


def write_cached(name: str, content: bytes) -> None:
    """Write a file in :func:`cache_folder`; do nothing if that is not possible.

    Warns:
        SharedCacheWarning: if another user owns or can write the folder.
    """
    try:
        make_private(cache_folder())
        write_private(cache_folder() / name, content)
    except SharedCacheError as error:
        warn_of(error)
    except (OSError, RuntimeError):
        pass


def warn_of(error: SharedCacheError) -> None:
    """Warn that a folder is not used; Python's default filter shows the warning once per folder."""
    warnings.warn(str(error), SharedCacheWarning, stacklevel=2)


def keep_inductor_private() -> None:
    """Replace Inductor's code folders by a private one if others can write them; call before ``torch.compile``.

    Warns:
        SharedCacheWarning: if a folder is replaced.
    """
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir

    default = default_cache_dir()
    if not _accepts(Path(default)):
        from torch._inductor import codecache

        if hasattr(codecache, "_HEADER_DIR"):  # compiled headers ignore the variable below
            headers = _inductor_folder() / "precompiled_headers"
            codecache._HEADER_DIR, codecache._HEADER_LOCK_DIR = str(headers), str(headers / "locks")
    if not _accepts(Path(os.environ.get("TORCHINDUCTOR_CACHE_DIR") or default)):
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(_inductor_folder())


def _accepts(folder: Path) -> bool:
    try:
        make_private(folder)
    except SharedCacheError as error:
        warn_of(error)
        return False
    except OSError:  # Inductor reports the error itself
        pass
    return True


@functools.cache
def _inductor_folder() -> Path:
    try:
        folder = cache_folder()
        make_private(folder)
        make_private(folder / "inductor")
        return folder / "inductor"
    except (OSError, RuntimeError):
        folder = Path(tempfile.mkdtemp(prefix="torchrl_gn-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return folder


def _open_folder(folder: Path) -> int:
    link = os.lstat(folder)
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)  # O_PATH needs no read permission
    if _is_trusted(link) and _is_private(os.fstat(descriptor)):
        return descriptor
    os.close(descriptor)
    raise SharedCacheError(
        f"{folder} is another user's or can be written by others, who could put code there: nothing there is used or"
        " kept. Delete it, or choose another place (XDG_CACHE_HOME, TORCHINDUCTOR_CACHE_DIR); if an older version made"
        f" it and nobody else was there, run: chmod go-w {shlex.quote(str(folder))}"
    )


def _is_private(state: os.stat_result) -> bool:
    return _is_trusted(state) and not state.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _is_trusted(state: os.stat_result) -> bool:
    return state.st_uid in (0, os.geteuid())  # root may have filled an image's cache, and can do anything anyway
