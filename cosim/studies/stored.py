"""A folder of stored studies: NAME.toml is the study, NAME/ its results."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import Field

from cosim.errors import ResultsError
from cosim.files import read_toml, write_atomically
from cosim.scenario import Table
from cosim.studies import figures
from cosim.studies.document import StudyTable
from cosim.studies.document import read as read_study
from cosim.studies.plan import LOGS, TRAJECTORIES, Study, plan
from cosim.studies.report import FOLDER, rendered
from cosim.studies.results import ABOUT, CURVES, KEYS, StudyResults
from cosim.studies.run import EVALUATION, RUNS, TIMING, to_csv
from cosim.validation import instead, validated

TOLERANCES, DIGITS = "tolerances.toml", 8
WORK = ".work"
"""Folder within the folder, of the runs of studies."""
UNCOMPARED = ["status", "residual"]
"""Columns without a tolerance: words, and values of the size of rounding."""
LARGEST = 4_000_000
"""Bytes of a stored table, at most: a diff of it must be readable."""
SUFFIXES = (".csv", ".toml", ".md")
"""Of the files that are stored: figures are drawn from them."""


def stored_results() -> Path:
    """Folder of this version's results: an installed wheel's, else the checkout's."""
    package = Path(__file__).parents[1] / "results"
    return package if (package / TOLERANCES).is_file() else package.parents[1] / "results"


def stored_studies(folder: Path) -> dict[str, StudyTable]:
    """The studies of a folder by name; raises ResultsError and StudyError."""
    if not (folder / TOLERANCES).is_file():
        raise ResultsError(
            f"'{folder}' holds no stored studies ({TOLERANCES}); name the folder with --results"
        )
    paths = sorted(path for path in folder.glob("*.toml") if path.name != TOLERANCES)
    return {path.stem: read_study(path) for path in paths}


def chosen(known: Mapping[str, StudyTable], names: list[str]) -> list[str]:
    """The named studies; raises ResultsError for unknown names."""
    for name in names:
        if name not in known:
            raise ResultsError(f"there is no study '{name}'{instead(name, known)}")
    return names


def store(folder: Path, name: str, out: Path) -> list[str]:
    """Replace a study's stored files; returns those that were too large.

    Left out: the runs' own folders, times, and tables of more than `LARGEST` bytes.
    """
    target = folder / name
    fresh = folder / WORK / f"{name}.fresh"
    shutil.rmtree(fresh, ignore_errors=True)
    left_out = []
    for path in sorted(out.rglob("*")):
        relative = path.relative_to(out)
        kept = path.suffix in SUFFIXES or path.name == ABOUT
        if not path.is_file() or relative.parts[0] == RUNS or path.name == TIMING or not kept:
            continue
        content = path.read_bytes()
        if path.suffix == ".csv":  # a last bit is no change
            content = to_csv(pd.read_csv(path, dtype=str, na_filter=False).map(_rounded)).encode()
        if len(content) > LARGEST:
            left_out.append(relative.as_posix())
            continue
        (fresh / relative).parent.mkdir(parents=True, exist_ok=True)
        write_atomically(fresh / relative, content)
    shutil.rmtree(target, ignore_errors=True)
    fresh.replace(target)
    return left_out


def draw(folder: Path, name: str) -> list[str]:
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
    names: list[str] = []
    for of_scenario in results.draw(stored / FOLDER, ("svg",)).values():
        names += of_scenario
    if results.about["pictures"]:  # of the trajectories and logs that the study keeps
        names += figures.draw(plan(Study.load(folder / f"{name}.toml")), stored, ("svg",))
    return names


def write_readme(folder: Path, studies: dict[str, StudyTable]) -> None:
    """Write README.md: title, tables and links of every stored study."""
    there = [name for name in studies if (folder / name / ABOUT).is_file()]
    results = {name: StudyResults.load(folder / name) for name in there}
    write_atomically(folder / "README.md", rendered("readme.md", studies=studies, results=results))


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
    """Key columns of the tables of a study's folder that a check compares."""
    found = {EVALUATION: [*KEYS, "seed"], CURVES: [*KEYS, "samples"]}
    for kept, key in ((LOGS, "samples"), (TRAJECTORIES, "time")):
        for path in sorted((folder / kept).glob("**/*.csv")):
            found[path.relative_to(folder).as_posix()] = [key]
    return found


def differences(
    name: str, stored: Path, now: Path, tolerances: Mapping[str, Tolerance]
) -> list[str]:
    """Differences of a stored study from the same computed now, in words.

    Trajectories come first: they name the signal in which a difference begins. Raises ResultsError
    where a stored table is missing or damaged, or a signal has no tolerance.
    """
    wanted, found = compared_tables(stored), compared_tables(now)
    extra = [table for table in found if table not in wanted]
    lines = [f"{name}: {table} is computed but not stored" for table in extra]
    for table, keys in reversed(wanted.items()):
        if not (stored / table).is_file():
            raise ResultsError(
                f"the stored table '{stored / table}' is missing; make it with: "
                f"cosim results update {name}"
            )
        if not (now / table).is_file():
            lines.append(f"{name}: {table} is stored but not computed any more")
            continue
        one, other = (_read(folder / table, keys) for folder in (stored, now))
        lines += _table_differences(f"{name}/{table}", one, other, tolerances)
    return lines


def _read(path: Path, keys: list[str]) -> pd.DataFrame:
    """A stored CSV by its key columns; `attrs` are the units of its signals."""
    try:
        frame = pd.read_csv(path, dtype=str, na_filter=False)
    except (OSError, UnicodeDecodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise ResultsError(f"the stored table '{path}' cannot be read: {error}") from None
    parts = {title: title.removesuffix("]").partition(" [") for title in frame}
    frame = frame.rename(columns={title: name for title, (name, _, _) in parts.items()})
    try:
        frame = frame.map(_rounded).set_index(keys).drop(columns=UNCOMPARED, errors="ignore")
        frame = frame.replace("", "nan").astype(float)
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"the stored table '{path}' is damaged: {error}") from None
    if not frame.index.is_unique:
        raise ResultsError(f"'{path}' has two rows {frame.index[frame.index.duplicated()][0]}")
    frame.attrs = {name: unit for name, _, unit in parts.values()}
    return frame


def _table_differences(
    name: str, stored: pd.DataFrame, now: pd.DataFrame, tolerances: Mapping[str, Tolerance]
) -> list[str]:
    """Differences of two tables in words: unmatched rows, first differing row of each signal."""
    lines, lost = [], []
    for one, other, rows, columns in (
        (stored, now, "stored but not computed any more", "stored, not computed"),
        (now, stored, "computed but not stored", "not stored"),
    ):
        for row in one.index.difference(other.index, sort=False)[:1]:
            lines.append(f"{name}: row {_row(one, row)} is {rows}")
        if len(lone := one.columns.difference(other.columns, sort=False)):
            lost.append(f"{name}: signal {', '.join(lone)} is {columns}")
    common = stored.index.intersection(now.index, sort=False)
    signals = [signal for signal in stored if signal in now]
    allowed = [_tolerance(s, (now.attrs | stored.attrs)[s], tolerances) for s in signals]
    was, value = (table.loc[common, signals].to_numpy() for table in (stored, now))
    same = np.isclose(value, was, 0.0, [one.absolute for one in allowed], equal_nan=True)
    first = {i: k for k, i in reversed(np.argwhere(~same).tolist())}
    for k, i in sorted((k, i) for i, k in first.items()):
        text = f"row {_row(stored, common[k])}: signal {signals[i]} is {float(value[k, i])!r} now, "
        text += f"{float(was[k, i])!r} stored, tolerance {allowed[i].absolute:g}"
        lines.append(f"{name}: {text} {allowed[i].unit.removeprefix('1')}".rstrip())
    return lines + lost


def _tolerance(signal: str, unit: str, tolerances: Mapping[str, Tolerance]) -> Tolerance:
    """The signal's own tolerance, else the first matching pattern's (`theta *`)."""
    fitting = (name for name in tolerances if fnmatchcase(signal, name))
    name = signal if signal in tolerances else next(fitting, None)
    if name is None:
        raise ResultsError(f"signal '{signal}' has no tolerance; give it one in {TOLERANCES}")
    if unit and unit != tolerances[name].unit:
        raise ResultsError(
            f"signal '{signal}' is in {unit}, its tolerance in {TOLERANCES} in "
            f"'{tolerances[name].unit}'"
        )
    return tolerances[name]


def _row(table: pd.DataFrame, row: object) -> str:
    values = row if isinstance(row, tuple) else (row,)
    pairs = zip(table.index.names, values, strict=True)
    return ", ".join(f"{key}={value}" for key, value in pairs if value)


def _rounded(cell: str) -> str:
    """A cell as tables store it: numbers with eight digits, whole ones and words as they are."""
    try:
        int(cell)
    except ValueError:
        try:
            return f"{float(cell):.{DIGITS}g}"
        except ValueError:
            return cell
    return cell
