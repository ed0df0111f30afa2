"""Files: read with one message per error, cached, temporary; `fmus.files` writes them."""

from __future__ import annotations

import atexit
import json
import os
import shutil
import stat
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

from fmus.files import check_target, protect, publish, replacing, write_atomically

if TYPE_CHECKING:
    import filelock
    from numpy.typing import NDArray

__all__ = [
    "CACHE_VARIABLE",
    "cache_folder",
    "check_target",
    "lock",
    "protect",
    "publish",
    "read_arrays",
    "read_json",
    "read_toml",
    "replacing",
    "temporary_folder",
    "write_atomically",
]

# NumPy and filelock are imported where they are needed: `cosim --help` has no use for them.


def lock(path: Path, timeout: float) -> filelock.AcquireReturnProxy[Any]:
    """Take a lock file within `timeout` seconds; a context whose end gives it back.

    Raises filelock.Timeout where another process holds it; OSError where it cannot be written, or
    its file system gives no locks.
    """
    import filelock  # noqa: PLC0415

    try:
        # Whoever may write the folder may write its lock, so that no lock outlives its process.
        return filelock.FileLock(path, timeout, 0o666, fallback_to_soft=False).acquire()
    except OSError as error:
        if not error.filename and error.strerror:  # not from opening it, and no Timeout
            what = f"its file system gives no locks ({error.strerror}): choose another folder"
            error = OSError(error.errno, f"{what}, by {CACHE_VARIABLE} for the cache", str(path))
        raise error from None


CACHE_VARIABLE = "COSIM_CACHE"
_temporary: dict[Path, Path] = {}


def cache_folder(kind: str) -> Path:
    """The folder for cached files of a `kind`: the user's, made if need be, or a temporary one.

    The user's lies under the environment's COSIM_CACHE, else where the platform keeps caches.
    A temporary one, until this process ends, where that cannot be written or others could write it,
    since native code is loaded from here.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    root = Path(chosen) if chosen else platformdirs.user_cache_path("rti-cosim", appauthor=False)
    folder = root.absolute() / kind
    if _is_ours_alone(folder):
        return folder
    if folder not in _temporary or not _temporary[folder].is_dir():
        _temporary[folder] = Path(tempfile.mkdtemp(prefix=f"cosim-{kind}-"))
        atexit.register(shutil.rmtree, _temporary[folder], ignore_errors=True)
    return _temporary[folder]


def _is_ours_alone(folder: Path) -> bool:
    """Whether a cache's folder, made if need be, and the one above are the user's alone."""
    levels = (folder.parent, folder)
    try:
        folder.parent.parent.mkdir(parents=True, exist_ok=True)
        for level in levels:
            level.mkdir(mode=0o700, exist_ok=True)
        found = [level.lstat() for level in levels]
    except OSError:
        return False
    return os.name == "nt" or all(  # Windows closes a user's profile by other means
        status.st_uid == os.geteuid()
        and status.st_mode & (stat.S_IRWXU | stat.S_IWGRP | stat.S_IWOTH) == stat.S_IRWXU
        and stat.S_ISDIR(status.st_mode)
        for status in found
    )


@contextmanager
def temporary_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """A new folder that only this user can enter, deleted at the end of the block.

    `parent` is where it lies, by default where the system keeps temporary files. Raises OSError
    where it cannot be made.
    """
    with tempfile.TemporaryDirectory(
        prefix=prefix, dir=parent, ignore_cleanup_errors=True
    ) as folder:
        yield Path(folder).absolute()


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz file by name; refuses pickled objects.

    Raises OSError where the file cannot be opened, ValueError where its content is damaged.
    """
    import numpy as np  # noqa: PLC0415

    # NumPy leaves a file open that it opened itself and then found damaged.
    with path.open("rb") as stream:
        try:
            with np.load(stream, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        # Damaged bytes make zipfile, zlib and NumPy raise a dozen types, unrelated ones among them.
        except Exception as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error


def read_toml(path: str | Path, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a TOML file; `origin` is its name in messages.

    Raises `error` where there is no such regular file, or where it is not UTF-8 or not TOML.
    """
    return dict(_parsed(tomllib.loads, "TOML", path, origin, error))


def read_json(path: str | Path, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a JSON file, an object; raises `error` as `read_toml` does."""
    document = _parsed(json.loads, "JSON", path, origin, error)
    if not isinstance(document, dict):
        raise error(f"{origin} is not a JSON object")
    return document


def _parsed(
    parse: Callable[[str], Any], kind: str, path: str | Path, origin: str, error: type[Exception]
) -> Any:
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise error(f"{origin} is not a regular file")
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise error(f"{origin} does not exist") from None
    except (OSError, ValueError) as cause:
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"{origin} cannot be read: {reason}") from None
    try:
        return parse(content.decode("utf-8"))
    except UnicodeDecodeError:
        raise error(f"{origin} is not UTF-8 text") from None
    # Nesting without end exhausts the parser's stack, a number without end Python's patience.
    except (ValueError, RecursionError) as cause:
        raise error(f"{origin} is not valid {kind}: {cause}") from None
