"""Logged readings: a plant's history as its sensors showed it, in stretches without a gap.

What a filter needs is one sample after the other: each action, and of the sensors what came. A row
whose action is missing or doubtful ends a stretch. A reading that is doubtful counts as none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cosim.core.logged_data import (
    CLOCK_TOLERANCE,
    FEWEST,
    GAP,
    Flags,
    LoggedDataError,
    LogTable,
    beyond,
    check_sampling_time,
    check_sizes,
    standing_still,
)
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario

SHORTEST = 60
"""Fewest rows of a stretch: at its begin a filter knows nothing."""


@dataclass(frozen=True)
class LoggedReadings:
    """The M rows of a log that can be used.

    Attributes:
        time: of each row in s, (M,).
        readings: what the sensors showed, NaN where nothing came, (M, n_y).
        actions: a, (M, m).
        stage_cost: ℓ, (M,); None where it was not logged.
        begins: whether a stretch begins at a row, (M,).
        rows: rows of the file.
        left_out: number of rows, or of readings, that are not used, by the reason.
    """

    time: Array
    readings: Array
    actions: Array
    stage_cost: Array | None
    begins: Flags
    rows: int
    left_out: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def stretches(self) -> list[slice]:
        """The rows of each stretch."""
        first = np.flatnonzero(self.begins).tolist()
        return [slice(*ends) for ends in zip(first, [*first[1:], len(self)], strict=True)]

    def latest(self, count: int) -> LoggedReadings:
        """The same with so many of the latest rows; the others are counted as older."""
        n_older = len(self) - count
        if n_older <= 0:
            return self
        begins = self.begins[n_older:].copy()
        begins[0] = True
        return replace(
            self,
            time=self.time[n_older:],
            readings=self.readings[n_older:],
            actions=self.actions[n_older:],
            stage_cost=None if self.stage_cost is None else self.stage_cost[n_older:],
            begins=begins,
            left_out={**self.left_out, "older than what is used": n_older},
        )

    def without_readings(self, doubtful: Flags, reason: str) -> LoggedReadings:
        """The same without some of the readings.

        Args:
            doubtful: which of them, (M, n_y).
            reason: under which they are counted.
        """
        if not doubtful.any():
            return self
        readings = np.where(doubtful, np.nan, self.readings)
        left_out = {**self.left_out, reason: int(doubtful.sum())}
        return replace(self, readings=readings, left_out=left_out)


def readings_of(table: LogTable, scenario: Scenario) -> LoggedReadings:
    """The rows of a log that a filter can follow; each other row is counted by one reason.

    Args:
        table: the rows; its `states` are the readings of the scenario's sensors.
        scenario: has sensors, bounds and sampling time.

    Raises:
        LoggedDataError: the whole log is doubtful, or too little of it is left.
    """
    sensors = scenario.sensors or ()
    check_sampling_time(table, scenario)
    check_sizes(table, scenario, [sensor.variable for sensor in sensors])
    steps = np.diff(table.time) / scenario.sampling_time
    missing = np.isnan(table.actions)
    if table.stage_cost is not None:
        missing = np.column_stack([missing, np.isnan(table.stage_cost)])

    # Reasons in this order; the first one counts.
    reasons = {
        "by order": table.excluded,
        "missing value": missing.any(axis=1),
        "input beyond its bounds": beyond(table.actions, scenario).any(axis=1),
    }
    is_used = np.ones(len(table.time), bool)
    left_out = {}
    if table.repeated:
        left_out["repeated row"] = table.repeated
    for reason, rows in reasons.items():
        of_this_reason = is_used & rows
        if of_this_reason.any():
            left_out[reason] = int(of_this_reason.sum())
        is_used &= ~rows

    # A stretch begins behind a row that is not used, and where the clock jumps.
    jumps = np.abs(steps - 1) > CLOCK_TOLERANCE
    begins = is_used.copy()
    begins[1:] &= jumps | ~is_used[:-1]
    for reason, count in (
        ("gap in time", int((steps > GAP).sum())),
        ("irregular clock", int((jumps & (steps <= GAP)).sum())),
    ):
        if count:
            left_out[f"{reason}, between two rows"] = count
    stretch_of_row = np.cumsum(begins)
    lengths = np.bincount(stretch_of_row, weights=is_used)
    is_short = is_used & (lengths[stretch_of_row] < SHORTEST)
    if is_short.any():
        left_out[f"stretch of fewer than {SHORTEST} rows"] = int(is_short.sum())
    used = np.flatnonzero(is_used & ~is_short)
    rows_of_file = len(table.time) + table.repeated
    if len(used) < FEWEST:
        words = [f"{count} × {reason}" for reason, count in left_out.items()]
        why = f" (left out: {', '.join(words)})" if words else ""
        raise LoggedDataError(
            f"'{table.path}': {len(used)} of {rows_of_file} rows can be used, and {FEWEST} are "
            f"needed{why}"
        )
    log = LoggedReadings(
        time=table.time[used],
        readings=table.states[used],
        actions=table.actions[used],
        stage_cost=None if table.stage_cost is None else table.stage_cost[used],
        begins=begins[used],
        rows=rows_of_file,
        left_out=left_out,
    )
    for i, sensor in enumerate(sensors):
        doubtful = np.zeros(log.readings.shape, bool)
        arrived = np.flatnonzero(~np.isnan(log.readings[:, i]))
        doubtful[arrived, i] = standing_still(log.readings[arrived, i])
        log = log.without_readings(doubtful, f"{sensor.variable} frozen or interpolated")
        # What was read before a stretch begins says nothing of its states.
        early = np.zeros(log.readings.shape, bool)
        for stretch in log.stretches:
            early[stretch, i][: sensor.delay] = True
        early &= ~np.isnan(log.readings)
        log = log.without_readings(early, f"{sensor.variable} read before a gap")
    return log
