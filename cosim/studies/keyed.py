"""Tables by row and signal: any CSV of the project, its rows told apart by key columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cosim.errors import ResultsError
from cosim.text_tables import csv_text, parse_rows
from cosim.trajectory import Signal

Key = tuple[str, ...]
DIGITS = 8


@dataclass(frozen=True)
class KeyedTable:
    """A table of `signals` by name, one value per row, whose rows are told apart by `rows`."""

    keys: tuple[str, ...]
    rows: Sequence[Key]
    signals: Mapping[str, Signal]

    def of(self, rows: Sequence[Key]) -> KeyedTable:
        """The table with some of its rows, in the order given."""
        places = {row: i for i, row in enumerate(self.rows)}
        chosen = [places[row] for row in rows]
        return KeyedTable(
            self.keys,
            list(rows),
            {n: Signal(n, s.unit, s.values[chosen]) for n, s in self.signals.items()},
        )


def read(text: str, keys: Sequence[str], drop: Sequence[str], origin: str) -> KeyedTable:
    """Read a CSV by its key columns, without the columns `drop`; an empty cell is NaN.

    Raises ResultsError if a key's column is missing, two rows have the same keys, or another column
    holds something else than numbers.
    """
    header, *body = parse_rows(text)
    names = [title.partition(" [")[0] for title in header]
    for key in keys:
        if key not in names:
            raise ResultsError(f"{origin} has no column '{key}'; it has {', '.join(names)}")
    if ragged := next((i for i, row in enumerate(body, 2) if len(row) != len(names)), None):
        raise ResultsError(f"{origin}, line {ragged}: not {len(names)} fields")
    places = [names.index(key) for key in keys]
    rows = [tuple(rounded(row[place]) for place in places) for row in body]
    if len(set(rows)) < len(rows):
        twice = next(row for row, following in pairwise(sorted(rows)) if row == following)
        raise ResultsError(f"{origin} has two rows {dict(zip(keys, twice, strict=True))}")
    signals = {}
    for place, (name, title) in enumerate(zip(names, header, strict=True)):
        if name not in keys and name not in drop:
            unit = title.partition(" [")[2].removesuffix("]")
            values = np.array([_number(row[place], name, origin) for row in body])
            signals[name] = Signal(name, unit, values)
    return KeyedTable(tuple(keys), rows, signals)


def rounded_csv(text: str) -> str:
    """A CSV with numbers of eight digits, as tables are stored: a last bit is no change."""
    header, *rows = parse_rows(text)
    return csv_text(header, ([rounded(cell) for cell in row] for row in rows))


def rounded(cell: str) -> str:
    """A cell's number with eight digits; whole numbers and words as they are."""
    try:
        int(cell)
    except ValueError:
        try:
            return f"{float(cell):.{DIGITS}g}"
        except ValueError:
            return cell
    return cell


def _number(cell: str, name: str, origin: str) -> float:
    try:
        return float(rounded(cell)) if cell else float("nan")
    except ValueError:
        raise ResultsError(f"{origin}, column '{name}': '{cell}' is no number") from None
