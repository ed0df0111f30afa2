"""The user's cache as a place that can be trusted: nobody else can have written what is in it."""

from __future__ import annotations

import atexit
import errno
import os
import re
import shutil
import stat
import time
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import platformdirs

from cosim.temporary import delete_temporary_folder, new_temporary_folder

CACHE_VARIABLE = "COSIM_CACHE"
UNUSED_DAYS = 30
UNFINISHED_DAYS = 1
TAG = "CACHEDIR.TAG"
TAGGED = """\
Signature: 8a477f597d28d172789f06886806bc55
# A cache of rti-cosim, by which backups know what they may leave out. What nobody has used for
# some weeks is deleted here, and nothing where this file is missing or another.
"""
"""The mark of a folder that this cache made; see https://bford.info/cachedir/."""
_ENTRY = re.compile(r"(?P<unfinished>\.partial-.*)|[0-9a-f]{16,64}(\..*)?")
_temporary: dict[Path, Path] = {}


def user_cache(kind: str) -> Path:
    """The user's folder for cached files of a kind, which need not exist yet.

    It lies under the environment's COSIM_CACHE, else where the platform keeps caches.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    root = Path(chosen) if chosen else platformdirs.user_cache_path("rti-cosim", appauthor=False)
    return root.absolute() / kind


def own_folder(kind: str) -> Path:
    """The folder for cached files of a `kind`, which only this user can write; made if need be.

    It lies in the user's cache (see `user_cache`). Raises PermissionError where that, or the cache
    above it, belongs to another user, can be written by group or others, is a link, or lies where
    others can put another in its place; OSError where it cannot be made or written.
    """
    folder = user_cache(kind)
    folder.parent.parent.mkdir(parents=True, exist_ok=True)
    for level in (folder.parent, folder):
        level.mkdir(mode=0o700, exist_ok=True)
        if not is_own_folder(level):
            raise PermissionError(
                errno.EACCES, "a link, or other users can write it: chmod go-w", str(level)
            )
    if not _is_out_of_reach(folder.parent):
        raise PermissionError(errno.EACCES, "other users can replace it", str(folder.parent))
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))
    if not any(folder.iterdir()):
        (folder / TAG).write_text(TAGGED, encoding="utf-8")
    return folder


def trusted_folder(kind: str) -> Path:
    """`own_folder`, or, where there is none, a temporary folder that ends with this process.

    What is loaded from here may be native code.
    """
    folder = user_cache(kind)
    if folder in _temporary:
        return _temporary[folder]
    try:
        return own_folder(kind)
    except OSError:
        _temporary[folder] = new_temporary_folder(f"cosim-{kind}-")
    atexit.register(delete_temporary_folder, _temporary[folder])
    return _temporary[folder]


def is_closed(folder: Path) -> bool:
    """Whether a folder for cached files of a kind is there and as `own_folder` wants it."""
    levels = (folder, folder.parent)
    return all(map(is_own_folder, levels)) and _is_out_of_reach(folder.parent)


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


def is_own_file(path: Path) -> bool:
    """Whether a file can have been written by this user only."""
    try:
        with _open_own(path):
            return True
    except OSError:
        return False


def read_own(path: Path) -> bytes:
    """Content of a file that only this user can have written.

    Raises PermissionError where it is another user's, can be written by group or others, or is a
    link or no ordinary file; OSError where it cannot be read.
    """
    with _open_own(path) as stream:
        return stream.read()


def _open_own(path: Path) -> BinaryIO:
    # Not to wait for a writer where a FIFO is in its place.
    flags = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_BINARY", "O_NONBLOCK"))
    stream = os.fdopen(os.open(path, os.O_RDONLY | flags), "rb")
    status = os.fstat(stream.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_nlink == 1 and _is_own(status):
        return stream
    stream.close()
    raise PermissionError(f"{path}: not a file that this user alone can write")


def sweep(folder: Path, days: float = UNUSED_DAYS) -> None:
    """Delete the entries of a cache folder that nobody has used, or touched, for `days`.

    Only in a folder that carries the mark of this cache, and only what has a name of its kind: a
    hash, or what a killed process left unfinished, after `UNFINISHED_DAYS`.
    """
    try:
        if read_own(folder / TAG).decode(errors="replace") != TAGGED:
            return
    except OSError:
        return
    now = time.time()
    for entry in folder.iterdir():
        if not (kind := _ENTRY.fullmatch(entry.name)):
            continue
        allowed = UNFINISHED_DAYS if kind["unfinished"] else days
        with suppress(FileNotFoundError):
            if entry.lstat().st_mtime >= now - allowed * 86400:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink()


def _is_out_of_reach(folder: Path) -> bool:
    """Whether nobody but this user and the system can rename a folder or what it lies in."""
    if os.name == "nt":
        return True
    trusted = {os.geteuid(), 0, Path("/").stat().st_uid}
    for path in {*folder.parents, *folder.resolve().parents}:
        status = path.lstat()
        others = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not stat.S_ISLNK(status.st_mode)
        if status.st_uid not in trusted or (others and not status.st_mode & stat.S_ISVTX):
            return False
    return True


def _is_own(status: os.stat_result) -> bool:
    if os.name == "nt":
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
