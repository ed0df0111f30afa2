"""Logged data: a plant's history from a CSV file, and what of it can be used as transitions.

A transition (s, a, ℓ, s₊) is two rows of the log that are one sampling time apart. A pair of rows
that is no transition, because a value is missing, the clock jumps or a sensor stands still, is
left out and counted. What makes the whole log doubtful is refused: a value that is no number, time
that does not increase, another sampling time or another unit.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import CosimError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.core.validation import assignments, instead, suggestion

Flags = NDArray[np.bool_]
"""One truth value per row, or per pair of consecutive rows."""
TIME = "time"
STAGE_COST = "stage_cost"
"""Names of the columns that are no variable of the plant."""
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Seconds of a unit of time that a header may state."""
DELIMITERS = ",;\t"
CLOCK_TOLERANCE = 0.05
"""Share of the sampling time by which two rows may be off it and still be a transition."""
GAP = 1.5
"""Sampling times from which on the clock has a gap, and is not just irregular."""
FEWEST = 120
"""Fewest transitions from which anything is learned."""
STANDSTILL = 10
"""Rows on a straight line from which on a sensor is taken for frozen, or its value for made up."""
USUAL_STANDSTILL = 10
"""How many times as long as usual such a stretch must be: coarse readings repeat themselves."""
STRAIGHT = 1e-9
"""Share of a value by which it may be off the line: rounding."""
BEYOND = 0.01
"""Share of an actuator's range by which a logged input may exceed it: rounding of the log."""
MOST_BEYOND = 0.2
"""Share of rows with an input beyond its bounds from which on its unit is in doubt."""


class LoggedDataError(CosimError):
    """A file of logged data that cannot be read, or that does not fit the scenario."""


@dataclass(frozen=True)
class LogTable:
    """The rows of a log that are needed, K of them, as they stand in its file.

    Attributes:
        path: of the file, for messages.
        lines: line of each row in the file, (K,).
        time: in s, (K,).
        states: (K, n), NaN where a cell is empty.
        actions: (K, m), likewise.
        stage_cost: (K,), likewise; None where the file has no such column.
        excluded: rows that the user leaves out, (K,).
        repeated: rows that repeated the one before, which are not among the K any more.
    """

    path: str
    lines: NDArray[np.intp]
    time: Array
    states: Array
    actions: Array
    stage_cost: Array | None
    excluded: Flags
    repeated: int = 0


@dataclass(frozen=True)
class LoggedData:
    """The M transitions that a log shows.

    Attributes:
        time: of each transition's first row, in s, (M,).
        states: s, (M, n).
        actions: a, (M, m).
        next_states: s₊, (M, n).
        stage_cost: ℓ, (M,); None where it was not logged.
        follows: whether the transition before ends where this one begins, (M,).
        rows: rows of the file.
        left_out: number of pairs of rows that are no transition, by the reason.
    """

    time: Array
    states: Array
    actions: Array
    next_states: Array
    stage_cost: Array | None
    follows: Flags
    rows: int
    left_out: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.states)

    def latest(self, count: int) -> LoggedData:
        """The same with so many of the latest transitions; the others are counted as older."""
        n_older = len(self) - count
        is_older = np.arange(len(self)) < n_older
        return self.without(is_older, "older than what is used")

    def without(self, doubtful: Flags, reason: str) -> LoggedData:
        """The same without some of the transitions.

        Args:
            doubtful: which of them, (M,).
            reason: under which they are counted.
        """
        if not doubtful.any():
            return self
        kept = ~doubtful
        # A transition follows the one before only where that one is kept, too.
        before_is_kept = np.concatenate([[False], kept[:-1]])
        follows = self.follows & before_is_kept
        return LoggedData(
            self.time[kept],
            self.states[kept],
            self.actions[kept],
            self.next_states[kept],
            None if self.stage_cost is None else self.stage_cost[kept],
            follows[kept],
            self.rows,
            {**self.left_out, reason: int(doubtful.sum())},
        )


def read_logged_data(
    path: str | Path,
    scenario: Scenario,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    leave_out: Sequence[str] = (),
) -> LoggedData:
    """Read a log, and say what of it can be used.

    Args:
        path: of the CSV file, whose header names its columns: `NAME` or `NAME [unit]`.
        scenario: names the variables, and has their bounds and the sampling time.
        columns: the file's name of a column by ours, where they differ: of a state, an action,
            `time` or `stage_cost`; before those of the scenario's table `[log]`.
        units: unit of each variable by name; a column that states another one is refused.
        leave_out: `COLUMN=VALUE` each: rows with that text in that column are left out.

    Raises:
        LoggedDataError: in one line that names file, line and column.
    """
    table = read_log(path, scenario, columns=columns, units=units, leave_out=leave_out)
    return transitions_of(table, scenario)


def read_log(
    path: str | Path,
    scenario: Scenario,
    *,
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    leave_out: Sequence[str] = (),
    given: Sequence[str] | None = None,
) -> LogTable:
    """Read the rows of a log; other arguments and errors are those of `read_logged_data`.

    Args:
        path: of the CSV file.
        scenario: names the variables.
        columns: the file's name of a column by ours.
        units: of the variables.
        leave_out: `COLUMN=VALUE` each.
        given: what is read in place of the states: signals of sensors, `measured[X2]` say.
    """
    file = _File(path)
    states = tuple(given or scenario.plant.states)
    # Our own runs write NaN where a sensor has nothing new.
    missing = ("", "nan") if states != scenario.plant.states else ("",)
    actions = scenario.plant.actions
    names = (TIME, *states, *actions, STAGE_COST)
    for name, title in (columns or {}).items():
        if name not in names:
            raise LoggedDataError(
                f"--column {name}={title}: there is no variable '{name}'{instead(name, names)}"
            )
    # What is asked for goes before what the scenario says.
    of_scenario = scenario.log.columns if scenario.log else {}
    wanted = {**of_scenario, **(columns or {})}
    known_units = dict(units or {})
    for signal, sensor in zip(scenario.measurement_names, scenario.sensors or (), strict=True):
        known_units[signal] = known_units.get(sensor.variable, "")

    def column(name: str, missing: Sequence[str] = ("",)) -> Array:
        position = file.position(wanted.get(name, name), name)
        stated = file.units[position]
        expected = known_units.get(name, "")
        if stated and expected and stated != expected:
            raise LoggedDataError(
                f"'{path}': column '{file.titles[position]}' is in {stated}, and {name} in "
                f"{expected}: convert it, or head it [{expected}] where that is the same"
            )
        return file.numbers(position, missing)

    time = _seconds(file, file.position(wanted.get(TIME, TIME), TIME))
    has_cost = STAGE_COST in wanted or STAGE_COST in file.names
    table = LogTable(
        path=str(path),
        lines=np.arange(2, 2 + len(file.rows)),
        time=time,
        states=np.column_stack([column(name, missing) for name in states]),
        actions=np.column_stack([column(name) for name in actions]),
        stage_cost=column(STAGE_COST) if has_cost else None,
        excluded=_excluded(file, leave_out),
    )
    return _increasing(table)


def transitions_of(table: LogTable, scenario: Scenario) -> LoggedData:
    """The transitions of a log's rows; a pair of rows that is none is counted by one reason.

    Args:
        table: the rows.
        scenario: has bounds and sampling time.

    Raises:
        LoggedDataError: the whole log is doubtful.
    """
    check_sampling_time(table, scenario)
    check_sizes(table, scenario, scenario.plant.states)
    states_missing = _in_any_column(np.isnan(table.states))
    others = [table.actions]
    if table.stage_cost is not None:
        others.append(table.stage_cost[:, None])
    others_missing = _in_any_column(np.isnan(np.column_stack(others)))
    is_beyond = _in_any_column(beyond(table.actions, scenario))
    steps = np.diff(table.time) / scenario.sampling_time

    # Reasons in this order; the first one counts. s₊ is of the second row, all else of the first.
    first = slice(None, -1)
    second = slice(1, None)
    reasons: dict[str, Flags] = {
        "gap in time": steps > GAP,
        "irregular clock": np.abs(steps - 1) > CLOCK_TOLERANCE,
        "by order": table.excluded[first] | table.excluded[second],
        "missing value": states_missing[first] | states_missing[second] | others_missing[first],
    }
    for name, values in zip(scenario.plant.states, table.states.T, strict=True):
        still = standing_still(values)
        reasons[f"{name} frozen or interpolated"] = still[first] | still[second]
    reasons["input beyond its bounds"] = is_beyond[first]

    is_transition = np.ones(len(steps), bool)
    left_out = {}
    if table.repeated:
        left_out["repeated row"] = table.repeated
    for reason, pairs in reasons.items():
        of_this_reason = is_transition & pairs
        if of_this_reason.any():
            left_out[reason] = int(of_this_reason.sum())
        is_transition &= ~pairs

    used = np.flatnonzero(is_transition)
    rows = len(table.time) + table.repeated
    if len(used) < FEWEST:
        words = [f"{count} × {reason}" for reason, count in left_out.items()]
        why = f" (left out: {', '.join(words)})" if words else ""
        raise LoggedDataError(
            f"'{table.path}': {len(used)} transitions of {rows} rows can be used, and {FEWEST} are "
            f"needed{why}"
        )
    follows = np.concatenate([[False], np.diff(used) == 1])
    stage_cost = None if table.stage_cost is None else table.stage_cost[used]
    return LoggedData(
        time=table.time[used],
        states=table.states[used],
        actions=table.actions[used],
        next_states=table.states[used + 1],
        stage_cost=stage_cost,
        follows=follows,
        rows=rows,
        left_out=left_out,
    )


def standing_still(values: Array) -> Flags:
    """Rows at which a reading lies on a straight line for longer than a live sensor's does.

    A frozen sensor repeats its last value; a historian draws a line from one to the next. Noise
    does neither. Of a reading that is coarse, or has no noise at all, short stretches are usual,
    and then count only where they are much longer than those.

    Args:
        values: of one sensor, (K,).

    Returns:
        Flags, (K,).
    """
    bend = values[2:] - 2 * values[1:-1] + values[:-2]
    size = np.abs(values[1:-1])
    is_straight = np.abs(bend) <= STRAIGHT * size
    lengths = _stretches(is_straight)
    # Of most rows: zero where noise bends each of them.
    usual = float(np.median(lengths)) if len(lengths) else 0.0
    least = max(STANDSTILL, USUAL_STANDSTILL * usual)
    inside = lengths >= least
    # A bend belongs to three rows.
    flags = np.zeros(len(values), bool)
    for shift in range(3):
        flags[shift : shift + len(inside)] |= inside
    return flags


def _stretches(flags: Flags) -> NDArray[np.intp]:
    """Of each entry the length of the stretch of true ones that it is in, (K,); 0 outside."""
    padded = np.concatenate([[False], flags, [False]]).astype(np.int8)
    edges = np.diff(padded)
    begins = np.flatnonzero(edges == 1)
    ends = np.flatnonzero(edges == -1)
    lengths = np.zeros(len(flags), np.intp)
    for begin, end in zip(begins, ends, strict=True):
        lengths[begin:end] = end - begin
    return lengths


def _in_any_column(flags: Flags) -> Flags:
    """Rows of (K, n) flags of which one is true, (K,)."""
    rows: Flags = np.logical_or.reduce(flags, axis=1)
    return rows


def beyond(actions: Array, scenario: Scenario) -> Flags:
    """Which actions (K, m) lie outside the actuators' bounds, (K, m)."""
    room = BEYOND * (scenario.action_upper - scenario.action_lower)
    below: Flags = actions < scenario.action_lower - room
    above: Flags = actions > scenario.action_upper + room
    return below | above


def check_sampling_time(table: LogTable, scenario: Scenario) -> None:
    """Refuse a log of another sampling time than the scenario's."""
    if len(table.time) < 2:
        raise LoggedDataError(f"'{table.path}' has {len(table.time)} rows, and two are needed")
    apart = float(np.median(np.diff(table.time)))
    wanted = scenario.sampling_time
    if abs(apart - wanted) > CLOCK_TOLERANCE * wanted:
        raise LoggedDataError(
            f"'{table.path}': rows are {apart:g} s apart, and the samples of scenario "
            f"'{scenario.name}' {wanted:g} s: resample the file, or change sampling_time; a time "
            "without unit is in s"
        )


def check_sizes(table: LogTable, scenario: Scenario, given: Sequence[str]) -> None:
    """Refuse a column whose values cannot be the variable's: of another unit, or another one.

    Args:
        table: the rows.
        scenario: has the bounds.
        given: the variables of which `table.states` has values.
    """
    is_beyond = beyond(table.actions, scenario)
    for i, name in enumerate(scenario.plant.actions):
        share = float(is_beyond[:, i].mean())
        if share > MOST_BEYOND:
            low, high = scenario.limits[name]
            raise LoggedDataError(
                f"'{table.path}': {name} lies outside its actuator's bounds {low:g} … {high:g} in "
                f"{100 * share:.0f} % of the rows: another unit, or another variable?"
            )
    for name, values in zip(given, table.states.T, strict=True):
        known = values[~np.isnan(values)]
        if not len(known):
            raise LoggedDataError(f"'{table.path}': column of {name} is empty")
        # A penalty bounds states, no actuator: only what is far beyond is refused.
        low, high = scenario.limits.get(name, (-np.inf, np.inf))
        middle = float(np.median(known))
        distance = max(low - middle, middle - high)
        if np.isfinite(high - low) and distance > high - low:
            raise LoggedDataError(
                f"'{table.path}': {name} is {middle:g} in the middle, far from its bounds "
                f"{low:g} … {high:g}: another unit, or another variable?"
            )
        moves = not np.all(known == known[0])
        inputs_move = bool((np.nanmin(table.actions, 0) < np.nanmax(table.actions, 0)).any())
        if inputs_move and not moves:
            raise LoggedDataError(
                f"'{table.path}': {name} is {known[0]:g} in every row, while inputs move: its "
                "sensor stood still"
            )


def _increasing(table: LogTable) -> LogTable:
    """The table without rows that only repeat the one before; refuses time that goes back."""
    steps = np.diff(table.time)
    values = [table.time[:, None], table.states, table.actions]
    if table.stage_cost is not None:
        values.append(table.stage_cost[:, None])
    stacked = np.column_stack(values)
    same = (stacked[1:] == stacked[:-1]) | (np.isnan(stacked[1:]) & np.isnan(stacked[:-1]))
    repeats = (steps == 0) & same.all(axis=1)
    wrong = np.flatnonzero((steps <= 0) & ~repeats)
    if len(wrong):
        line = int(table.lines[wrong[0] + 1])
        step = float(steps[wrong[0]])
        if step == 0:
            raise LoggedDataError(
                f"'{table.path}', line {line}: the same time as the row before, with other values"
            )
        hint = ""
        if step > -2 * SECONDS["h"]:
            hint = "; is it the end of summer time? Write UTC, or times with their offset"
        raise LoggedDataError(f"'{table.path}', line {line}: time goes back by {-step:g} s{hint}")
    kept = np.concatenate([[True], ~repeats])
    return LogTable(
        path=table.path,
        lines=table.lines[kept],
        time=table.time[kept],
        states=table.states[kept],
        actions=table.actions[kept],
        stage_cost=None if table.stage_cost is None else table.stage_cost[kept],
        excluded=table.excluded[kept],
        repeated=int(repeats.sum()),
    )


class _File:
    """A CSV file: its titles, and its rows of text.

    Attributes:
        titles: of the columns, as they stand in the header.
        names: the same without units.
        units: of the columns; "" where none is stated.
        rows: texts.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = path
        try:
            with Path(path).open(newline="", encoding="utf-8-sig") as stream:
                header = stream.readline()
                delimiter = max(DELIMITERS, key=header.count)
                self.titles = next(csv.reader([header], delimiter=delimiter), [])
                self.rows = list(csv.reader(stream, delimiter=delimiter))
        except (OSError, UnicodeDecodeError, csv.Error) as cause:
            raise LoggedDataError(f"'{path}' cannot be read: {cause}") from None
        self.names = []
        self.units = []
        for title in self.titles:
            name, bracket, unit = title.strip().partition(" [")
            self.names.append(name.strip())
            self.units.append(unit.removesuffix("]") if bracket else "")
        for number, row in enumerate(self.rows):
            if len(row) != len(self.titles):
                raise LoggedDataError(
                    f"'{path}', line {number + 2}: {len(row)} fields, not {len(self.titles)}"
                )
        if not self.rows:
            raise LoggedDataError(f"'{path}' has no rows below its header")

    def position(self, column: str, name: str = "") -> int:
        """Number of a column.

        Args:
            column: its name in the file, with or without unit.
            name: what it is to us, where that is a variable.
        """
        places = []
        for place, (title, bare) in enumerate(zip(self.titles, self.names, strict=True)):
            if column in (title.strip(), bare):
                places.append(place)
        if len(places) > 1:
            raise LoggedDataError(f"'{self._path}' has two columns '{column}'")
        if not places:
            order = f"; or say --column {name}=COLUMN" if name else ""
            raise LoggedDataError(
                f"'{self._path}' has no column '{column}'{suggestion(column, self.names)}; there "
                f"are {', '.join(self.names)}{order}"
            )
        return places[0]

    def texts(self, position: int) -> list[str]:
        """The cells of a column."""
        return [row[position].strip() for row in self.rows]

    def numbers(self, position: int, missing: Sequence[str] = ("",)) -> Array:
        """The numbers of a column, NaN where one is missing; refuses what is no finite number.

        Args:
            position: number of the column.
            missing: texts of a cell without a value.
        """
        values = np.full(len(self.rows), np.nan)
        for number, text in enumerate(self.texts(position)):
            if text not in missing:
                values[number] = self._number(text, number, position)
        return values

    def _number(self, text: str, number: int, position: int) -> float:
        # Python's float takes digits of any script, and underscores.
        try:
            value = float(text) if text.isascii() and "_" not in text else np.nan
        except ValueError:
            value = np.nan
        if np.isfinite(value):
            return value
        hint = "leave the cell of a missing value empty"
        if "," in text:
            hint = "write a decimal point"
        raise LoggedDataError(
            f"'{self._path}', line {number + 2}, column '{self.titles[position]}': '{text:.30}' is "
            f"no finite number; {hint}"
        )


def _seconds(file: _File, position: int) -> Array:
    """Time of each row in s: numbers in the unit of the header, or dates of ISO 8601."""
    texts = file.texts(position)
    title = file.titles[position]
    if not _is_date(texts[0]):
        unit = file.units[position] or "s"
        if unit not in SECONDS:
            raise LoggedDataError(
                f"'{file._path}': column '{title}' is in {unit}; a time is in "
                f"{', '.join(SECONDS)}, or a date of ISO 8601"
            )
        values = file.numbers(position) * SECONDS[unit]
        missing = np.flatnonzero(np.isnan(values))
        if len(missing):
            raise LoggedDataError(f"'{file._path}', line {missing[0] + 2}: the time is missing")
        return values
    seconds = np.empty(len(texts))
    first: datetime | None = None
    for number, text in enumerate(texts):
        try:
            moment = datetime.fromisoformat(text)
            first = first or moment
            # Fails where one has an offset and the other none.
            seconds[number] = (moment - first).total_seconds()
        except (ValueError, TypeError):
            raise LoggedDataError(
                f"'{file._path}', line {number + 2}, column '{title}': '{text:.30}' is no date of "
                "ISO 8601 like those before, 2024-01-31T12:00:00 say"
            ) from None
    return seconds


def _is_date(text: str) -> bool:
    """Whether a time is a date, and no number like 1e-3."""
    try:
        float(text)
    except ValueError:
        return "-" in text or ":" in text
    return False


def _excluded(file: _File, orders: Sequence[str]) -> Flags:
    """Rows that the user leaves out, (K,), by orders `COLUMN=VALUE`."""
    excluded = np.zeros(len(file.rows), bool)
    for column, value in assignments(orders, "--leave-out", "COLUMN=VALUE", LoggedDataError):
        texts = np.array(file.texts(file.position(column)))
        rows = texts == value
        # An order that acts nowhere is a mistake of its user, who expects it to act.
        if not rows.any():
            raise LoggedDataError(
                f"--leave-out {column}={value}: no row has '{value}' in '{column}'"
            )
        excluded |= rows
    return excluded
