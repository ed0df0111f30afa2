"""Unpacked FMUs on disk: one folder for each SHA-256, shared by all processes of the user.

A folder that belonged to one process would outlive each that is killed; this one is used again.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import time
import zipfile
from contextlib import suppress
from pathlib import Path

from cosim.files import user_cache

UNUSED_DAYS = 30
_CHUNK = 1 << 20


def place(archive: zipfile.ZipFile, sha256: str) -> Path:
    """Folder with the archive's content, byte for byte; unpacked unless it is there already.

    Where the user's cache cannot be written, a temporary folder that ends with this process.
    Raises OSError and what zipfile raises where the archive cannot be unpacked.
    """
    cache = user_cache("fmus")
    folder = cache / sha256
    if _holds(folder, archive):
        return folder
    try:
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=".partial-", dir=cache))
    except OSError:
        return _own_folder(archive)
    try:
        archive.extractall(partial)
        _publish(partial, folder, archive)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    _sweep(cache)
    return folder


def _own_folder(archive: zipfile.ZipFile) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="cosim-fmu-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    archive.extractall(folder)
    return folder


def _holds(folder: Path, archive: zipfile.ZipFile) -> bool:
    """Whether every file of the archive is in the folder with the very same bytes."""
    # Of entries with one name the last is what unpacking leaves.
    entries = {entry.filename: entry for entry in archive.infolist() if not entry.is_dir()}
    try:
        # Counts as use before the look, so that nobody sweeps what is being looked at.
        os.utime(folder)
        return all(_same(archive, entry, folder / name) for name, entry in entries.items())
    except OSError:
        return False


def _same(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path) -> bool:
    if path.is_symlink() or path.stat().st_size != entry.file_size:
        return False
    with archive.open(entry) as packed, path.open("rb") as unpacked:
        while chunk := packed.read(_CHUNK):
            if chunk != unpacked.read(len(chunk)):
                return False
    return True


def _publish(partial: Path, folder: Path, archive: zipfile.ZipFile) -> None:
    """Rename a complete folder into its place, unless another process was first."""
    damaged = partial.with_name(f"{partial.name}-damaged")
    for _ in range(3):
        try:
            partial.rename(folder)
        except OSError:
            if _holds(folder, archive):
                return
            # What runs from a damaged folder keeps its open files.
            with suppress(FileNotFoundError):
                folder.rename(damaged)
            shutil.rmtree(damaged, ignore_errors=True)
        else:
            return
    raise OSError(f"folder '{folder}' cannot be replaced; delete it")


def _sweep(cache: Path) -> None:
    """Delete what nobody has used for long, and what killed processes left half done."""
    oldest = time.time() - UNUSED_DAYS * 86400
    for folder in cache.iterdir():
        with suppress(FileNotFoundError):
            if folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)
