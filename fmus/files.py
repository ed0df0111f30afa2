"""Files that are written whole or not at all, and never over an input of the command."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_inputs: set[tuple[int, int]] = set()


def protect(paths: Iterable[str | Path]) -> None:
    """Protect these files, the inputs of the command and no others, from all writers."""
    _inputs.clear()
    for path in paths:
        # A word of the command need not be a path at all.
        with suppress(OSError, ValueError):
            status = Path(path).stat()
            # By device and number: a file has several paths.
            if stat.S_ISREG(status.st_mode):
                _inputs.add((status.st_dev, status.st_ino))


def check_target(path: str | Path) -> Path:
    """The path, where a file may be written there.

    Raises FileExistsError where an input of this command, or anything but a regular file (a folder,
    a device, a FIFO), has the name.
    """
    path = Path(path)
    if path.exists():
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise FileExistsError(errno.EEXIST, "it is not a regular file", str(path))
        if (status.st_dev, status.st_ino) in _inputs:
            raise FileExistsError(errno.EEXIST, "it is an input of this command", str(path))
    return path


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` to write to; rename it into place after the block.

    A reader never sees half a file, and an older file survives any failure. Raises what
    `check_target` raises, and OSError, which names the file, where the folder cannot be written or
    is full.
    """
    path = check_target(path)
    # Beside it: a rename is at once in one file system alone. Writers tell a format by the suffix.
    word = secrets.token_hex(4)
    temporary = path.with_name(f".{path.name}.{word}{path.suffix}")
    try:
        yield temporary
        publish(temporary, path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        # The name that the user knows.
        if isinstance(error, OSError) and error.errno:
            error.filename = str(path)
        raise


def publish(temporary: Path, path: Path) -> None:
    """Rename a complete file into place, synchronised with the disk.

    Args:
        temporary: the file, in the same folder.
        path: its name from now on.

    Raises:
        OSError: if that is not possible; as `check_target`, too.
    """
    check_target(path)
    # Else a power cut may leave the new name with nothing behind it.
    with temporary.open("rb+") as stream:
        os.fsync(stream.fileno())
    temporary.replace(path)


def write_atomically(path: str | Path, data: bytes | str) -> Path:
    """Write a file as `replacing` does.

    Args:
        path: of the file.
        data: its content; text is encoded as UTF-8.

    Returns:
        The path.
    """
    content = data.encode() if isinstance(data, str) else data
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return Path(path)
