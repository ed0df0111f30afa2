"""Files that are there whole or not at all, tables as CSV and Markdown, and the user's cache."""

from __future__ import annotations

import csv
import io
import os
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import platformdirs

CACHE_VARIABLE = "COSIM_CACHE"
PIECE = 10_000
LARGEST = 1 << 24
"""Bytes of the largest document that is read."""
DEEPEST = 32
"""Tables and lists within each other in a document."""


def user_cache(kind: str) -> Path:
    """The user's folder for cached files of a kind, which need not exist yet.

    It lies under the environment's COSIM_CACHE, else where the platform keeps caches.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    root = Path(chosen) if chosen else platformdirs.user_cache_path("rti-cosim", appauthor=False)
    return root.absolute() / kind


def write_atomically(path: str | Path, data: bytes | str | Iterable[str]) -> Path:
    """Write a file under a temporary name in its folder, then rename it into place.

    A reader never sees half a file, and what stood under the name before survives any failure.
    Text, whole or in pieces that are written as they come, is encoded as UTF-8. Raises OSError
    where the folder cannot be written.
    """
    path = Path(path)
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
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path


def make_public(path: Path) -> None:
    """Give a file that mkstemp made private the rights of any other new file of the user."""
    umask = os.umask(0)
    os.umask(umask)
    path.chmod(0o666 & ~umask)


def read_toml(path: str | Path, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a TOML file; `origin` is what messages call it.

    Raises `error` where there is no such regular file, or where it is not UTF-8, not TOML, larger
    than `LARGEST` or nested deeper than `DEEPEST`.
    """
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
        return parse_toml(content.decode("utf-8"), origin, error)
    except UnicodeDecodeError:
        raise error(f"{origin} is not UTF-8 text") from None


def parse_toml(text: str, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a TOML text; raises `error` where it is none, or nested beyond `DEEPEST`."""
    try:
        document = tomllib.loads(text)
    # Nesting without end exhausts the parser's stack, a number without end Python's patience.
    except (ValueError, RecursionError) as cause:
        raise error(f"{origin} is not valid TOML: {cause}") from None
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


def csv_text(header: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of texts as CSV, lines ended by one newline."""
    return "".join(csv_pieces(header, rows))


def csv_pieces(header: Sequence[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """`csv_text`, `PIECE` rows at a time: text takes ten times the memory of its numbers."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    rows = iter(rows)
    while True:
        writer.writerows(islice(rows, PIECE))
        if not (piece := stream.getvalue()):
            return
        yield piece
        stream.seek(0)
        stream.truncate()


def cell(value: Any) -> str:
    """Text of a value: a float reads back to the same bits, None and NaN are empty."""
    if value is None or (isinstance(value, float) and value != value):  # noqa: PLR0124 (NaN)
        return ""
    return repr(float(value)) if isinstance(value, float) else str(value)


def read_csv(path: str | Path, error: type[Exception]) -> list[list[str]]:
    """Rows of a CSV file, its header first; raises `error` where it cannot be read or is empty."""
    try:
        with Path(path).open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise error(f"'{path}' cannot be read: {cause}") from None
    if not rows:
        raise error(f"'{path}' is empty")
    return rows


def parse_rows(text: str) -> list[list[str]]:
    """Rows of CSV text, its header first."""
    return list(csv.reader(io.StringIO(text)))


def parse_records(text: str) -> list[dict[str, str]]:
    """Rows of CSV text by column."""
    return list(csv.DictReader(io.StringIO(text)))


def read_records(path: str | Path, error: type[Exception]) -> list[dict[str, str]]:
    """Rows of a CSV file by column; raises `error` where it cannot be read or a row is torn."""
    header, *rows = read_csv(path, error)
    for number, row in enumerate(rows, start=2):
        if len(row) != len(header):
            raise error(f"'{path}', line {number}: {len(row)} fields, not {len(header)}")
    return [dict(zip(header, row, strict=True)) for row in rows]


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column is text, the others are numbers."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, rule, *rows)) + "\n"
