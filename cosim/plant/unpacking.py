"""Unpacked FMUs on disk: one folder for each SHA-256, shared by all processes of the user.

A folder that belonged to one process would outlive each that is killed; this one is used again.
"""

from __future__ import annotations

import os
import shutil
import zipfile
from contextlib import suppress
from pathlib import Path

from cosim.cache import sweep, trusted_folder
from cosim.temporary import temporary_folder

_CHUNK = 1 << 20


def place(archive: zipfile.ZipFile, sha256: str) -> Path:
    """Folder with the archive's content, byte for byte; unpacked unless it is there already.

    Where others can write the user's cache, or the user cannot, it lies in a temporary folder that
    ends with this process. Raises OSError and what zipfile raises where the archive cannot be
    unpacked.
    """
    cache = trusted_folder("fmus")
    folder = cache / sha256
    if _holds(folder, archive):
        return folder
    with temporary_folder(".partial-", cache) as partial:
        archive.extractall(partial)
        _publish(partial, folder, archive)
    sweep(cache)
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
