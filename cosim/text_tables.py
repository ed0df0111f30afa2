"""Tables as CSV, whose floats read back to the same bits, and as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

PIECE = 10_000
"""Rows that are text at a time."""


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
