"""A signal's values from a CSV file."""

from __future__ import annotations

import csv
from math import isfinite
from pathlib import Path

TIME_COLUMN = "time"
"""Column of the times in s, where a file has one."""


def read_signal_file(path: str, name: str) -> dict[str, list[float]]:
    """Read a signal's values, and their times if the file has them.

    A title may end with a unit in brackets, `time [s]` say.

    Args:
        path: of a CSV file whose first line has the titles.
        name: of the signal, the title of its column.

    Returns:
        `values`, and `times` where there is a column `time`.

    Raises:
        ValueError: the file cannot be read, lacks the column, or has a cell that is no finite
            number; with file and line.
    """
    try:
        # Excel puts a byte order mark before a CSV file in UTF-8.
        with Path(path).open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            # Each with the number of its line, for messages.
            rows = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError, ValueError, csv.Error) as cause:
        raise ValueError(f"signal '{name}': file '{path}' cannot be read: {cause}") from None
    titles = []
    for cell in rows[0][1] if rows else ():
        title, _, _ = cell.partition("[")
        titles.append(title.strip())
    if name not in titles:
        known = ", ".join(titles) or "nothing"
        raise ValueError(f"signal '{name}': file '{path}' has no column '{name}'; it has {known}")
    for title in (name, TIME_COLUMN):
        if titles.count(title) > 1:
            raise ValueError(f"signal '{name}': file '{path}' has several columns '{title}'")
    content = {"values": _column_of(rows, titles, name, path)}
    if TIME_COLUMN in titles and name != TIME_COLUMN:
        content["times"] = _column_of(rows, titles, TIME_COLUMN, path)
    return content


def _column_of(
    rows: list[tuple[int, list[str]]],
    titles: list[str],
    title: str,
    path: str,
) -> list[float]:
    """Numbers of a column; raises ValueError where a cell is none, with its line."""
    place = titles.index(title)
    numbers = []
    for line, row in rows[1:]:
        # A row may be shorter than the titles.
        cell = row[place].strip() if place < len(row) else ""
        # Infinity and NaN are numbers to Python, but no values of a signal.
        try:
            number = float(cell)
        except ValueError:
            number = float("nan")
        if not isfinite(number):
            raise ValueError(
                f"signal: '{path}', line {line}: {title} is no finite number but '{cell}'"
            )
        numbers.append(number)
    return numbers
