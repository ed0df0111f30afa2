"""Shadow operation: what a controller would have done at each row of a log.

The controller gets what was measured, and what was applied is what the log says: its own proposals
are written down and go nowhere. So a plant's owner sees a controller beside the present one before
it may touch anything.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.core.errors import CosimError
from cosim.core.logged_data import GAP, LoggedDataError, LogTable, check_sampling_time
from cosim.core.protocols import Array, Controller, Step
from cosim.core.result import Result, csv_text
from cosim.core.scenario import Scenario
from cosim.core.simulation import ClosedLoop, controller_name
from cosim.core.trajectory import FALLBACK, RunSignals, Signal
from fmus.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AT_BOUND = 1e-6
"""Share of an actuator's range from a bound within which an action counts as at it."""


@dataclass(frozen=True, repr=False)
class Shadow(Result):
    """A controller in the shadow of a log, at K of its rows.

    Attributes:
        scenario: what the controller was made for.
        controller: its name.
        time: of each row in s, (K,).
        given: what it was given, (K, n); by the names of `given_names`.
        given_names: of the states, or of the sensors' signals.
        logged: actions that were applied, (K, m).
        proposed: actions that it would have applied, (K, m).
        status: a word for each row, `fallback` where it failed.
        rows: rows of the file.
        starts: times that the controller began anew: at first, and after each gap.
        left_out: number of rows that it was not asked about, by the reason.
    """

    scenario: Scenario
    controller: str
    time: Array
    given: Array
    given_names: tuple[str, ...]
    logged: Array
    proposed: Array
    status: tuple[str, ...]
    rows: int
    starts: int
    left_out: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.time)

    def _facts(self) -> dict[str, object]:
        summary = self.summary()
        names = ("scenario", "controller", "samples", "failures")
        return {name: summary[name] for name in names}

    @property
    def actions(self) -> dict[str, dict[str, float]]:
        """Of each action how far the proposals are from what was applied.

        `mean_difference`, `mean_distance` and `largest_distance` in the action's unit, with the
        time of the last in s; and the share of the rows at a bound, of the proposals and the log.
        """
        lower = self.scenario.action_lower
        upper = self.scenario.action_upper
        near = AT_BOUND * (upper - lower)
        table = {}
        for i, name in enumerate(self.scenario.plant.actions):
            difference = self.proposed[:, i] - self.logged[:, i]
            distance = np.abs(difference)
            farthest = int(np.argmax(distance))
            shares = []
            for values in (self.proposed[:, i], self.logged[:, i]):
                at_bound = (values <= lower[i] + near[i]) | (values >= upper[i] - near[i])
                shares.append(float(at_bound.mean()))
            table[name] = {
                "mean_difference": float(difference.mean()),
                "mean_distance": float(distance.mean()),
                "largest_distance": float(distance[farthest]),
                "largest_at": float(self.time[farthest]),
                "share_at_bound": shares[0],
                "logged_share_at_bound": shares[1],
            }
        return table

    def summary(self) -> dict[str, Any]:
        """The shadow as a JSON document."""
        return {
            "scenario": self.scenario.name,
            "scenario_hash": self.scenario.hash,
            "controller": self.controller,
            "rows": self.rows,
            "samples": len(self),
            "starts": self.starts,
            "left_out": dict(self.left_out),
            "failures": sum(word == FALLBACK for word in self.status),
            "statuses": dict(sorted(Counter(self.status).items())),
            "actions": self.actions,
        }

    def to_csv(self) -> str:
        """Time, what was given, each action as logged and as proposed, and the status."""
        header = ["time [s]", *self.given_names]
        columns = [self.time, *self.given.T]
        for i, name in enumerate(self.scenario.plant.actions):
            header += [name, f"proposed[{name}]"]
            columns += [self.logged[:, i], self.proposed[:, i]]
        header.append("status")
        return csv_text(header, self._texts(columns))

    def _texts(self, columns: list[Array]) -> Iterator[list[str]]:
        table = np.column_stack(columns).tolist()
        for numbers, word in zip(table, self.status, strict=True):
            yield [*map(repr, numbers), word]

    def write_csv(self, path: str | Path) -> Path:
        """Write `to_csv` to a file, whole or not at all."""
        return write_atomically(path, self.to_csv())

    def runs(self) -> dict[str, RunSignals]:
        """The log and the controller as two runs, for a recording of one over the other."""
        return {
            "logged": self._run("logged", self.logged),
            self.controller: self._run(self.controller, self.proposed),
        }

    def _run(self, name: str, actions: Array) -> RunSignals:
        """Run of the given name: the logged inputs with these actions, (K, m)."""
        signals = {"time": Signal("time", "s", self.time)}
        for i, given in enumerate(self.given_names):
            signals[given] = Signal(given, "", self.given[:, i])
        for i, action in enumerate(self.scenario.plant.actions):
            signals[action] = Signal(action, "", actions[:, i])
        return RunSignals(name, signals, self.status, self.scenario.limits)

    def figure(self) -> Figure:
        """Each action as logged and as proposed over time, above what the controller was given."""
        from cosim.figures.shadow import shadow_figure  # noqa: PLC0415 - matplotlib

        return shadow_figure(self)


def given_names(controller: Controller, scenario: Scenario) -> tuple[str, ...]:
    """Names of the log's columns that a controller is given: states, or sensors' signals."""
    takes_measurements = getattr(controller, "given", "state") == "measurement"
    if scenario.sensors and takes_measurements:
        return scenario.measurement_names
    return scenario.plant.states


def shadow(controller: Controller, table: LogTable, scenario: Scenario) -> Shadow:
    """Ask a controller at each row of a log what it would do.

    Rows without a value that it needs, and those that the user leaves out, are not asked about.
    After a gap, or such a row, the controller begins anew; it is told which actions were applied.

    Args:
        controller: the feedback law.
        table: rows of the log; its states are what `given_names` says.
        scenario: has sampling time and actuators' bounds.

    Raises:
        CosimError: the scenario has signals, which a log does not hold.
        LoggedDataError: another sampling time, or no row is left.
    """
    if scenario.signals:
        raise CosimError(
            f"scenario '{scenario.name}' has signals, which a log does not hold: shadow on the "
            "same scenario without [[signal]]"
        )
    check_sampling_time(table, scenario)
    names = given_names(controller, scenario)
    is_measured = names != scenario.plant.states
    missing_action = np.isnan(table.actions).any(axis=1)
    # Of sensors nothing new is no missing value.
    missing_given = np.isnan(table.states).any(axis=1) & (not is_measured)
    is_missing = missing_action | missing_given
    used = np.flatnonzero(~(table.excluded | is_missing))
    left_out = {}
    for reason, count in (
        ("repeated row", table.repeated),
        ("by order", int(table.excluded.sum())),
        ("missing value", int((is_missing & ~table.excluded).sum())),
    ):
        if count:
            left_out[reason] = count
    if not len(used):
        raise LoggedDataError(f"'{table.path}': no row is left to ask the controller about")

    proposed = np.empty((len(used), scenario.action_lower.size))
    status = []
    n_starts = 0
    row_before = -1
    loop = ClosedLoop(_following(table, used, is_measured), controller, scenario)
    unknown_state = np.full(len(scenario.plant.states), np.nan)
    for place, row in enumerate(used.tolist()):
        apart = (table.time[row] - table.time[row_before]) / scenario.sampling_time
        if place == 0 or row != row_before + 1 or apart > GAP:
            given = table.states[row].copy()
            if is_measured:
                loop.start(unknown_state.copy(), given)
            else:
                loop.start(given)
            n_starts += 1
        loop.solve()
        solution = loop.solution
        proposed[place] = loop.action()
        status.append(FALLBACK if solution is None else solution.status)
        # What the plant got is what the log says.
        loop.step(table.actions[row].copy())
        row_before = row
    return Shadow(
        scenario=scenario,
        controller=controller_name(controller),
        time=table.time[used],
        given=table.states[used],
        given_names=names,
        logged=table.actions[used],
        proposed=proposed,
        status=tuple(status),
        rows=len(table.time) + table.repeated,
        starts=n_starts,
        left_out=left_out,
    )


def _following(table: LogTable, used: Any, is_measured: bool) -> Any:
    """A plant's `step` whose next state, or reading, is that of the next row that is used."""
    unknown = np.empty(0)
    rows = [*used[1:].tolist(), int(used[-1])]
    places = iter(rows)

    def step(a: Array) -> Step:
        following = table.states[next(places)].copy()
        if is_measured:
            return Step(unknown.copy(), np.nan, np.nan, unknown, following)
        return Step(following, np.nan, np.nan, unknown)

    return step
