"""A folder of stored studies: NAME.toml is the study, NAME/ its results."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from fnmatch import fnmatchcase
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import Field

from cosim.core.errors import ResultsError
from cosim.core.files import read_toml, temporary_folder, write_atomically
from cosim.core.protocols import Array
from cosim.core.scenario import Table
from cosim.core.validation import instead, validated
from cosim.evaluation import EVALUATION, TIMING
from cosim.studies.definition import Study
from cosim.studies.document import StudyTable
from cosim.studies.document import read as read_study
from cosim.studies.kept import draw_kept
from cosim.studies.plan import LOGS, THETA, TRAJECTORIES, plan
from cosim.studies.report import FOLDER, rendered, write_markdown
from cosim.studies.results import StudyResults
from cosim.studies.run import GREEDY, RUNS_FOLDER, frame_csv
from cosim.studies.tables import (
    ABOUT,
    AGGREGATE,
    CURVES,
    OPERATION,
    RUN_KEYS,
    RUNS_TABLE,
    SUMMARY,
    WHERE,
)

TOLERANCES = "tolerances.toml"
DIGITS = 8
"""Significant digits of stored numbers."""
SAME_NUMBER = 2e-7
"""Difference of a statistic of measurements and of the same ones, rounded to `DIGITS`.

It is relative, and absolute too: a regret is a small difference of two rounded costs.
"""
WORK = ".work"
"""Folder within the folder, of the runs of studies."""
WORD_COLUMNS = ("status", "against", "hash")
"""Columns that hold words, which must be the same; every other one holds numbers."""
KEY_COLUMNS = {
    EVALUATION: [*RUN_KEYS, "seed"],
    CURVES: [*RUN_KEYS, "samples"],
    RUNS_TABLE: RUN_KEYS,
    SUMMARY: WHERE,
    AGGREGATE: ["case"],
    OPERATION: [*RUN_KEYS, "samples"],
    GREEDY: [*RUN_KEYS, "samples", "seed"],
    LOGS: ["samples"],
    TRAJECTORIES: ["time"],
    THETA: ["schema"],
}
"""Key columns of a study's tables, by their file or by the folder that they are in."""
LARGEST = 5_000_000
"""Bytes of a stored table, at most: a diff of it must be readable."""
STORED_SUFFIXES = (".csv", ".toml", ".md")
"""Of the files that are stored: figures are drawn from them."""


def stored_results() -> Path:
    """Folder of this version's results: an installed wheel's, else the checkout's."""
    package = Path(__file__).parents[1]
    installed = package / "results"
    if (installed / TOLERANCES).is_file():
        return installed
    return package.parent / "results"


def stored_studies(folder: Path) -> dict[str, StudyTable]:
    """The studies of a folder by name; raises ResultsError and StudyError."""
    if not (folder / TOLERANCES).is_file():
        raise ResultsError(
            f"'{folder}' holds no stored studies ({TOLERANCES}); name the folder with --results"
        )
    studies = {}
    for path in sorted(folder.glob("*.toml")):
        if path.name != TOLERANCES:
            studies[path.stem] = read_study(path)
    return studies


def chosen(known: Mapping[str, StudyTable], names: list[str]) -> list[str]:
    """Check names of studies.

    Args:
        known: the studies of a folder by name.
        names: what the user names.

    Returns:
        The names.

    Raises:
        ResultsError: there is no such study.
    """
    for name in names:
        if name not in known:
            raise ResultsError(f"there is no study '{name}'{instead(name, known)}")
    return names


def store(folder: Path, name: str, out: Path) -> list[str]:
    """Replace a study's stored files.

    Left out: the runs' own folders, times, and tables of more than `LARGEST` bytes.

    Args:
        folder: of the stored studies.
        name: of the study.
        out: folder of the study that was run.

    Returns:
        Names of the tables that were too large.
    """
    target = folder / name
    fresh = folder / WORK / f"{name}.fresh"
    # Of an attempt that was interrupted.
    shutil.rmtree(fresh, ignore_errors=True)
    left_out = []
    for path in sorted(out.rglob("*")):
        relative = path.relative_to(out)
        is_stored = path.suffix in STORED_SUFFIXES or path.name == ABOUT
        if not is_stored or _is_left_out(relative) or not path.is_file():
            continue
        content = path.read_bytes()
        if path.suffix == ".csv":
            # A last bit is no change.
            table = _texts(path).map(_rounded_cell)
            content = frame_csv(table).encode()
        if len(content) > LARGEST:
            left_out.append(relative.as_posix())
            continue
        copy = fresh / relative
        copy.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(copy, content)
    # Written beside and moved at the end: an interruption leaves the files that were stored.
    shutil.rmtree(target, ignore_errors=True)
    fresh.replace(target)
    return left_out


def _is_left_out(relative: Path) -> bool:
    """Whether a file of a study's folder is a run's own or holds times, and is no result."""
    return relative.parts[0] == RUNS_FOLDER or relative.name == TIMING


def _texts(path: Path) -> pd.DataFrame:
    """A table with its cells as they stand in the file."""
    return pd.read_csv(path, dtype=str, na_filter=False)


def draw_stored(folder: Path, name: str) -> list[str]:
    """Draw the figures of a stored study, from its tables alone, as NAME/figures/*.svg.

    Args:
        folder: of the stored studies.
        name: of the study.

    Returns:
        Names of the figures.

    Raises:
        StudyError: if the study is not stored or its tables are damaged.
    """
    stored = folder / name
    results = StudyResults.load(stored)
    names_by_scenario = results.draw(stored / FOLDER, ("svg",))
    names = list(chain(*names_by_scenario.values()))
    # Of the trajectories and logs that the study keeps, which its plan knows.
    if results.about["pictures"]:
        study = Study.load(folder / f"{name}.toml")
        names += draw_kept(plan(study), stored, ("svg",))
    return names


def report_stored(folder: Path, name: str) -> None:
    """Make the statistics and report.md of a stored study anew from its measurements.

    Nothing is run. Times of the processor are not stored, so the report has none.

    Args:
        folder: of the stored studies.
        name: of the study.

    Raises:
        StudyError: if the study is not stored or its tables are damaged.
    """
    stored = folder / name
    study = StudyResults.load(stored)
    statistics = {SUMMARY: study.summary}
    if len(study.aggregate):
        statistics[AGGREGATE] = study.aggregate
    with temporary_folder("cosim-report-") as work:
        for table_name, table in statistics.items():
            fresh = work / table_name
            fresh.write_text(frame_csv(table), "utf-8")
            # In the digits of what is stored.
            rounded = _texts(fresh).map(_rounded_cell)
            kept = _with_stored_digits(rounded, _texts(stored / table_name))
            write_atomically(stored / table_name, frame_csv(kept))
        # Which figures there are; they are drawn on demand, and not stored.
        figures = study.draw(work / FOLDER, ("svg",))
    write_markdown(study, figures)


def _with_stored_digits(now: pd.DataFrame, before: pd.DataFrame) -> pd.DataFrame:
    """A table's texts, with the stored ones where both are the same number to `SAME_NUMBER`.

    Stored measurements are rounded: that moves the last digit of a statistic made of them.

    Args:
        now: the table as it is made now.
        before: the stored one.
    """
    keys = [name for name in WHERE if name in now.columns]
    same_rows = list(now.columns) == list(before.columns) and now[keys].equals(before[keys])
    # Where rows moved there is no cell to compare.
    if not same_rows:
        return now
    numbers_now = now.apply(pd.to_numeric, errors="coerce").to_numpy(dtype=np.float64)
    numbers_before = before.apply(pd.to_numeric, errors="coerce").to_numpy(dtype=np.float64)
    # A word is no number, and comes from the new table.
    is_same = np.isclose(numbers_now, numbers_before, rtol=SAME_NUMBER, atol=SAME_NUMBER)
    return now.mask(is_same, before)


def write_readme(folder: Path, studies: dict[str, StudyTable]) -> None:
    """Write README.md: title, tables and links of every stored study.

    Args:
        folder: of the stored studies.
        studies: the studies by name, in the order of the page.
    """
    results = {}
    for name in studies:
        if (folder / name / ABOUT).is_file():
            results[name] = StudyResults.load(folder / name)
    text = rendered("readme.md", studies=studies, results=results)
    write_atomically(folder / "README.md", text)


class Tolerance(Table):
    """Largest accepted difference of a signal, in its unit."""

    absolute: Annotated[float, Field(ge=0, strict=False)]
    unit: str


class _Tolerances(Table):
    tolerance: dict[str, Tolerance]


def load_tolerances(folder: Path) -> dict[str, Tolerance]:
    """Tolerances by signal of a folder of stored studies; raises ResultsError."""
    path = folder / TOLERANCES
    document = read_toml(path, f"'{path}'", ResultsError)
    return validated(_Tolerances, document, f"'{path}'", ResultsError).tolerance


def compared_tables(folder: Path) -> dict[str, list[str]]:
    """Every table of a study's folder that a check compares, with its key columns.

    These are all CSV files and all θ files, but for the runs' own folders and the times. Figures,
    pages and study.json, which names versions and the code's hash, are not tables.

    Args:
        folder: Folder of a stored study or of one that was run.

    Returns:
        Key columns by the table's path relative to the folder.

    Raises:
        ResultsError: A table is of a kind without key columns.
    """
    tables: dict[str, list[str]] = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if path.suffix not in (".csv", ".toml") or _is_left_out(relative):
            continue
        # A table is of the kind of its folder, if it is in one.
        top = relative.parts[0]
        keys = KEY_COLUMNS.get(top)
        if keys is None:
            raise ResultsError(
                f"the table '{path}' is of an unknown kind: give '{top}' its key columns in "
                f"{Path(__file__).name}"
            )
        tables[relative.as_posix()] = keys
    return tables


def table_differences(
    name: str,
    stored: Path,
    now: Path,
    tolerances: Mapping[str, Tolerance],
) -> list[str]:
    """Differences of a stored study from the same computed now, in words.

    Trajectories and logs come first: they name the signal in which a difference begins.

    Args:
        name: The study's name, for the messages.
        stored: Folder of its stored tables.
        now: Folder of the tables that were computed now.
        tolerances: Tolerances of the columns.

    Raises:
        ResultsError: A stored table is damaged, evaluation or curves are missing, or a column has
            no tolerance.
    """
    wanted = compared_tables(stored)
    computed = compared_tables(now)
    for table in (EVALUATION, CURVES):
        if table not in wanted:
            raise ResultsError(
                f"the stored table '{stored / table}' is missing; make it with: "
                f"cosim results update {name}"
            )
    lines = []
    for table in computed:
        if table not in wanted:
            lines.append(f"{name}: {table} is computed but not stored")

    def in_folders_first(table: str) -> tuple[bool, str]:
        return "/" not in table, table

    for table in sorted(wanted, key=in_folders_first):
        if table not in computed:
            lines.append(f"{name}: {table} is stored but not computed any more")
            continue
        keys = wanted[table]
        before = _read_stored(stored / table, keys)
        after = _read_stored(now / table, keys)
        lines += _table_differences(f"{name}/{table}", before, after, tolerances)
    return lines


def _read_stored(path: Path, keys: list[str]) -> pd.DataFrame:
    """A stored table by its key columns.

    The columns named in `WORD_COLUMNS` hold texts, all others floats. `attrs` has the columns'
    units.
    """
    try:
        texts = _theta_table(path) if path.suffix == ".toml" else _texts(path)
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise ResultsError(f"the stored table '{path}' cannot be read: {error}") from None
    units: dict[str, str] = {}
    columns: dict[str, list[str] | list[float]] = {}
    try:
        for title in texts:
            # A column is called `NAME [UNIT]`, or by its name alone.
            name, _, unit = title.partition(" [")
            units[name] = unit.removesuffix("]")
            # A table that was just computed has more digits than a stored one.
            cells = [_rounded_cell(cell) for cell in texts[title]]
            if name in keys or name in WORD_COLUMNS:
                columns[name] = cells
            else:
                # An empty cell is a number that there is not.
                columns[name] = [float(cell or "nan") for cell in cells]
        table = pd.DataFrame(columns).set_index(keys)
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"the stored table '{path}' is damaged: {error}") from None
    if not table.index.is_unique:
        twice = table.index[table.index.duplicated()][0]
        raise ResultsError(f"'{path}' has two rows {twice}")
    table.attrs = units
    return table


def _theta_table(path: Path) -> pd.DataFrame:
    """A θ file as a table of one row: its hash, and each number of θ under its name in a log."""
    document = read_toml(path, f"'{path}'", ResultsError)
    row = {
        "schema": str(document.get("schema", "")),
        "hash": str(document.get("hash", "")),
    }
    blocks: Mapping[str, object] = document.get("theta", {})
    for block, values in blocks.items():
        array = np.asarray(values, dtype=np.float64)
        for index, value in np.ndenumerate(array):
            entry = block
            # A block that is one number has no index.
            if index:
                numbers = ",".join(map(str, index))
                entry = f"{block}[{numbers}]"
            row[f"theta {entry}"] = repr(float(value))
    return pd.DataFrame([row])


def _table_differences(
    name: str,
    stored: pd.DataFrame,
    now: pd.DataFrame,
    tolerances: Mapping[str, Tolerance],
) -> list[str]:
    """Differences of two tables in words.

    First rows that only one of them has, then the first differing row of each column, in the order
    of the rows, then columns that only one of them has.
    """
    lone_columns = []
    lines = []
    for table, other, rows_are, columns_are in (
        (stored, now, "stored but not computed any more", "stored, not computed"),
        (now, stored, "computed but not stored", "not stored"),
    ):
        rows = table.index.difference(other.index, sort=False)
        if len(rows):
            # Where a run is gone, all its rows are: the first is enough.
            row = _keys_of_row(table, rows[0])
            lines.append(f"{name}: row {row} is {rows_are}")
        columns = table.columns.difference(other.columns, sort=False)
        if len(columns):
            signals = ", ".join(columns)
            lone_columns.append(f"{name}: signal {signals} is {columns_are}")
    common_rows = stored.index.intersection(now.index, sort=False)
    # Taken once: to take them for each signal is most of the time that a check needs.
    stored_rows = stored.loc[common_rows]
    rows_now = now.loc[common_rows]
    units = now.attrs | stored.attrs
    first_differences = []
    for signal in stored.columns.intersection(now.columns, sort=False):
        tolerance = None
        if signal not in WORD_COLUMNS:
            tolerance = _tolerance_of(signal, units[signal], tolerances)
        before = stored_rows[signal].to_numpy()
        after = rows_now[signal].to_numpy()
        differs = _differs(before, after, tolerance)
        if not differs.any():
            continue
        first = int(np.argmax(differs))
        row = _keys_of_row(stored, common_rows[first])
        # As Python's numbers, whose `repr` names no type.
        value_now = after.tolist()[first]
        stored_value = before.tolist()[first]
        text = f"{name}: row {row}: signal {signal} is {value_now!r} now, {stored_value!r} stored"
        if tolerance is not None:
            # A number without a unit is in units of 1.
            unit = tolerance.unit.removeprefix("1")
            text += f", tolerance {tolerance.absolute:g} {unit}"
        first_differences.append((first, text.rstrip()))
    # A difference that comes first is the cause of those that follow.
    first_differences.sort(key=lambda difference: difference[0])
    lines += [text for _, text in first_differences]
    return lines + lone_columns


def _differs(before: Array, after: Array, tolerance: Tolerance | None) -> NDArray[np.bool_]:
    """Which of the values (K,) differ: words at all, numbers by more than their tolerance."""
    if tolerance is None:
        return np.asarray(before != after)
    is_close = np.isclose(after, before, rtol=0.0, atol=tolerance.absolute, equal_nan=True)
    return ~is_close


def _tolerance_of(signal: str, unit: str, tolerances: Mapping[str, Tolerance]) -> Tolerance:
    """The signal's own tolerance, else the first matching pattern's (`theta *`)."""
    patterns = [name for name in tolerances if fnmatchcase(signal, name)]
    if signal in tolerances:
        tolerance = tolerances[signal]
    elif patterns:
        tolerance = tolerances[patterns[0]]
    else:
        raise ResultsError(f"signal '{signal}' has no tolerance; give it one in {TOLERANCES}")
    if unit and unit != tolerance.unit:
        raise ResultsError(
            f"signal '{signal}' is in {unit}, its tolerance in {TOLERANCES} in '{tolerance.unit}'"
        )
    return tolerance


def _keys_of_row(table: pd.DataFrame, row: object) -> str:
    """The keys of a row of a table, in words."""
    # pandas has a tuple where there are several keys.
    values = row if isinstance(row, tuple) else (row,)
    words = []
    for key, value in zip(table.index.names, values, strict=True):
        # A controller has no training seed.
        if value:
            words.append(f"{key}={value}")
    return ", ".join(words)


def _rounded_cell(cell: str) -> str:
    """A cell as tables store it: numbers with eight digits, whole ones and words as they are."""
    if _is(int, cell) or not _is(float, cell):
        return cell
    return f"{float(cell):.{DIGITS}g}"


def _is(number: type[int] | type[float], text: str) -> bool:
    """Whether a text is a number of a type."""
    try:
        number(text)
    except ValueError:
        return False
    return True
