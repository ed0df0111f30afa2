"""Files: written whole or not at all; TOML, JSON and arrays with one message for each error."""

from __future__ import annotations

import errno
import json
import os
import tempfile
import tomllib
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


LARGEST = 1 << 24
"""Bytes of the largest document that is read."""
DEEPEST = 32
"""Tables and lists within each other in a document."""


def read_toml(path: str | Path, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a TOML file; `origin` is what messages call it.

    Raises `error` where there is no such regular file, or where it is not UTF-8, not TOML, larger
    than `LARGEST` or nested deeper than `DEEPEST`.
    """
    return parse_toml(_text(path, origin, error), origin, error)


def read_json(path: str | Path, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a JSON file, an object; raises `error` as `read_toml` does."""
    return parse_json(_text(path, origin, error), origin, error)


def parse_json(text: str, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a JSON text; raises `error` where it is no object, or nested beyond `DEEPEST`."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as cause:
        raise error(f"{origin} is not valid JSON: {cause}") from None
    if not isinstance(document, dict):
        raise error(f"{origin} is not a JSON object")
    return _shallow(document, origin, error)


def _text(path: str | Path, origin: str, error: type[Exception]) -> str:
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise error(f"{origin} is not a regular file")
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise error(f"{origin} does not exist") from None
    except (OSError, ValueError) as cause:
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"{origin} cannot be read: {reason}") from None
    if len(content) > LARGEST:
        raise error(f"{origin} has {len(content)} bytes, more than any document of ours")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise error(f"{origin} is not UTF-8 text") from None


def parse_toml(text: str, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a TOML text; raises `error` where it is none, or nested beyond `DEEPEST`."""
    try:
        document = tomllib.loads(text)
    # Nesting without end exhausts the parser's stack, a number without end Python's patience.
    except (ValueError, RecursionError) as cause:
        raise error(f"{origin} is not valid TOML: {cause}") from None
    return _shallow(document, origin, error)


def _shallow(document: dict[str, Any], origin: str, error: type[Exception]) -> dict[str, Any]:
    """The document, unless it is nested beyond `DEEPEST`."""
    layer: list[Any] = [document]
    for _ in range(DEEPEST):
        layer = [
            inner
            for value in layer
            for inner in (value.values() if isinstance(value, dict) else value)
            if isinstance(inner, dict | list)
        ]
        if not layer:
            return document
    raise error(f"{origin} is nested more than {DEEPEST} deep")
