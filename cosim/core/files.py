"""Files: read with one message per error, cached, temporary, locked; `fmus.files` writes them."""

from __future__ import annotations

import atexit
import json
import os
import shutil
import signal
import socket
import stat
import sys
import tempfile
import threading
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

from cosim.core.errors import CosimError
from fmus.files import check_target, protect, publish, replacing, write_atomically

if TYPE_CHECKING:
    import filelock
    from numpy.typing import NDArray

__all__ = [
    "CACHE_VARIABLE",
    "cache_folder",
    "check_target",
    "hold",
    "holding",
    "lock",
    "protect",
    "publish",
    "read_arrays",
    "read_json",
    "read_toml",
    "release",
    "replacing",
    "temporary_folder",
    "write_atomically",
]

# NumPy and filelock are imported where they are needed: `cosim --help` has no use for them.

STAGED = ".cosim-staged-"
"""Begin of the names of folders in which the files of a run wait for its end."""


@contextmanager
def staged(folder: str | Path, owned: Iterable[str] = ()) -> Iterator[Path]:
    """Yield an empty folder for all files of a run, which are moved to `folder` after the block.

    They appear together: after a failure or an interruption the files of before are all there, and
    afterwards none of them is left beside the new ones.

    Args:
        folder: where the files will be; made if need be.
        owned: patterns of the names of all files that such a run may write; those that match and
            that this run has not written are removed.

    Raises:
        OSError: a file cannot be written or moved, names an input of this command, or would
            replace what is no regular file.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with temporary_folder(STAGED, folder) as work:
        new = work / "new"
        old = work / "old"
        new.mkdir()
        old.mkdir()
        try:
            yield new
            _exchange(new, old, folder, owned)
        except OSError as error:
            # As the user knows it.
            if isinstance(error.filename, str):
                error.filename = error.filename.replace(str(new), str(folder))
            raise


def _exchange(
    new: Path,
    old: Path,
    folder: Path,
    owned: Iterable[str],
) -> None:
    """Move files of `new` to a folder, and the owned ones that it lacks to `old`; all or none."""
    names = [path.relative_to(new) for path in sorted(new.rglob("*")) if path.is_file()]
    earlier = set()
    for pattern in owned:
        for path in folder.glob(pattern):
            earlier.add(path.relative_to(folder))
    leaving = sorted(earlier - set(names))
    # Whatever can fail is tried before the first file moves.
    for name in [*names, *leaving]:
        check_target(folder / name)
        for root in (old, folder):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
    for name in names:
        with (new / name).open("rb+") as stream:
            os.fsync(stream.fileno())
        if (folder / name).exists():
            shutil.copy2(folder / name, old / name)
    moved: list[tuple[Path, Path]] = []
    with without_signals():
        try:
            for name in names:
                (new / name).replace(folder / name)
                moved.append((old / name, folder / name))
            for name in leaving:
                (folder / name).replace(old / name)
                moved.append((old / name, folder / name))
        except OSError:
            # All or none: what has moved already goes back.
            for before, now in moved:
                if before.exists():
                    before.replace(now)
                else:
                    now.unlink()
            raise


@contextmanager
def without_signals() -> Iterator[None]:
    """Hold back Ctrl-C, SIGTERM and SIGHUP until the end of the block."""
    # Only the main thread handles signals.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    caught: list[int] = []
    before = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # Windows has no SIGHUP; what the caller ignores, as nohup does, stays ignored.
        if number is None or signal.getsignal(number) in (None, signal.SIG_IGN):
            continue
        before[number] = signal.signal(number, lambda received, _: caught.append(received))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in caught:
            signal.raise_signal(number)


def lock(path: Path, timeout: float) -> filelock.AcquireReturnProxy[Any]:
    """Take a lock file; a context whose end gives it back.

    Args:
        path: the file.
        timeout: seconds to wait for it.

    Raises:
        filelock.Timeout: another process holds it.
        OSError: it cannot be written, or its file system gives no locks.
    """
    import filelock  # noqa: PLC0415

    try:
        # Whoever may write the folder may write its lock, so that no lock outlives its process.
        return filelock.FileLock(path, timeout, 0o666, fallback_to_soft=False).acquire()
    except OSError as error:
        # Not from opening it, and no Timeout.
        if not error.filename and error.strerror:
            what = f"its file system gives no locks ({error.strerror}): choose another folder"
            error = OSError(error.errno, f"{what}, by {CACHE_VARIABLE} for the cache", str(path))
        raise error from None


LOCK = ".cosim.lock"
HOLDER = ".cosim.lock.holder"
_locks: dict[Path, filelock.BaseFileLock] = {}
"""Locks of this process, by folder."""


def hold(folder: Path) -> None:
    """Take a folder's lock until `release`; this process may take it again.

    The system releases the lock when the process ends, however it ends. Raises CosimError that
    says who holds it and since when, OSError where the folder cannot be written.
    """
    import filelock  # noqa: PLC0415

    folder = folder.resolve()
    if folder in _locks:
        return
    try:
        _locks[folder] = lock(folder / LOCK, 0).lock
    except filelock.Timeout:
        who = "another process"
        with suppress(OSError, ValueError):
            who = (folder / HOLDER).read_text("utf-8") or who
        raise CosimError(
            f"folder '{folder}' is being written by {who}; wait for it or choose another --out"
        ) from None
    # What a process that was killed has left.
    for staged in folder.glob(f"{STAGED}*"):
        shutil.rmtree(staged, ignore_errors=True)
    since = datetime.now(UTC).isoformat(timespec="seconds")
    command = " ".join(["cosim", *sys.argv[1:]])
    holder = f"process {os.getpid()} on {socket.gethostname()} ({command}) since {since}"
    write_atomically(folder / HOLDER, holder.encode("utf-8", "backslashreplace"))


@contextmanager
def holding(folder: Path) -> Iterator[None]:
    """Hold a folder, made if need be, during the block, as `hold` does."""
    folder.mkdir(parents=True, exist_ok=True)
    ours = folder.resolve() not in _locks
    hold(folder)
    try:
        yield
    finally:
        if ours:
            _release(folder.resolve())


def release() -> list[Path]:
    """Release every lock of this process and remove its files; returns the folders."""
    folders = list(_locks)
    for folder in folders:
        _release(folder)
    return folders


def _release(folder: Path) -> None:
    lock_ = _locks.pop(folder)
    # Remove it while it is held: another process then makes another file.
    for name in (HOLDER, LOCK):
        with suppress(OSError):
            (folder / name).unlink()
    lock_.release()


CACHE_VARIABLE = "COSIM_CACHE"
"""Variable of the environment that names the folder of caches."""
_temporary: dict[Path, Path] = {}
"""Temporary folders in place of caches that cannot be used."""


def cache_folder(kind: str, *, plain: bool = False) -> Path:
    """The folder for cached files of a `kind`: the user's, made if need be, or a temporary one.

    The user's lies under the environment's COSIM_CACHE, else where the platform keeps caches.
    A temporary one, until this process ends, where that cannot be written or others could write it,
    since native code is loaded from here.

    Args:
        kind: name of the folder.
        plain: asks for a path without blanks and other signs that a URI escapes. Where the user's
            has some, a folder of the user alone in the system's folder of temporary files takes its
            place.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    root = Path(chosen) if chosen else platformdirs.user_cache_path("rti-cosim", appauthor=False)
    folder = root.absolute() / kind
    if plain and not _is_plain(folder):
        # Windows has a folder of temporary files for each user.
        user = getattr(os, "getuid", int)()
        system_folder = Path(tempfile.gettempdir())
        folder = system_folder / f"rti-cosim-{user}" / kind
    if _is_ours_alone(folder):
        return folder
    temporary = _temporary.get(folder)
    # One for the process; a user may have tidied up meanwhile.
    if temporary is None or not temporary.is_dir():
        temporary = Path(tempfile.mkdtemp(prefix=f"cosim-{kind}-"))
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        _temporary[folder] = temporary
    return temporary


def _is_plain(folder: Path) -> bool:
    # A URI writes a blank as %20.
    return folder.as_uri().endswith(folder.as_posix())


def _is_ours_alone(folder: Path) -> bool:
    """Whether a cache's folder, made if need be, and the one above are the user's alone."""
    levels = (folder.parent, folder)
    try:
        folder.parent.parent.mkdir(parents=True, exist_ok=True)
        for level in levels:
            level.mkdir(mode=0o700, exist_ok=True)
        statuses = [level.lstat() for level in levels]
    except OSError:
        return False
    # Windows closes a user's profile by other means.
    if os.name == "nt":
        return True
    for status in statuses:
        # The user may do all, no other may write.
        permissions = status.st_mode & (stat.S_IRWXU | stat.S_IWGRP | stat.S_IWOTH)
        if status.st_uid != os.geteuid() or permissions != stat.S_IRWXU:
            return False
        if not stat.S_ISDIR(status.st_mode):
            return False
    return True


@contextmanager
def temporary_folder(prefix: str, parent: Path | None = None) -> Iterator[Path]:
    """A new folder that only this user can enter, deleted at the end of the block.

    Args:
        prefix: begin of its name.
        parent: where it lies, by default where the system keeps temporary files.

    Raises:
        OSError: it cannot be made.
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


def read_toml(
    path: str | Path,
    origin: str,
    error: type[Exception],
) -> dict[str, Any]:
    """Document of a TOML file.

    Args:
        path: of the file.
        origin: what messages call it.
        error: class of the exception that is raised.

    Raises:
        error: there is no such regular file, or it is not UTF-8 or not TOML.
    """
    return parse_toml(read_text(path, origin, error), origin, error)


def read_json(
    path: str | Path,
    origin: str,
    error: type[Exception],
) -> dict[str, Any]:
    """Document of a JSON file, an object.

    Args:
        path: of the file.
        origin: what messages call it.
        error: class of the exception that is raised.

    Raises:
        error: as `read_toml`.
    """
    document = _parsed(json.loads, "JSON", read_text(path, origin, error), origin, error)
    if not isinstance(document, dict):
        raise error(f"{origin} is not a JSON object")
    return document


def parse_toml(
    text: str,
    origin: str,
    error: type[Exception],
) -> dict[str, Any]:
    """Document of a TOML text.

    Args:
        text: TOML.
        origin: what messages call it.
        error: class of the exception that is raised.

    Raises:
        error: on other text.
    """
    return dict(_parsed(tomllib.loads, "TOML", text, origin, error))


def read_text(
    path: str | Path,
    origin: str,
    error: type[Exception],
) -> str:
    """Text of a UTF-8 file.

    Args:
        path: of the file.
        origin: what messages call it.
        error: class of the exception that is raised.

    Raises:
        error: there is no such regular file, or it holds other bytes.
    """
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise error(f"{origin} is not a regular file")
        return Path(path).read_bytes().decode("utf-8")
    except FileNotFoundError:
        raise error(f"{origin} does not exist") from None
    except UnicodeDecodeError:
        raise error(f"{origin} is not UTF-8 text") from None
    except (OSError, ValueError) as cause:
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"{origin} cannot be read: {reason}") from None


def _parsed(
    parse: Callable[[str], Any],
    kind: str,
    text: str,
    origin: str,
    error: type[Exception],
) -> Any:
    try:
        return parse(text)
    # Nesting without end exhausts the parser's stack, a number without end Python's patience.
    except (ValueError, RecursionError) as cause:
        raise error(f"{origin} is not valid {kind}: {cause}") from None
