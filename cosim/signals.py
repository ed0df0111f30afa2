"""The signals of a sample, declared once: simulation, CSV, recording, readers and units follow.

To add a signal, add a line to `SIGNALS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import nan
from operator import attrgetter
from typing import Literal

import numpy as np

from cosim.protocols import Array, Solution, Step
from cosim.scenario import Scenario

Group = Literal["states", "actions", "disturbances", "costs", "step_time", "unseen"]
COST = "unit of the stage cost"
RESIDUAL = "solution.residual"
Derived = Callable[[Scenario, Mapping[str, Array]], Array]
"""K values of a signal, (K,), from a scenario and K values of each signal declared before it."""


class NoSolution:
    """Stands where the controller failed: whatever a signal asks of it is NaN."""

    def __getattr__(self, name: str) -> float:
        """NaN."""
        return nan


NO_SOLUTION = NoSolution()


@dataclass(slots=True)
class Sample:
    """What the loop knows of a sample once the plant has stepped.

    `time` in s, the measured state `s` (n,), the applied `action` (m,), the plant's `step`, the
    controller's `solution`, whether the controller `failed`, and what the clock said:
    `prepare_time`, `feedback_time`, `plant_time` in s.
    """

    time: float
    s: Array
    action: Array
    step: Step
    solution: Solution | NoSolution
    failed: bool
    prepare_time: float
    feedback_time: float
    plant_time: float


@dataclass(frozen=True)
class SignalKind:
    """A declared signal: its `name`, what it is `of`, its `unit`.

    `of` is an attribute of a `Sample`, read at every sample, or a function of other signals. A
    `vector` is a signal per variable that the scenario's plant names under `name`, in the
    variable's unit; its attribute then holds all of them. `group` is where a recording shows it,
    None if it is not recorded; `whole` marks 0 or 1, `clock` what a clock measured, which stays out
    of the trajectory's file.
    """

    name: str
    of: str | Derived
    unit: str = ""
    group: Group | None = "unseen"
    vector: bool = False
    whole: bool = False
    clock: bool = False

    def names(self, scenario: Scenario) -> tuple[str, ...]:
        """Names of the signals, one but for a vector."""
        return getattr(scenario.plant, self.name) if self.vector else (self.name,)

    def units(self, scenario: Scenario, known: Mapping[str, str]) -> tuple[str, ...]:
        """Unit of each; `known` maps FMU variables to theirs, and one not known is left empty."""
        if self.vector:
            return tuple(known.get(name, "") for name in self.names(scenario))
        return (known.get(scenario.plant.stage_cost, "") if self.unit == COST else self.unit,)


def _violation(scenario: Scenario, columns: Mapping[str, Array]) -> Array:
    total: Array = scenario.state_penalty.violation(columns["states"]).sum(axis=1)
    return total


SIGNALS: tuple[SignalKind, ...] = (
    SignalKind("time", "time", "s"),
    SignalKind("states", "s", group="states", vector=True),
    SignalKind("actions", "action", group="actions", vector=True),
    SignalKind("disturbances", "step.disturbance", group="disturbances", vector=True),
    SignalKind("stage_cost", "step.stage_cost", COST, "costs"),
    SignalKind("penalty", "step.penalty", COST, "costs"),
    SignalKind("violation", _violation),
    SignalKind("value", "solution.value", COST),
    SignalKind("residual", RESIDUAL),
    SignalKind("explored", lambda scenario, columns: np.zeros_like(columns["time"]), whole=True),
    SignalKind("failed", "failed", whole=True),
    SignalKind("prepare_time", "prepare_time", "s", "step_time", clock=True),
    SignalKind("feedback_time", "feedback_time", "s", "step_time", clock=True),
    SignalKind("plant_time", "plant_time", "s", None, clock=True),
)


def signal_names(scenario: Scenario) -> list[str]:
    """Names of a run's signals, in the order of the CSV's columns."""
    return [name for kind in SIGNALS if not kind.clock for name in kind.names(scenario)]


def clocked() -> frozenset[str]:
    """Names of the signals that a clock measured: two equal runs differ in them."""
    return frozenset(kind.name for kind in SIGNALS if kind.clock)


def whole() -> frozenset[str]:
    """Names of the signals that are 0 or 1."""
    return frozenset(kind.name for kind in SIGNALS if kind.whole)


class SignalColumns:
    """Every declared signal of a run, read sample by sample and stored by blocks, as `columns`.

    Without `residuals` their column is NaN.
    """

    def __init__(self, scenario: Scenario, steps: int, residuals: bool) -> None:
        unwanted = () if residuals else (RESIDUAL,)
        self._unwanted = {kind.name for kind in SIGNALS if kind.of in unwanted}
        read = {kind: kind.of for kind in SIGNALS if isinstance(kind.of, str)}
        scalars = {k: of for k, of in read.items() if not k.vector and of not in unwanted}
        vectors = {kind: of for kind, of in read.items() if kind.vector}
        # Of all scalars, and of all vectors, one call a sample.
        self._scalars, self._vectors = attrgetter(*scalars.values()), attrgetter(*vectors.values())
        self._derived = {k.name: k.of for k in SIGNALS if not isinstance(k.of, str)}
        self._rows: list[list[float]] = []
        self._scenario = scenario
        stored = [*scalars, *vectors]
        stored += [kind for kind in SIGNALS if kind not in stored]
        widths = [len(kind.names(scenario)) for kind in stored]
        # Column-major, so that a signal is a column and not a copy of one.
        self._table = np.full((steps, sum(widths)), nan, order="F")
        parts = np.split(self._table, np.cumsum(widths)[:-1], axis=1)
        self.columns: dict[str, Array] = {
            kind.name: part if kind.vector else part[:, 0]
            for kind, part in zip(stored, parts, strict=True)
        }

    def read(self, sample: Sample) -> None:
        """Take the values of a sample, since neither plant nor controller need keep theirs."""
        row = list(self._scalars(sample))
        for values in self._vectors(sample):
            row += values.tolist()
        self._rows.append(row)

    def fill(self, first: int, values: Mapping[str, Array]) -> None:
        """Store what somebody else has sampled, by name, from sample number `first` on."""
        where = slice(first, first + len(values["time"]))
        for name, column in self.columns.items():
            if name in values and name not in self._unwanted:
                column[where] = values[name]
        self._derive(where)

    def store(self, first: int) -> dict[str, Array]:
        """Store what was read, from sample number `first` on, and return it by name."""
        where = slice(first, first + len(self._rows))
        self._table[where, : len(self._rows[0])] = self._rows
        self._rows.clear()
        return self._derive(where)

    def _derive(self, where: slice) -> dict[str, Array]:
        """Compute what follows from the stored samples `where`; return all of them by name."""
        stored = {name: column[where] for name, column in self.columns.items()}
        for name, derive in self._derived.items():
            stored[name][:] = derive(self._scenario, stored)
        return stored
