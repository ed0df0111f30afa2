"""Files that are there whole or not at all, and the user's folder for what is cached."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import platformdirs

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
