"""Holds what is computed now against what is stored, each signal within its own tolerance."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path

from cosim.comparison import RunSignals, compare
from cosim.errors import ResultsError
from cosim.results.experiments import TOLERANCES, Experiment, Tolerance
from cosim.results.tidy import DIGITS, LARGEST, RUN, Tidy, read


def stored_table(folder: Path, name: str, experiment: Experiment) -> Tidy:
    """An experiment's stored table; raises ResultsError if it is missing or not as written."""
    path = table_path(folder, name, experiment)
    try:
        text = path.read_text("utf-8")
    except FileNotFoundError:
        raise ResultsError(
            f"the stored table '{path}' is missing; make it with: cosim results update {name}"
        ) from None
    if len(text.encode()) > LARGEST:
        raise ResultsError(f"the stored table '{path}' is larger than {LARGEST} bytes")
    table = read(text, (RUN, *experiment.keys), (), f"'{path}'")
    if table.to_csv() != text:
        raise ResultsError(
            f"the stored table '{path}' is not sorted or not of {DIGITS} digits; it is written by "
            f"cosim results update {name}, never by hand"
        )
    return table


def table_path(folder: Path, name: str, experiment: Experiment) -> Path:
    """Where an experiment's table is stored."""
    return folder / name / experiment.table


def differences(
    name: str, stored: Tidy, now: Tidy, tolerances: Mapping[str, Tolerance]
) -> list[str]:
    """What differs between a stored table and the same computed now, in words; [] if nothing.

    The first line names the first row that differs, by its keys, and each signal that differs
    there, with both values, unit and tolerance. Raises ResultsError for a signal without tolerance.
    """
    if missing := [row for row in stored.rows if row not in set(now.rows)]:
        return [f"{name}: the row {_row(stored, missing[0])} is stored but not computed any more"]
    if extra := [row for row in now.rows if row not in set(stored.rows)]:
        return [f"{name}: the row {_row(now, extra[0])} is computed but not stored"]
    allowed = {signal: _tolerance(signal, stored, tolerances) for signal in stored.signals}
    found = compare(
        RunSignals("stored", stored.signals),
        RunSignals("now", now.signals),
        {signal: tolerance.absolute for signal, tolerance in allowed.items()},
    )
    lines = []
    if found.first is not None:
        for item in found.differences:
            if item.first == found.first:
                values = (t.signals[item.name].values[found.first] for t in (stored, now))
                was, value = (float(v) for v in values)
                lines.append(
                    f"{name}: row {_row(stored, stored.rows[found.first])}: signal {item.name} is "
                    f"{value!r} now, {was!r} stored: {abs(value - was):.3g} apart, tolerance "
                    f"{item.tolerance:g}{_unit(allowed[item.name].unit)}"
                )
        for item in found.differences:
            if item.first is not None and item.first > found.first:
                row = _row(stored, stored.rows[item.first])
                lines.append(f"{name}: row {row}: signal {item.name} differs from here on")
    for signals, when in ((found.only_a, "stored, not computed"), (found.only_b, "not stored")):
        if signals:
            lines.append(f"{name}: signal {', '.join(signals)} is {when}")
    return lines


def _tolerance(signal: str, table: Tidy, tolerances: Mapping[str, Tolerance]) -> Tolerance:
    """The signal's own tolerance, else that of the first pattern (`theta *`) that fits it."""
    fitting = (name for name in tolerances if fnmatchcase(signal, name))
    name = signal if signal in tolerances else next(fitting, None)
    if name is None:
        raise ResultsError(f"signal '{signal}' has no tolerance; give it one in {TOLERANCES}")
    tolerance, unit = tolerances[name], table.signals[signal].unit
    if unit and unit != tolerance.unit:
        raise ResultsError(
            f"signal '{signal}' is in {unit}, its tolerance in {TOLERANCES} in '{tolerance.unit}'"
        )
    return tolerance


def _row(table: Tidy, row: tuple[str, ...]) -> str:
    return ", ".join(f"{key}={value}" for key, value in zip(table.keys, row, strict=True))


def _unit(unit: str) -> str:
    return "" if unit in ("", "1") else f" {unit}"
