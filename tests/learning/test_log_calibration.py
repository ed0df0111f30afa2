"""The calibration's table: what counts as an interval, and in which order logs are judged."""

import numpy as np
import pytest

from benchmarks import logged_data

NAMES = ("less_start", "less_log")


def row(low, high, verdict="cannot tell"):
    """A row whose true differences are zero, with one interval for both."""
    numbers = {"J": 1.0, "J_optimal": 1.0}
    for name in NAMES:
        numbers[f"{name}_low"] = low
        numbers[f"{name}_high"] = high
        for end in ("", "_low", "_high"):
            numbers[f"true_{name}{end}"] = 0.0
    return {"regime": "pi", "verdict": verdict, **numbers}


def cells(rows):
    """Cells of the line for all."""
    line = logged_data.table(rows).splitlines()[-1]
    return [cell.strip() for cell in line.split("|")[1:-1]]


def test_a_refused_log_is_counted_and_is_in_no_share():
    rows = [row(-1.0, 1.0), row(1.0, 2.0), row(np.nan, np.nan, "refused")]
    assert cells(rows)[:6] == ["`all`", "3", "1", "4", "50.0 %", "50.0 %"]


def test_an_interval_without_ends_does_not_count_as_one_that_holds():
    rows = [row(1.0, 2.0), row(-np.inf, np.inf)]
    assert cells(rows)[3:5] == ["2", "0.0 %"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_logs_are_judged_seed_by_seed_and_once(tmp_path, monkeypatch, jobs):
    monkeypatch.setattr(logged_data, "row_of", named_row)
    path = tmp_path / "logs.csv"
    for seeds in (range(1), range(2)):
        logged_data.calibrate("rule", ["b", "a"], ["pi"], seeds, path, jobs)
    judged = [(row["plant"], row["seed"]) for row in logged_data.rows_of(path)]
    assert judged == [("b", 0), ("a", 0), ("b", 1), ("a", 1)]


def named_row(algorithm, name, regime, seed):
    """A row without a plant."""
    numbers = [0.0] * (len(logged_data.COLUMNS) - 6)
    return [name, regime, seed, 0, "refused", algorithm, *numbers]
