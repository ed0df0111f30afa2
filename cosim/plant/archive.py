"""FMU archives: found by name or path, checked, unpacked on disk, and read once per process."""

from __future__ import annotations

import hashlib
import shutil
import stat
import threading
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from fmpy.model_description import ValidationError, read_model_description

import fmus
from cosim.errors import PlantError
from cosim.files import cache_folder, temporary_folder

SHIPPED = (*fmus.NAMES, *fmus.PLANTS)
DESCRIPTION = "modelDescription.xml"
MAX_ENTRIES = 20_000
MAX_BYTES = 1 << 30


@dataclass(frozen=True)
class UnpackedFmu:
    """An FMU on disk: the archive's path and SHA-256, the folder that holds its content."""

    path: Path
    sha256: str
    folder: Path
    description: Any
    entries: frozenset[str]


_unpacked: dict[tuple[Path, int, int], UnpackedFmu] = {}
_lock = threading.Lock()


def unpack(fmu: str | Path) -> UnpackedFmu:
    """Unpack an FMU, shipped (by name) or foreign (by path), and read its model description.

    An FMU is native code that runs with the caller's rights, so a foreign one is taken only from
    the very path given. Raises PlantError on a missing, corrupt or suspicious archive.
    """
    path = fmus.path(str(fmu)) if str(fmu) in SHIPPED else Path(fmu)
    if path.suffix != ".fmu" and len(path.parts) == 1:
        raise PlantError(
            f"unknown FMU '{fmu}'; shipped are {', '.join(SHIPPED)}, or give the path of an .fmu"
        )
    try:
        path = path.resolve()
        if not path.is_file():
            raise PlantError(f"FMU '{path}' does not exist or is not a file")
        status = path.stat()
    except OSError as error:
        raise PlantError(f"FMU '{path}' cannot be read: {error.strerror}") from None
    key = (path, status.st_mtime_ns, status.st_size)
    with _lock:
        if key not in _unpacked or not _unpacked[key].folder.is_dir():
            _unpacked[key] = _unpack(path)
        return _unpacked[key]


def _unpack(path: Path) -> UnpackedFmu:
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            _check_entries(path, archive)
            if DESCRIPTION not in archive.namelist():
                raise PlantError(f"'{path}' is not an FMU: it has no {DESCRIPTION}")
            stream.seek(0)
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
            folder = place(archive, digest)
            entries = frozenset(archive.namelist())
    except PlantError:
        raise
    except OSError as error:
        raise PlantError(f"FMU '{path}' cannot be unpacked: {error}") from None
    # Damaged bytes make zipfile and zlib raise a dozen types, unrelated ones among them.
    except Exception as error:
        raise PlantError(
            f"FMU '{path}' is corrupt or not an FMU ({error}); copy or build it again"
        ) from None
    return UnpackedFmu(path, digest, folder, _describe(path, folder), entries)


def _check_entries(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse what no honest FMU contains: paths that lead outside, links, absurd size.

    Some tools on Windows part folders by backslashes, against the zip format: read as slashes.
    """
    entries = archive.infolist()
    if len(entries) > MAX_ENTRIES:
        raise PlantError(f"FMU '{path}' is refused: more than {MAX_ENTRIES} entries")
    if sum(entry.file_size for entry in entries) > MAX_BYTES:
        raise PlantError(f"FMU '{path}' is refused: unpacks to more than {MAX_BYTES >> 20} MiB")
    for entry in entries:
        entry.filename = entry.filename.replace("\\", "/")
        name = PurePosixPath(entry.orig_filename.replace("\\", "/"))
        if (
            ":" in entry.orig_filename
            or name.is_absolute()
            or ".." in name.parts
            or "\0" in entry.orig_filename
        ):
            raise PlantError(
                f"FMU '{path}' is refused: entry {entry.orig_filename!r} leads outside its folder"
            )
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise PlantError(f"FMU '{path}' is refused: entry '{name}' is a link")
    archive.NameToInfo = {entry.filename: entry for entry in entries}


def _describe(path: Path, folder: Path) -> Any:
    try:
        description = read_model_description(str(folder))
    except ValidationError as error:
        problems = error.problems
        raise PlantError(
            f"FMU '{path}' has an invalid model description: {problems[0]}"
            + (f" ({len(problems) - 1} more)" if len(problems) > 1 else "")
        ) from None
    # fmpy raises bare Exception and whatever lxml does on text that is not XML.
    except Exception as error:
        raise PlantError(f"FMU '{path}' has an unreadable model description: {error}") from None
    if description.fmiVersion[:2] not in ("2.", "3."):
        raise PlantError(f"FMU '{path}' is FMI {description.fmiVersion}; 2.0 and 3.0 are supported")
    return description


def place(archive: zipfile.ZipFile, sha256: str) -> Path:
    """Folder with the archive's content, byte for byte; unpacked unless it is there already.

    Where others can write the user's cache, or the user cannot, it lies in a temporary folder that
    ends with this process. Raises OSError and what zipfile raises where the archive cannot be
    unpacked.
    """
    from filelock import FileLock  # noqa: PLC0415 - `cosim --help` has no use for it

    cache = cache_folder("fmus")
    folder = cache / sha256
    if _holds(folder, archive):
        return folder
    with FileLock(cache / f"{sha256}.lock", timeout=60):
        if not _holds(folder, archive):
            # What runs from a damaged folder keeps its open files.
            shutil.rmtree(folder, ignore_errors=True)
            with temporary_folder(".partial-", cache) as partial:
                archive.extractall(partial)
                partial.rename(folder)
    return folder


def _holds(folder: Path, archive: zipfile.ZipFile) -> bool:
    """Whether every file of the archive is in the folder with the very same bytes."""
    # Of entries with one name the last is what unpacking leaves.
    entries = {entry.filename: entry for entry in archive.infolist() if not entry.is_dir()}
    try:
        return all(
            not (folder / name).is_symlink() and (folder / name).read_bytes() == archive.read(entry)
            for name, entry in entries.items()
        )
    except OSError:
        return False
