"""Files that are there whole or not at all, arrays in files, and the user's cache folder."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.typing import NDArray

CACHE_VARIABLE = "COSIM_CACHE"


def user_cache(kind: str) -> Path:
    """The user's folder for cached files of a kind, which need not exist yet.

    It lies under the environment's COSIM_CACHE, else where the platform keeps caches.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    root = Path(chosen) if chosen else platformdirs.user_cache_path("rti-cosim", appauthor=False)
    return root.absolute() / kind


def write_atomically(path: str | Path, data: bytes | str) -> Path:
    """Write a file under a temporary name in its folder, then rename it into place.

    A reader never sees half a file, and what stood under the name before survives any failure.
    Text is encoded as UTF-8. Raises OSError where the folder cannot be written.
    """
    path = Path(path)
    content = data.encode() if isinstance(data, str) else data
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes the file private; a result is meant to be read like any other file.
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path


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
