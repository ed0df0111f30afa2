"""Files that are there whole or not at all, and arrays read from files that may be damaged."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def write_atomically(path: str | Path, data: bytes | str | Iterable[str]) -> Path:
    """Write a file under a temporary name in its folder, then rename it into place.

    A reader never sees half a file, and what stood under the name before survives any failure.
    Text, whole or in pieces that are written as they come, is encoded as UTF-8. Raises OSError,
    which names the file, where the folder cannot be written or is full, or where something other
    than a file has its name: a device would be no more, a folder cannot be replaced.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, "it is not a regular file", str(path))
    pieces = (data,) if isinstance(data, bytes | str) else data
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            for piece in pieces:
                stream.write(piece.encode() if isinstance(piece, str) else piece)
            stream.flush()
            os.fsync(stream.fileno())
        make_public(Path(temporary))
        Path(temporary).replace(path)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno and not error.filename:
            error.filename = str(path)
        raise
    return path


def make_public(path: Path) -> None:
    """Give a file that mkstemp made private the rights of any other new file of the user."""
    umask = os.umask(0)
    os.umask(umask)
    path.chmod(0o666 & ~umask)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz file by name; none of Python objects, so that nothing in it is executed.

    Raises OSError where the file cannot be opened, ValueError where its content is damaged.
    """
    # NumPy leaves a file open that it opened itself and then found damaged.
    with path.open("rb") as stream:
        try:
            with np.load(stream, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        # Damaged bytes make zipfile, zlib and NumPy raise a dozen types, unrelated ones among them.
        except Exception as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error
