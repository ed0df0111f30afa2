"""Files that are there whole or not at all, tables as CSV and Markdown, and the user's cache."""

from __future__ import annotations

import csv
import io
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import platformdirs

CACHE_VARIABLE = "COSIM_CACHE"
PIECE = 10_000


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
        # mkstemp makes the file private; a result is meant to be read like any other file.
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path


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
