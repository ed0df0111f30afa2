"""The user's cache as a place that can be trusted: nobody else can have written what is in it."""

from __future__ import annotations

import atexit
import os
import shutil
import stat
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import platformdirs

CACHE_VARIABLE = "COSIM_CACHE"
UNUSED_DAYS = 30
_temporary: dict[Path, Path] = {}


def user_cache(kind: str) -> Path:
    """The user's folder for cached files of a kind, which need not exist yet.

    It lies under the environment's COSIM_CACHE, else where the platform keeps caches.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    root = Path(chosen) if chosen else platformdirs.user_cache_path("rti-cosim", appauthor=False)
    return root.absolute() / kind


def trusted_folder(kind: str) -> Path:
    """The folder for cached files of a `kind` that only this user can write; made if need be.

    It lies in the user's cache (see `user_cache`). Where that, or the cache above it, belongs to
    another user, can be written by group or others, is reached through a link, or cannot be made,
    a temporary folder that ends with this process takes its place: what is loaded from here may be
    native code.
    """
    folder = user_cache(kind)
    if folder in _temporary:
        return _temporary[folder]
    try:
        folder.parent.parent.mkdir(parents=True, exist_ok=True)
        for level in (folder.parent, folder):
            level.mkdir(mode=0o700, exist_ok=True)
        if is_own_folder(folder.parent) and is_own_folder(folder) and _writable(folder):
            return folder
    except OSError:
        pass
    _temporary[folder] = Path(tempfile.mkdtemp(prefix=f"cosim-{kind}-"))
    atexit.register(shutil.rmtree, _temporary[folder], ignore_errors=True)
    return _temporary[folder]


def is_own_folder(folder: Path) -> bool:
    """Whether a folder is this user's and closed to all others for writing, and no link."""
    if os.name == "nt":  # a user's profile is closed to others by its access control list
        return folder.is_dir()
    try:
        opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        return _is_own(os.fstat(opened))
    finally:
        os.close(opened)


def read_own(path: Path) -> bytes:
    """Content of a file that only this user can have written.

    Raises PermissionError where it is another user's, can be written by group or others, or is a
    link or no ordinary file; OSError where it cannot be read.
    """
    opened = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(opened, "rb") as stream:
        status = os.fstat(opened)
        if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1 or not _is_own(status):
            raise PermissionError(f"{path}: not a file that this user alone can write")
        return stream.read()


def sweep(folder: Path, days: float = UNUSED_DAYS) -> None:
    """Delete the entries of a cache folder that nobody has used, or touched, for `days`."""
    oldest = time.time() - days * 86400
    for entry in folder.iterdir():
        with suppress(FileNotFoundError):
            if entry.lstat().st_mtime >= oldest:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink()


def _is_own(status: os.stat_result) -> bool:
    if os.name == "nt":
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _writable(folder: Path) -> bool:
    return os.access(folder, os.W_OK | os.X_OK)
