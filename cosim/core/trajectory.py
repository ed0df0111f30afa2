"""A run's record: a sample's signals, declared once, with units; the clock's readings apart."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cosim.core.errors import TrajectoryError
from cosim.core.files import replacing
from cosim.core.protocols import Array
from cosim.core.result import Result, csv_text
from cosim.core.scenario import VIOLATING, Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Group = Literal["states", "actions", "disturbances", "costs", "step_time", "unseen"]
COST = "unit of the stage cost"
Derived = Callable[[Scenario, Mapping[str, Array]], Array]
"""K values of a signal, (K,), from a scenario and K values of each signal declared before it."""


@dataclass(frozen=True)
class SignalKind:
    """A declared signal: its `name`, the function `of` other signals that it is, its `unit`.

    What the loop measures is no such function. A `vector` has a signal for each variable that the
    scenario's plant names under `name`, in the variable's unit. `group` is where a recording shows
    it, None: nowhere; `whole` marks 0 or 1, `clock` wall-clock times, which the trajectory's file
    leaves out.
    """

    name: str
    of: Derived | None = None
    unit: str = ""
    group: Group | None = "unseen"
    vector: bool = False
    whole: bool = False
    clock: bool = False

    def names(self, scenario: Scenario) -> tuple[str, ...]:
        """Names of the signals, one but for a vector."""
        return getattr(scenario.plant, self.name) if self.vector else (self.name,)

    def units(self, scenario: Scenario, known: Mapping[str, str]) -> dict[str, str]:
        """Unit of each by name; `known` maps FMU variables to theirs, one not known has none."""
        if self.vector:
            return {name: known.get(name, "") for name in self.names(scenario)}
        cost = known.get(scenario.plant.stage_cost, "")
        return {self.name: cost if self.unit == COST else self.unit}


def _penalty(scenario: Scenario, columns: Mapping[str, Array]) -> Array:
    return scenario.state_penalty.along(columns["states"])


def _violation(scenario: Scenario, columns: Mapping[str, Array]) -> Array:
    total: Array = scenario.state_penalty.violation(columns["states"]).sum(axis=1)
    return total


SIGNALS: tuple[SignalKind, ...] = (
    SignalKind("time", unit="s"),
    SignalKind("states", group="states", vector=True),
    SignalKind("actions", group="actions", vector=True),
    SignalKind("disturbances", group="disturbances", vector=True),
    SignalKind("stage_cost", unit=COST, group="costs"),
    SignalKind("penalty", _penalty, COST, "costs"),
    SignalKind("violation", _violation),
    SignalKind("value", unit=COST),
    SignalKind("residual"),
    SignalKind("failed", whole=True),
    SignalKind("prepare_time", unit="s", group="step_time", clock=True),
    SignalKind("feedback_time", unit="s", group="step_time", clock=True),
    SignalKind("plant_time", unit="s", group=None, clock=True),
)


def clocked() -> frozenset[str]:
    """Names of the signals that a clock measured: two equal runs differ in them."""
    return frozenset(kind.name for kind in SIGNALS if kind.clock)


STATUS = "status"
PART = 10_000
QUANTILES = {"median_us": 0.5, "p95_us": 0.95, "p99_us": 0.99, "max_us": 1.0}
FALLBACK = "fallback"


@dataclass(frozen=True)
class Signal:
    """A sampled quantity: its name, its unit ("" if it has none) and `values`, one per sample."""

    name: str
    unit: str
    values: Array


@dataclass(frozen=True)
class RunSignals:
    """A run's `signals` by name, all of K samples, and the status of each ([] if not known).

    `name` is its path; `bounds` are (lower, upper) of signals with known bounds; `ordered` says
    that the order of the signals is that of a file's columns.
    """

    name: str
    signals: Mapping[str, Signal]
    status: Sequence[str] = ()
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ordered: bool = True

    @property
    def label(self) -> str:
        """The run's folder, or the file where its name says more than `trajectory` or `run`."""
        path = Path(self.name)
        return path.parent.name or path.stem if path.stem in ("trajectory", "run") else path.stem

    def __len__(self) -> int:
        return max((len(signal.values) for signal in self.signals.values()), default=0)


@dataclass(frozen=True, repr=False)
class Trajectory(Result):
    """The K samples of a closed-loop run on a scenario.

    Signals, each (K,): `time` [s]; the scenario's states, actions and disturbances under their
    FMU names; `stage_cost` ℓ(x_k, u_k, d_k) without penalty; `penalty` and `violation` Σᵢ vᵢ of
    x_k at the true bounds; the controller's `value` and `residual` (NaN if it has none);
    `failed` (0 or 1). `status` has one word per sample, `fallback` where the controller failed.
    `timing` holds wall-clock times [s] by name, (K,); `final_state` is x_K; `seed` is the noise's.
    `signals` maps names to signals.
    """

    scenario: Scenario
    signals: Mapping[str, Signal]
    status: Sequence[str]
    timing: Mapping[str, Array] = field(default_factory=dict)
    final_state: Array | None = None
    seed: int | None = None
    controller: str = ""

    def __post_init__(self) -> None:
        kinds = [kind for kind in SIGNALS if not kind.clock]
        expected = (name for kind in kinds for name in kind.names(self.scenario))
        if missing := [name for name in expected if name not in self.signals]:
            raise TrajectoryError(f"the trajectory lacks the signal {', '.join(missing)}")
        samples = len(self.status)
        for signal in self.signals.values():
            if signal.values.shape != (samples,):
                raise TrajectoryError(
                    f"signal '{signal.name}' has shape {signal.values.shape}, not ({samples},)"
                )

    def __len__(self) -> int:
        return len(self.status)

    def __getitem__(self, name: str) -> Array:
        if name not in self.signals:
            raise TrajectoryError(f"no signal '{name}'; there are {', '.join(self.signals)}")
        return self.signals[name].values

    def _columns(self, names: Sequence[str]) -> Array:
        return (
            np.stack([self[name] for name in names], axis=1) if names else np.empty((len(self), 0))
        )

    def _facts(self) -> dict[str, object]:
        found = self.summary()
        names = ("samples", "J", "economic_cost", "violating_share", "failures")
        about = {"scenario": self.scenario.name, "controller": self.controller, "seed": self.seed}
        return about | {name: found[name] for name in names}

    def to_pandas(self) -> Any:
        """The signals as a pandas data frame, a row for each sample, a column for each signal."""
        import pandas as pd  # noqa: PLC0415 - half a second

        columns = {name: signal.values for name, signal in self.signals.items()}
        return pd.DataFrame(columns | {STATUS: list(self.status)})

    def figure(self) -> Figure:
        """States, actions, disturbances and costs over time, with their bounds."""
        from cosim.figures.trajectory import trajectory_figure  # noqa: PLC0415 - matplotlib

        return trajectory_figure(self, self.scenario)

    @property
    def time(self) -> Array:
        """Sample instants k·h in s, (K,)."""
        return self["time"]

    @property
    def states(self) -> Array:
        """States x_k, (K, n)."""
        return self._columns(self.scenario.plant.states)

    @property
    def actions(self) -> Array:
        """Applied actions u_k, (K, m)."""
        return self._columns(self.scenario.plant.actions)

    @property
    def disturbances(self) -> Array:
        """Realised disturbances d_k, (K, p)."""
        return self._columns(self.scenario.plant.disturbances)

    def means(self, burn_in: int = 0) -> dict[str, float]:
        """Means a sample after the first `burn_in`.

        `economic_cost` ℓ; `mean_violation` Σᵢ vᵢ; `violating_share` share of samples with Σᵢ vᵢ >
        `cosim.core.scenario.VIOLATING`, 1e-6 in the states' units, so that rounding at a bound does
        not count; `J` mean of ℓ + penalty, to which every violation counts.
        """
        names = ("stage_cost", "penalty", "violation")
        cost, penalty, violation = (self[name][burn_in:] for name in names)
        return {
            "economic_cost": float(np.mean(cost)),
            "mean_violation": float(np.mean(violation)),
            "violating_share": float(np.mean(violation > VIOLATING)),
            "J": float(np.mean(cost + penalty)),
        }

    def summary(self) -> dict[str, Any]:
        """`means` of the run and its counts; the same for the same signals.

        `failures` are samples under the fallback action; `statuses` samples by status.
        """
        return {
            "samples": len(self),
            **self.means(),
            "failures": int(np.sum(self["failed"])),
            "statuses": dict(sorted(Counter(self.status).items())),
            "final_state": None if self.final_state is None else self.final_state.tolist(),
        }

    def timing_summary(self) -> dict[str, dict[str, float]]:
        """Median, 95 % and 99 % quantile and maximum of each wall-clock time, in µs."""
        summary = {}
        for name, seconds in self.timing.items():
            quantiles = 1e6 * np.quantile(seconds, list(QUANTILES.values()))
            summary[name] = dict(zip(QUANTILES, quantiles.tolist(), strict=True))
        return summary

    def to_csv(self) -> str:
        """Return the signals and the status as CSV text; floats read back to the same bits."""
        return csv_text(*self._table())

    def write_csv(self, path: str | Path) -> Path:
        """Write `to_csv` to a file, whole or not at all."""
        return _write(path, *self._table())

    def write_timing_csv(self, path: str | Path) -> Path:
        """Write the wall-clock times in µs to a file of their own, one row per sample."""
        header = [f"{name} [us]" for name in self.timing]
        rows = ([f"{1e6 * v:.3f}" for v in row] for row in _rows(list(self.timing.values())))
        return _write(path, header, rows)

    def _table(self) -> tuple[list[str], Iterator[list[str]]]:
        """Header and rows of the CSV."""
        signals = list(self.signals.values())
        counted = {kind.name for kind in SIGNALS if kind.whole}
        text = [(lambda v: repr(int(v))) if s.name in counted else repr for s in signals]
        numbers = _rows([signal.values for signal in signals])
        titles = [f"{s.name} [{s.unit}]" if s.unit else s.name for s in signals]
        return [*titles, STATUS], (
            [*(write(v) for write, v in zip(text, row, strict=True)), status]
            for row, status in zip(numbers, self.status, strict=True)
        )


def _write(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> Path:
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows(chain([header], rows))
    return Path(path)


def _rows(columns: Sequence[Array]) -> Iterator[tuple[float, ...]]:
    """Rows of equally long columns, converted a part at a time to save memory."""
    for first in range(0, len(columns[0]) if columns else 0, PART):
        yield from zip(*(column[first : first + PART].tolist() for column in columns), strict=True)


def read_csv(path: str | Path, scenario: Scenario) -> Trajectory:
    """Read what `Trajectory.write_csv` wrote; raises TrajectoryError with file and line."""
    return Trajectory(scenario, *read_signals(path))


def read_signals(path: str | Path) -> tuple[dict[str, Signal], list[str]]:
    """Read the signals by name and the status of each sample from a trajectory's CSV file.

    Raises TrajectoryError with file and line.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise TrajectoryError(f"'{path}' cannot be read: {cause}") from None
    if len(rows) < 2 or not rows[0] or rows[0][-1] != STATUS:
        raise TrajectoryError(f"'{path}' is not a trajectory: its last column is not '{STATUS}'")
    header, body = rows[0], rows[1:]
    values = np.empty((len(body), len(header) - 1))
    for number, row in enumerate(body, start=2):
        if len(row) != len(header):
            raise TrajectoryError(f"'{path}', line {number}: {len(row)} fields, not {len(header)}")
        try:
            if not (text := "".join(row[:-1])).isascii() or "_" in text:
                raise ValueError("a number has other signs than those of ASCII, or '_'")
            values[number - 2] = [float(cell) for cell in row[:-1]]
        except ValueError as error:
            raise TrajectoryError(f"'{path}', line {number}: {error}") from None
    signals = {}
    for title, column in zip(header, values.T, strict=False):
        name, _, unit = title.partition(" [")
        if name in signals:
            raise TrajectoryError(f"'{path}' has two columns '{name}'")
        signals[name] = Signal(name, unit.removesuffix("]"), column.copy())
    return signals, [row[-1] for row in body]
