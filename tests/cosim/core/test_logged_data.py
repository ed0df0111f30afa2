"""Logged data: what is used, what is left out and counted, and what is refused."""

from collections import Counter
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim import FmuPlant, build_controller, simulate
from cosim.core.errors import ScenarioError
from cosim.core.logged_data import LoggedDataError, read_logged_data, standing_still

UNITS = {"X2": "%", "P2": "kPa", "P100": "kPa", "F200": "kg/min"}
ROWS = 200


def log(rng, rows=ROWS):
    """A log by column: noise about a steady state, one row a minute."""
    about = {"X2": (27.0, 0.5), "P2": (50.0, 1.0), "P100": (200.0, 5.0), "F200": (220.0, 5.0)}
    columns = {"time": 60.0 * np.arange(rows)}
    for name, (middle, deviation) in about.items():
        columns[name] = rng.normal(middle, deviation, rows)
    columns["stage_cost"] = rng.normal(6000.0, 100.0, rows)
    return columns


def write(path, columns, titles=None):
    """A CSV file of columns; a NaN is an empty cell."""
    titles = titles or {}
    lines = [",".join(titles.get(name, name) for name in columns)]
    for row in zip(*columns.values(), strict=True):
        cells = []
        for value in row:
            text = str(value)
            cells.append("" if text == "nan" and isinstance(value, float) else text)
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


@pytest.fixture
def columns(rng):
    return log(rng)


@pytest.fixture
def read(tmp_path, paper):
    def reader(table, titles=None, **options):
        path = write(tmp_path / "log.csv", table, titles)
        return read_logged_data(path, paper, units=UNITS, **options)

    return reader


def test_a_run_of_ours_is_accepted_as_it_is(tmp_path, paper):
    with FmuPlant(paper) as plant:
        run = simulate(plant, build_controller("pi", paper), 300, 0)
        units = plant.units
    data = read_logged_data(run.write_csv(tmp_path / "run.csv"), paper, units=units)
    assert len(data) == 299
    assert data.left_out == {}
    assert np.array_equal(data.states, run.states[:-1])
    assert np.array_equal(data.next_states, run.states[1:])
    assert np.array_equal(data.actions, run.actions[:-1])
    assert np.array_equal(data.stage_cost, run["stage_cost"][:-1])


def test_the_order_of_columns_does_not_count(columns, read):
    straight = read(columns)
    reversed_columns = dict(reversed(columns.items()))
    turned = read(reversed_columns)
    assert np.array_equal(straight.states, turned.states)
    assert np.array_equal(straight.actions, turned.actions)


def test_columns_of_other_names_are_mapped(columns, read):
    renamed = {"PI-101" if name == "P2" else name: values for name, values in columns.items()}
    assert np.array_equal(read(renamed, columns={"P2": "PI-101"}).states, read(columns).states)


def test_the_scenario_may_name_the_columns(columns, tmp_path, paper):
    named = paper.replace({"log": {"columns": {"P2": "PI-101", "X2": "AI-7"}}})
    assert named.hash == paper.hash
    path = write(tmp_path / "log.csv", columns, {"P2": "PI-101", "X2": "AI-7"})
    assert np.array_equal(read_logged_data(path, named).states[:, 1], columns["P2"][:-1])
    # What is asked for goes before it.
    path = write(tmp_path / "log.csv", columns, {"P2": "PI-101", "X2": "AI-8"})
    data = read_logged_data(path, named, columns={"X2": "AI-8"})
    assert np.array_equal(data.states[:, 0], columns["X2"][:-1])


def test_a_scenario_that_names_a_column_of_nothing_is_refused(paper):
    with pytest.raises(ScenarioError, match=r"log\.columns: there is no variable 'P3'"):
        paper.replace({"log": {"columns": {"P3": "PI-101"}}})


def test_a_gap_is_no_transition(columns, read):
    columns["time"][100:] += 3600.0
    data = read(columns)
    assert data.left_out == {"gap in time": 1}
    assert 99 * 60.0 not in data.time
    assert np.flatnonzero(~data.follows).tolist() == [0, 99]


def test_an_irregular_clock_loses_its_pairs_only(columns, read):
    columns["time"][100] += 20.0
    assert read(columns).left_out == {"irregular clock": 2}


def test_a_clock_that_drifts_within_its_tolerance_is_used(columns, read, rng):
    columns["time"] += rng.uniform(-1.0, 1.0, ROWS)
    assert read(columns).left_out == {}


def test_a_missing_value_takes_the_pairs_that_it_is_in(columns, read):
    columns["X2"][50] = np.nan
    columns["P100"][80] = np.nan
    assert read(columns).left_out == {"missing value": 3}


@pytest.mark.parametrize("slope", [0.0, 0.01])
def test_a_frozen_or_interpolated_sensor_is_left_out(columns, read, slope):
    columns["P2"][60:90] = 50.0 + slope * np.arange(30)
    data = read(columns)
    assert data.left_out == {"P2 frozen or interpolated": 31}
    assert not ((data.time >= 59 * 60.0) & (data.time < 90 * 60.0)).any()


def test_a_coarse_reading_is_not_frozen(rng):
    slow = np.cumsum(rng.normal(0.0, 0.03, 2000))
    assert not standing_still(np.round(slow, 1)).any()


def test_a_frozen_stretch_of_a_coarse_reading_is_found(rng):
    coarse = np.round(rng.normal(50.0, 0.3, 2000), 1)
    coarse[500:600] = 50.0
    flags = standing_still(coarse)
    assert flags[500:600].all()
    assert flags.sum() <= 104


def test_a_plant_without_noise_is_not_frozen():
    assert not standing_still(np.full(500, 3.0)).any()


def test_a_row_twice_counts_once(columns, read):
    doubled = {name: np.insert(values, 70, values[70]) for name, values in columns.items()}
    data = read(doubled)
    assert data.left_out == {"repeated row": 1}
    assert np.array_equal(data.states, read(columns).states)


def test_manual_periods_are_left_out_by_order(columns, read):
    columns["mode"] = np.where(np.arange(ROWS) // 10 == 3, "MAN", "AUTO")
    assert read(columns, leave_out=["mode=MAN"]).left_out == {"by order": 11}


def test_an_input_beyond_its_actuator_is_left_out(columns, read):
    columns["P100"][20:25] = 0.0
    assert read(columns).left_out == {"input beyond its bounds": 5}


def test_dates_with_their_offset_survive_the_end_of_summer_time(columns, read):
    begin = datetime(2024, 10, 27, 0, 0, tzinfo=UTC)
    columns["time"] = [(begin + timedelta(minutes=k)).isoformat() for k in range(ROWS)]
    local = columns | {"time": [text.replace("+00:00", "Z") for text in columns["time"]]}
    assert len(read(columns)) == len(read(local)) == ROWS - 1


def local_dates(begin, jump):
    """Dates without an offset whose clock jumps by so many hours at the middle."""
    dates = [begin + timedelta(minutes=k) for k in range(ROWS)]
    return [(date + timedelta(hours=jump * (k >= 100))).isoformat() for k, date in enumerate(dates)]


def test_the_begin_of_summer_time_is_a_gap(columns, read):
    columns["time"] = local_dates(datetime(2024, 3, 31, 1, 0), 1)
    assert read(columns).left_out == {"gap in time": 1}


def test_minutes_are_converted(columns, read):
    minutes = columns | {"time": columns["time"] / 60.0}
    data = read(minutes, {"time": "time [min]"})
    assert np.array_equal(data.time, columns["time"][:-1])


def test_without_a_cost_there_is_none(columns, read):
    del columns["stage_cost"]
    assert read(columns).stage_cost is None


REFUSED = {
    "column": (lambda c: c.pop("P2"), {}, "no column 'P2'"),
    "nan": (lambda c: c.update(P2=["nan", *c["P2"][1:]]), {}, "line 2, column 'P2': 'nan'"),
    "text": (lambda c: c.update(P2=[*c["P2"][1:], "bad"]), {}, "line 201, column 'P2': 'bad'"),
    "back": (lambda c: c["time"].__setitem__(9, 0.0), {}, "line 11: time goes back"),
    "twice": (lambda c: c["time"].__setitem__(9, 480.0), {}, "line 11: the same time"),
    "sampling time": (lambda c: c["time"].__imul__(0.5), {}, "30 s apart"),
    "few rows": (lambda c: c.update({k: v[:50] for k, v in c.items()}), {}, "49 transitions of 50"),
    "unit": (lambda c: None, {"P2": "P2 [bar]"}, "is in bar, and P2 in kPa"),
    "size": (lambda c: c["P100"].__imul__(0.01), {}, "P100 lies outside its actuator's bounds"),
    "state": (lambda c: c["P2"].__imul__(100.0), {}, "P2 is 5"),
    "frozen": (lambda c: c["P2"].__setitem__(slice(None), 50.0), {}, "P2 is 50 in every row"),
    "two": (lambda c: None, {"stage_cost": "P2"}, "two columns 'P2'"),
    "time unit": (lambda c: None, {"time": "time [ms]"}, "is in ms"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_bad_file_is_refused_in_one_line(columns, read, case):
    spoil, titles, words = REFUSED[case]
    spoil(columns)
    with pytest.raises(LoggedDataError, match=words) as caught:
        read(columns, titles)
    assert "\n" not in str(caught.value)


def test_the_end_of_summer_time_without_offsets_is_refused(columns, read):
    columns["time"] = local_dates(datetime(2024, 10, 27, 1, 30), -1)
    with pytest.raises(LoggedDataError, match="line 102: time goes back by 3540 s; is it the end"):
        read(columns)


@pytest.mark.parametrize("order", [{"columns": {"P3": "x"}}, {"leave_out": ["mode=MAN"]}])
def test_an_order_that_leads_nowhere_is_refused(columns, read, order):
    with pytest.raises(LoggedDataError, match=r"P3|mode"):
        read(columns, **order)


spoiled = st.lists(
    st.tuples(st.integers(1, ROWS - 2), st.sampled_from(["gap", "missing", "late", "twice"])),
    max_size=12,
    unique_by=lambda fault: fault[0],
)


@settings(max_examples=12, deadline=None)
@given(faults=spoiled)
def test_each_pair_of_rows_is_used_or_counted_once(tmp_path_factory, paper, faults):
    columns = log(np.random.default_rng(0))
    for row, kind in faults:
        if kind == "gap":
            columns["time"][row:] += 600.0
        elif kind == "missing":
            columns["X2"][row] = np.nan
        elif kind == "late":
            columns["time"][row] += 20.0
    for row in sorted((row for row, kind in faults if kind == "twice"), reverse=True):
        columns = {name: np.insert(values, row, values[row]) for name, values in columns.items()}
    path = write(tmp_path_factory.mktemp("log") / "log.csv", columns)
    data = read_logged_data(path, paper)
    assert len(data) + sum(data.left_out.values()) == data.rows - 1
    # No transition joins what is not one sampling time apart.
    position = {time: row for row, time in enumerate(columns["time"])}
    for time, next_state in zip(data.time, data.next_states, strict=True):
        followers = columns["time"][columns["time"] > time]
        after = followers.min()
        assert abs(after - time - 60.0) < 3.1
        assert np.array_equal(next_state, [columns[name][position[after]] for name in ("X2", "P2")])
    kinds = Counter(kind for _, kind in faults)
    assert data.left_out.get("repeated row", 0) == kinds["twice"]
