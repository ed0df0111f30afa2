"""`cosim results check` compares every table of a study: each column, row and file."""

import csv
import io
import shutil
from pathlib import Path

import pytest

from cosim.core.errors import ResultsError
from cosim.studies.stored import (
    WORD_COLUMNS,
    compared_tables,
    load_tolerances,
    stored_studies,
    table_differences,
)

STORED = Path(__file__).parents[3] / "results"
CHECKED = [name for name, table in stored_studies(STORED).items() if table.check]
PRINTED = "paper-printed(value_offset=discounted_exploration=additive)"
TABLES = [
    *(("regression", table) for table in compared_tables(STORED / "regression")),
    ("learning", f"logs/{PRINTED}.csv"),
    ("before-after", "trajectories/day/fouled/naive.csv"),
]
"""One table of each kind."""


@pytest.fixture
def twice(tmp_path):
    """Give some stored tables of a study, and a copy to change."""

    def copy(study, *tables):
        for name in ("stored", "now"):
            for table in {"evaluation.csv", "curves.csv", *tables}:
                target = tmp_path / name / table
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(STORED / study / table, target)
        return tmp_path / "stored", tmp_path / "now"

    return copy


def compared(study, stored, now):
    return table_differences(study, stored, now, load_tolerances(STORED))


def read(path):
    header, *rows = csv.reader(io.StringIO(path.read_text()))
    return header, rows


def write(path, header, rows):
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    path.write_text(text.getvalue())


def other(cell, name):
    """Another content of a cell."""
    if name in WORD_COLUMNS:
        return cell + "x"
    return str(float(cell or 0.0) * 1.01 + 1.0)


@pytest.mark.parametrize("study", CHECKED)
def test_all_csv_and_theta_files_of_a_checked_study_are_compared(study):
    there = {path.relative_to(STORED / study) for path in (STORED / study).rglob("*.csv")}
    there |= {path.relative_to(STORED / study) for path in (STORED / study).rglob("*.toml")}
    assert {Path(table) for table in compared_tables(STORED / study)} == there
    assert {Path(name) for name in ("summary.csv", "runs.csv", "evaluation.csv")} <= there


@pytest.mark.parametrize(("study", "table"), TABLES, ids=map("/".join, TABLES))
def test_a_change_in_any_column_is_told_with_its_row_and_both_values(twice, study, table):
    stored, now = twice(study, table)
    keys = compared_tables(stored)[table]
    header, rows = read(now / table)
    names = [title.partition(" [")[0] for title in header]
    row = rows[-1]
    before = dict(zip(names, row, strict=True))
    where = ", ".join(f"{key}={before[key]}" for key in keys if before[key])
    changed = [name for name in names if name not in keys]
    rows[-1] = [
        other(cell, name) if name in changed else cell
        for name, cell in zip(names, row, strict=True)
    ]
    write(now / table, header, rows)
    lines = compared(study, stored, now)
    for name in changed:
        (line,) = (line for line in lines if f"signal {name} is " in line)
        assert line.startswith(f"{study}/{table}: row {where}: signal {name} is ")
        values = line.partition(" is ")[2]
        assert " now, " in values
        assert " stored" in values
    assert len(lines) == len(changed)


@pytest.mark.parametrize(("study", "table"), TABLES, ids=map("/".join, TABLES))
def test_a_missing_file_and_an_additional_one_are_told(twice, study, table):
    stored, now = twice(study, table)
    (now / table).unlink()
    if table in ("evaluation.csv", "curves.csv"):
        with pytest.raises(ResultsError, match=table):
            compared(study, now, stored)
        return
    assert compared(study, stored, now) == [f"{study}: {table} is stored but not computed any more"]
    assert compared(study, now, stored) == [f"{study}: {table} is computed but not stored"]


@pytest.mark.parametrize("table", ["summary.csv", "operation.csv", "greedy.csv", "runs.csv"])
def test_a_missing_column_and_row_and_an_additional_one_are_told(twice, table):
    stored, now = twice("regression", table)
    header, rows = read(now / table)
    write(now / table, header[:-1], [row[:-1] for row in rows[:-1]])
    (lost_row, lost_column) = compared("regression", stored, now)
    assert f"signal {header[-1]} is stored, not computed" in lost_column
    assert "is stored but not computed any more" in lost_row
    (new_row, new_column) = compared("regression", now, stored)
    assert f"signal {header[-1]} is not stored" in new_column
    assert "is computed but not stored" in new_row


def test_a_number_that_is_gone_and_one_that_is_new_are_differences(twice):
    stored, now = twice("gate", "summary.csv")
    header, rows = read(now / "summary.csv")
    at = header.index("regret_median_low")
    assert rows[1][at] != ""
    rows[1][at] = ""
    write(now / "summary.csv", header, rows)
    assert "regret_median_low is nan now" in " ".join(compared("gate", stored, now))
    assert "regret_median_low is " in " ".join(compared("gate", now, stored))


def test_another_theta_in_a_kept_file_is_told_by_the_name_of_its_entry(twice):
    stored, now = twice("learning", f"parameters/{PRINTED}.toml")
    (path,) = (now / "parameters").glob("*.toml")
    text = path.read_text()
    number = next(line for line in text.splitlines() if line.startswith("c_lambda"))
    path.write_text(text.replace(number, "c_lambda = 1.0"))
    (line,) = compared("learning", stored, now)
    assert f"parameters/{path.name}" in line
    assert "signal theta c_lambda is 1.0 now" in line


def test_a_table_of_an_unknown_kind_is_refused(twice):
    stored, now = twice("gate")
    (now / "more.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ResultsError, match=r"more\.csv"):
        compared("gate", stored, now)


def test_a_column_without_a_tolerance_is_refused(twice):
    _, now = twice("gate", "runs.csv")
    header, rows = read(now / "runs.csv")
    write(now / "runs.csv", [*header, "novelty"], [[*row, "1"] for row in rows])
    with pytest.raises(ResultsError, match="novelty"):
        compared("gate", now, now)


@pytest.mark.parametrize(
    ("table", "column", "tolerance"),
    [
        ("summary.csv", "regret_worst", 1e-5),
        ("summary.csv", "difference_low", 1e-5),
        ("runs.csv", "J", 0.05),
        ("operation.csv", "dearest", 1e-3),
    ],
)
def test_a_number_may_move_by_its_tolerance_and_no_further(twice, table, column, tolerance):
    stored, now = twice("regression", table)
    header, rows = read(stored / table)
    at = header.index(column)
    row = next(row for row in rows if row[at] and float(row[at]) < 10_000)
    before = float(row[at])
    for factor, number in ((0.5, 0), (3.0, 1)):
        row[at] = repr(before + factor * tolerance)
        write(now / table, header, rows)
        assert len(compared("regression", stored, now)) == number
