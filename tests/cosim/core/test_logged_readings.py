"""Logged readings: which rows and which readings a filter gets, and which are counted."""

from dataclasses import replace

import numpy as np
import pytest

from cosim import Scenario
from cosim.core.logged_data import LoggedDataError, LogTable, read_log
from cosim.core.logged_readings import SHORTEST, readings_of

ROWS = 400


@pytest.fixture(scope="module")
def assay():
    return Scenario.load("assay")


@pytest.fixture
def table(rng):
    """A log of `assay`: X2 at each 15th row, P2 at each."""
    composition = np.full(ROWS, np.nan)
    composition[::15] = rng.normal(27.0, 1.0, len(composition[::15]))
    pressure = rng.normal(50.0, 1.0, ROWS)
    return LogTable(
        path="log.csv",
        lines=np.arange(2, ROWS + 2),
        time=60.0 * np.arange(ROWS),
        states=np.column_stack([composition, pressure]),
        actions=rng.normal([200.0, 220.0], 5.0, (ROWS, 2)),
        stage_cost=None,
        excluded=np.zeros(ROWS, bool),
    )


def test_what_has_not_come_is_no_gap(table, assay):
    log = readings_of(table, assay)
    assert len(log) == ROWS
    assert log.left_out == {}
    assert log.stretches == [slice(0, ROWS)]
    assert np.array_equal(log.readings, table.states, equal_nan=True)


def test_a_row_without_its_input_ends_a_stretch(table, assay):
    table.actions[100, 0] = np.nan
    table.actions[130, 0] = 1e4
    log = readings_of(table, assay)
    assert log.left_out == {
        "missing value": 1,
        "input beyond its bounds": 1,
        f"stretch of fewer than {SHORTEST} rows": 29,
    }
    assert log.stretches == [slice(0, 100), slice(100, len(log))]
    assert np.array_equal(log.actions[100], table.actions[131])


def test_a_gap_in_time_begins_a_stretch(table, assay):
    table.time[200:] += 3600.0
    log = readings_of(table, assay)
    assert log.left_out == {"gap in time, between two rows": 1}
    assert log.stretches == [slice(0, 200), slice(200, ROWS)]


def test_a_sensor_that_stands_still_is_not_read(table, assay):
    table.states[50:90, 1] = table.states[50, 1]
    log = readings_of(table, assay)
    assert log.left_out == {"P2 frozen or interpolated": 40}
    assert np.isnan(log.readings[50:90, 1]).all()
    assert len(log) == ROWS


def test_a_late_reading_behind_a_gap_is_of_before_it(table):
    late = Scenario.load("late")
    table.time[200:] += 3600.0
    table.states[:, 0] = 27.0 + 0.1 * np.sin(np.arange(ROWS) ** 2)
    log = readings_of(table, late)
    assert log.left_out["X2 read before a gap"] == 30
    assert np.isnan(log.readings[200:215, 0]).all()
    assert not np.isnan(log.readings[215:, 0]).any()


def test_the_latest_rows_begin_a_stretch(table, assay):
    log = readings_of(table, assay).latest(150)
    assert len(log) == 150
    assert log.stretches == [slice(0, 150)]
    assert log.left_out == {"older than what is used": 250}


def test_too_little_is_refused(table, assay):
    table.actions[::50] = np.nan
    with pytest.raises(LoggedDataError, match=r"0 of 400 rows can be used, .* 8 × missing value"):
        readings_of(table, assay)


def test_a_reading_in_another_unit_is_refused(table, assay):
    in_pascal = replace(table, states=table.states * [1.0, 1000.0])
    with pytest.raises(LoggedDataError, match=r"P2 is .* far from its bounds"):
        readings_of(in_pascal, assay)


def test_a_column_that_states_another_unit_is_refused(tmp_path, assay):
    file = tmp_path / "log.csv"
    file.write_text("time,measured[X2] [%],measured[P2] [bar],P100,F200\n0,27,0.5,200,220\n")
    units = {"X2": "%", "P2": "kPa"}
    with pytest.raises(LoggedDataError, match=r"is in bar, and measured\[P2\] in kPa"):
        read_log(file, assay, units=units, given=assay.measurement_names)
