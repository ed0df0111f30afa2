"""Tidy tables: keys and signals, sorted, eight digits, small enough to read a diff of."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cosim.errors import ResultsError
from cosim.trajectory import Signal

Array = NDArray[np.float64]
Key = tuple[str, ...]

DIGITS = 8
LARGEST = 1_000_000
RUN = "run"


@dataclass(frozen=True)
class Tidy:
    """A table of `signals` by name, one value per row, whose rows are told apart by `rows`."""

    keys: tuple[str, ...]
    rows: Sequence[Key]
    signals: Mapping[str, Signal]

    def to_csv(self) -> str:
        """The table as CSV; the same table gives the same bytes."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*self.keys, *(signal.header for signal in self.signals.values())])
        columns = [signal.values for signal in self.signals.values()]
        for i, key in enumerate(self.rows):
            writer.writerow([*key, *(_text(column[i]) for column in columns)])
        return text.getvalue()


def read(text: str, keys: Sequence[str], drop: Sequence[str], origin: str) -> Tidy:
    """Read any CSV into a tidy table: values rounded to eight digits, rows sorted by their keys.

    Raises ResultsError if a key's column is missing, two rows have the same keys, or a column that
    is neither key nor dropped holds something else than numbers (an empty cell is NaN).
    """
    header, *body = list(csv.reader(io.StringIO(text)))
    names = [title.partition(" [")[0] for title in header]
    for key in keys:
        if key not in names:
            raise ResultsError(f"{origin} has no column '{key}'; it has {', '.join(names)}")
    places = [names.index(key) for key in keys]
    body.sort(key=lambda row: [_order(row[place]) for place in places])
    rows = [tuple(_rounded_key(row[place]) for place in places) for row in body]
    if len(set(rows)) < len(rows):
        twice = next(row for row, following in pairwise(rows) if row == following)
        raise ResultsError(f"{origin} has two rows {dict(zip(keys, twice, strict=True))}")
    signals = {}
    for place, (name, title) in enumerate(zip(names, header, strict=True)):
        if name not in keys and name not in drop:
            unit = title.partition(" [")[2].removesuffix("]")
            values = np.array([_number(row[place], name, origin) for row in body])
            signals[name] = Signal(name, unit, values)
    return Tidy(tuple(keys), rows, signals)


def join(tables: Mapping[str, Tidy]) -> Tidy:
    """Put the tables of an experiment's runs one below the other, led by the column `run`."""
    first = next(iter(tables.values()))
    for label, table in tables.items():
        if list(table.signals) != list(first.signals):
            raise ResultsError(
                f"run '{label}' has the signals {', '.join(table.signals)}, another run "
                f"{', '.join(first.signals)}"
            )
    ordered = dict(sorted(tables.items()))
    return Tidy(
        (RUN, *first.keys),
        [(label, *key) for label, table in ordered.items() for key in table.rows],
        {
            name: Signal(
                name,
                signal.unit,
                np.concatenate([table.signals[name].values for table in ordered.values()]),
            )
            for name, signal in first.signals.items()
        },
    )


def _order(cell: str) -> tuple[int, float, str]:
    """Numbers by value, before text by its letters."""
    try:
        return (0, float(cell), "")
    except ValueError:
        return (1, 0.0, cell)


def _rounded_key(cell: str) -> str:
    try:
        int(cell)
    except ValueError:
        try:
            return _text(float(cell))
        except ValueError:
            return cell
    return cell


def _number(cell: str, name: str, origin: str) -> float:
    try:
        value = float(cell) if cell else float("nan")
    except ValueError:
        raise ResultsError(
            f"{origin}, column '{name}': '{cell}' is no number; list the column in keys or drop"
        ) from None
    return float(f"{value:.{DIGITS}g}")


def _text(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.{DIGITS}g}"
