"""Caches: files that are made once for a machine, in folders that no other user can write."""

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
    """A cache is not used, as another user owns it or can write it."""


def cache_folder() -> Path:
    """Return the folder of what is measured or built once for a processor; RuntimeError without a home."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl_gn"


def make_private(folder: Path) -> None:
    """Make a folder that only this user can write, if it is not there.

    Raises:
        SharedCacheError: if it is another user's, or others can write it.
    """
    if not os.path.lexists(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):  # another process made it just now
            folder.mkdir(mode=0o755)
    os.close(_open_folder(folder))


def open_private(file: Path) -> int:
    """Open a file of a cache to read it, and return its descriptor.

    A descriptor, because whoever can write a folder above could exchange what lies at a path once it was checked.

    Raises:
        FileNotFoundError: if there is none.
        SharedCacheError: if folder or file are another user's, or others can write them, or the file is a link.
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
    raise SharedCacheError(f"{file} is no file of this user's alone: delete it.")


def write_private(file: Path, content: bytes) -> None:
    """Write a file of a cache, whole or not at all, in place of what is there; OSError if that fails."""
    folder, temporary = _open_folder(file.parent), f".{file.stem}.{uuid.uuid4().hex[:8]}{file.suffix}"
    try:
        # The mode counts without the umask too: what a group can write is not read again.
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        with open(os.open(temporary, flags, 0o644, dir_fd=folder), "wb") as out:
            out.write(content)
        os.replace(temporary, file.name, src_dir_fd=folder, dst_dir_fd=folder)
    finally:
        with contextlib.suppress(OSError):
            os.unlink(temporary, dir_fd=folder)
        os.close(folder)


def read_cached(name: str) -> bytes | None:
    """Return the content of a file of :func:`cache_folder`; None if there is none, or not of this user's alone."""
    try:
        with open(open_private(cache_folder() / name), "rb") as file:
            return file.read()
    except (OSError, RuntimeError):  # RuntimeError: no home
        return None


def write_cached(name: str, content: bytes) -> None:
    """Write a file of :func:`cache_folder`, or nothing where that is not possible.

    Warns:
        SharedCacheWarning: if the folder is another user's, or others can write it.
    """
    try:
        make_private(cache_folder())
        write_private(cache_folder() / name, content)
    except SharedCacheError as error:
        warn_of(error)
    except (OSError, RuntimeError):
        pass


def warn_of(error: SharedCacheError) -> None:
    """Say, once for each folder, that it is not used."""
    warnings.warn(str(error), SharedCacheWarning, stacklevel=2)


def keep_inductor_private() -> None:
    """Refuse to Inductor, before ``torch.compile``, folders of code that others can write; give it another one then.

    Warns:
        SharedCacheWarning: if another one is given.
    """
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir

    default = default_cache_dir()
    if not _accepts(Path(default)):
        from torch._inductor import codecache

        if hasattr(codecache, "_HEADER_DIR"):  # compiled headers lie there, whatever the variable says
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
    except OSError:  # Inductor says what is wrong
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
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)  # although it cannot be listed
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
    return state.st_uid in (0, os.geteuid())  # root, who may have filled the cache of an image, can do anything anyway
