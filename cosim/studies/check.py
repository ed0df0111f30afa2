"""Holds what is computed now against what is stored, each signal within its own tolerance."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

from pydantic import Field, ValidationError

from cosim.comparison import RunSignals, compare
from cosim.errors import ResultsError
from cosim.files import read_toml
from cosim.studies.document import Table
from cosim.studies.keyed import KeyedTable, read
from cosim.studies.pictures import LOGS, TRAJECTORIES
from cosim.studies.plan import EVALUATION
from cosim.studies.results import CURVES
from cosim.validation import describe

TOLERANCES = "tolerances.toml"


class Tolerance(Table):
    """The largest difference of a signal that counts as none, in the signal's unit."""

    absolute: Annotated[float, Field(ge=0, strict=False)]
    unit: str


class _Tolerances(Table):
    tolerance: dict[str, Tolerance]


def load_tolerances(folder: Path) -> dict[str, Tolerance]:
    """Tolerances by signal of a folder of stored studies; raises ResultsError."""
    path = folder / TOLERANCES
    if not path.exists():
        raise ResultsError(
            f"'{path}' does not exist; name the folder of the results with --results"
        )
    document = read_toml(path, f"'{path}'", ResultsError)
    try:
        return _Tolerances.model_validate(document).tolerance
    except ValidationError as error:
        raise ResultsError(f"'{path}': {describe(error, _Tolerances)}") from None


def compared_tables(folder: Path) -> dict[str, tuple[tuple[str, ...], tuple[str, ...]]]:
    """Tables of a study's folder that a check compares: key columns, and columns left out."""
    run = ("scenario", "case", "training_seed")
    found: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
        EVALUATION: ((*run, "seed"), ()),
        CURVES: ((*run, "samples"), ()),
    }
    for path in sorted((folder / LOGS).glob("*.csv")):
        found[path.relative_to(folder).as_posix()] = (("samples",), ())
    for path in sorted((folder / TRAJECTORIES).glob("**/*.csv")):
        found[path.relative_to(folder).as_posix()] = (("time",), ("status", "residual"))
    return found


def differences(
    name: str, stored: Path, now: Path, tolerances: Mapping[str, Tolerance]
) -> list[str]:
    """What differs between a stored study and the same computed now, in words; [] if nothing.

    Trajectories come first: they name the signal in which a difference begins. Raises ResultsError
    where a stored table is missing or damaged, or a signal has no tolerance.
    """
    wanted, found = compared_tables(stored), compared_tables(now)
    extra = [table for table in found if table not in wanted]
    lines = [f"{name}: {table} is computed but not stored" for table in extra]
    for table, (keys, drop) in reversed(wanted.items()):
        if not (now / table).is_file():
            lines.append(f"{name}: {table} is stored but not computed any more")
            continue
        one, other = (_load(folder / table, keys, drop, name) for folder in (stored, now))
        lines += table_differences(f"{name}/{table}", one, other, tolerances)
    return lines


def _load(path: Path, keys: tuple[str, ...], drop: tuple[str, ...], name: str) -> KeyedTable:
    try:
        return read(path.read_text("utf-8"), keys, drop, f"'{path}'")
    except FileNotFoundError:
        raise ResultsError(
            f"the stored table '{path}' is missing; make it with: cosim results update {name}"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ResultsError(f"the stored table '{path}' cannot be read: {error}") from None


def table_differences(
    name: str, stored: KeyedTable, now: KeyedTable, tolerances: Mapping[str, Tolerance]
) -> list[str]:
    """What differs between two tables, in words.

    The first row that differs is named by its keys, with each signal that differs there, both
    values, unit and tolerance; rows that only one has are named too.
    """
    lines = []
    have = set(now.rows), set(stored.rows)
    if missing := [row for row in stored.rows if row not in have[0]]:
        lines.append(f"{name}: row {_row(stored, missing[0])} is stored but not computed any more")
    if extra := [row for row in now.rows if row not in have[1]]:
        lines.append(f"{name}: row {_row(now, extra[0])} is computed but not stored")
    common = [row for row in stored.rows if row in have[0]]
    stored, now = stored.of(common), now.of(common)
    allowed = {signal: _tolerance(signal, stored, tolerances) for signal in stored.signals}
    found = compare(
        RunSignals("stored", stored.signals),
        RunSignals("now", now.signals),
        {signal: tolerance.absolute for signal, tolerance in allowed.items()},
    )
    if found.first is not None:
        for item in found.differences:
            if item.first == found.first:
                both = (table.signals[item.name].values[found.first] for table in (stored, now))
                was, value = map(float, both)
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


def _tolerance(signal: str, table: KeyedTable, tolerances: Mapping[str, Tolerance]) -> Tolerance:
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


def _row(table: KeyedTable, row: tuple[str, ...]) -> str:
    return ", ".join(f"{key}={value}" for key, value in zip(table.keys, row, strict=True) if value)


def _unit(unit: str) -> str:
    return "" if unit in ("", "1") else f" {unit}"
