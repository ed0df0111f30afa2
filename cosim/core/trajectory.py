"""A run's record: a sample's signals, declared once, with units; the clock's readings apart."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cosim.core.columns import read_columns, write_columns
from cosim.core.errors import TrajectoryError
from cosim.core.files import replacing
from cosim.core.protocols import Array
from cosim.core.result import Result, csv_text
from cosim.core.scenario import VIOLATING, Scenario
from cosim.core.signals import Signals, sample_numbers

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Group = Literal["states", "actions", "disturbances", "sensors", "costs", "step_time", "unseen"]
COST = "unit of the stage cost"
Derived = Callable[[Scenario, Mapping[str, Array]], Array]
"""K values of a signal, (K,), from a scenario and K values of each signal declared before it."""


@dataclass(frozen=True)
class SignalKind:
    """A declared signal.

    Attributes:
        name: its name.
        derive: computes it from other signals; None: the loop measures it.
        unit: of a signal that is no vector; each variable of a vector has its own.
        group: where a recording shows it; None: nowhere.
        vector: of a vector, the field of the scenario that names its signals; "": it is none.
        whole: whether it is 0 or 1.
        clock: whether it is a wall-clock time, which the trajectory's file leaves out.
    """

    name: str
    derive: Derived | None = None
    unit: str = ""
    group: Group | None = "unseen"
    vector: str = ""
    whole: bool = False
    clock: bool = False

    def names(self, scenario: Scenario) -> tuple[str, ...]:
        """Names of the signals, one but for a vector."""
        if not self.vector:
            return (self.name,)
        names: tuple[str, ...] = attrgetter(self.vector)(scenario)
        return names

    def units(self, scenario: Scenario, known: Mapping[str, str]) -> dict[str, str]:
        """Unit of each signal by name.

        Args:
            scenario: names the variables.
            known: units of FMU variables; one that is not known has none.
        """
        if self.vector:
            return {name: known.get(name, "") for name in self.names(scenario)}
        unit = self.unit
        if unit == COST:
            unit = known.get(scenario.plant.stage_cost, "")
        return {self.name: unit}


def _penalty(scenario: Scenario, columns: Mapping[str, Array]) -> Array:
    states = columns["states"]
    signals = Signals(scenario) if scenario.signals else None
    # One penalty for all samples, without a look at each sample's bounds.
    if signals is None or not signals.move_bounds:
        return scenario.state_penalty.along(states)
    samples = sample_numbers(columns["time"], scenario)
    return signals.penalties_along(states, samples)


def _violation(scenario: Scenario, columns: Mapping[str, Array]) -> Array:
    states = columns["states"]
    signals = Signals(scenario) if scenario.signals else None
    if signals is None or not signals.move_bounds:
        violations = scenario.state_penalty.violation(states)
    else:
        samples = sample_numbers(columns["time"], scenario)
        violations = signals.violations_along(states, samples)
    total: Array = violations.sum(axis=1)
    return total


def _signals(scenario: Scenario, columns: Mapping[str, Array]) -> Array:
    times = columns["time"]
    if not scenario.signals:
        return np.empty((len(times), 0))
    samples = sample_numbers(times, scenario)
    return Signals(scenario).along(samples)


# Loop, CSV, recording and comparison follow this table: a derived signal is declared here alone.
SIGNALS: tuple[SignalKind, ...] = (
    SignalKind("time", unit="s"),
    SignalKind("states", group="states", vector="plant.states"),
    SignalKind("actions", group="actions", vector="plant.actions"),
    SignalKind("disturbances", group="disturbances", vector="plant.disturbances"),
    SignalKind("measurements", group="sensors", vector="measurement_names"),
    SignalKind("estimates", group="sensors", vector="estimate_names"),
    SignalKind("signals", _signals, group="sensors", vector="signal_names"),
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
PARQUET = ".parquet"
ROWS_AT_ONCE = 10_000
"""Rows that are converted to text at a time."""
QUANTILES = {"median_us": 0.5, "p95_us": 0.95, "p99_us": 0.99, "max_us": 1.0}
FALLBACK = "fallback"


@dataclass(frozen=True)
class Signal:
    """A sampled quantity: its name, its unit ("" if it has none) and its values, (K,)."""

    name: str
    unit: str
    values: Array

    @property
    def title(self) -> str:
        """Heading of its column: the name, and the unit in brackets if it has one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


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
        is_plain_name = path.stem in ("trajectory", "run")
        if is_plain_name and path.parent.name:
            return path.parent.name
        return path.stem

    def __len__(self) -> int:
        lengths = [len(signal.values) for signal in self.signals.values()]
        return max(lengths, default=0)


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
        missing = []
        for kind in SIGNALS:
            # Times that a clock measured lie in `timing`.
            if kind.clock:
                continue
            for name in kind.names(self.scenario):
                if name not in self.signals:
                    missing.append(name)
        if missing:
            raise TrajectoryError(f"the trajectory lacks the signal {', '.join(missing)}")
        # All are of one length: a figure or a mean would else pair unlike samples.
        samples = len(self.status)
        for signal in self.signals.values():
            shape = signal.values.shape
            if shape != (samples,):
                raise TrajectoryError(f"signal '{signal.name}' has shape {shape}, not ({samples},)")

    def __len__(self) -> int:
        return len(self.status)

    def __getitem__(self, name: str) -> Array:
        if name not in self.signals:
            raise TrajectoryError(f"no signal '{name}'; there are {', '.join(self.signals)}")
        return self.signals[name].values

    def _columns(self, names: Sequence[str]) -> Array:
        table = np.empty((len(self), len(names)))
        for column, name in enumerate(names):
            table[:, column] = self[name]
        return table

    def _facts(self) -> dict[str, object]:
        summary = self.summary()
        facts: dict[str, object] = {
            "scenario": self.scenario.name,
            "controller": self.controller,
            "seed": self.seed,
        }
        for name in ("samples", "J", "economic_cost", "violating_share", "failures"):
            facts[name] = summary[name]
        return facts

    def to_pandas(self) -> Any:
        """The signals as a pandas data frame, a row for each sample, a column for each signal."""
        import pandas as pd  # noqa: PLC0415 - half a second

        columns: dict[str, Any] = {}
        for name, signal in self.signals.items():
            columns[name] = signal.values
        # Last, as in the CSV.
        columns[STATUS] = list(self.status)
        return pd.DataFrame(columns)

    def figure(self, width: float | None = None) -> Figure:
        """States, actions, disturbances and costs over time, with their bounds.

        Args:
            width: in inches; by default that of two columns of a journal.
        """
        from cosim.figures.trajectory import trajectory_figure  # noqa: PLC0415 - matplotlib

        if width is None:
            return trajectory_figure(self, self.scenario)
        return trajectory_figure(self, self.scenario, width=width)

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
        economic_cost = self["stage_cost"][burn_in:]
        penalty = self["penalty"][burn_in:]
        violation = self["violation"][burn_in:]
        violates = violation > VIOLATING
        cost = economic_cost + penalty
        return {
            "economic_cost": float(np.mean(economic_cost)),
            "mean_violation": float(np.mean(violation)),
            "violating_share": float(np.mean(violates)),
            "J": float(np.mean(cost)),
        }

    def summary(self) -> dict[str, Any]:
        """`means` of the run and its counts; the same for the same signals.

        `failures` are samples under the fallback action; `statuses` samples by status.
        """
        failures = np.sum(self["failed"])
        # In the order of the words: that of their first samples would differ from run to run.
        statuses = sorted(Counter(self.status).items())
        final_state = None
        if self.final_state is not None:
            final_state = self.final_state.tolist()
        return {
            "samples": len(self),
            **self.means(),
            "failures": int(failures),
            "statuses": dict(statuses),
            "final_state": final_state,
        }

    def timing_summary(self) -> dict[str, dict[str, float]]:
        """Median, 95 % and 99 % quantile and maximum of each wall-clock time, in µs."""
        shares = list(QUANTILES.values())
        summary = {}
        for phase, seconds in self.timing.items():
            microseconds = 1e6 * np.quantile(seconds, shares)
            named = zip(QUANTILES, microseconds.tolist(), strict=True)
            summary[phase] = dict(named)
        return summary

    def to_csv(self) -> str:
        """Return the signals and the status as CSV text; floats read back to the same bits."""
        header, rows = self._table()
        return csv_text(header, rows)

    def write_csv(self, path: str | Path) -> Path:
        """Write `to_csv` to a file, whole or not at all."""
        header, rows = self._table()
        return _write(path, header, rows)

    def write_timing_csv(self, path: str | Path) -> Path:
        """Write the wall-clock times in µs to a file, apart from what must repeat to the bit."""
        header = [f"{name} [us]" for name in self.timing]
        return _write(path, header, self._timing_rows())

    def write_parquet(self, path: str | Path) -> Path:
        """Write what `write_csv` does as a Parquet file, under the same titles.

        `pandas.read_parquet` reads it as `pandas.read_csv` reads the other. Of a million samples it
        takes a hundredth of the time and half the room.
        """
        whole_kinds = {kind.name for kind in SIGNALS if kind.whole}
        columns: dict[str, Array] = {}
        for name, signal in self.signals.items():
            values: Any = signal.values
            if name in whole_kinds:
                values = values.astype(np.int64)
            columns[signal.title] = values
        return write_columns(path, columns, {STATUS: self.status})

    def write_timing_parquet(self, path: str | Path) -> Path:
        """Write what `write_timing_csv` does as a Parquet file."""
        columns = {}
        for name, seconds in self.timing.items():
            columns[f"{name} [us]"] = 1e6 * seconds
        return write_columns(path, columns, {})

    def _timing_rows(self) -> Iterator[list[str]]:
        """Rows of the CSV of wall-clock times, in µs."""
        columns = list(self.timing.values())
        for seconds in _rows(columns):
            yield [f"{1e6 * value:.3f}" for value in seconds]

    def _table(self) -> tuple[list[str], Iterator[list[str]]]:
        """Header and rows of the CSV."""
        header = [signal.title for signal in self.signals.values()]
        header.append(STATUS)
        return header, self._rows_of_text()

    def _rows_of_text(self) -> Iterator[list[str]]:
        """Rows of the CSV: each signal's value to the bit, and the status."""
        whole_kinds = {kind.name for kind in SIGNALS if kind.whole}
        whole_columns = []
        columns: list[Array] = []
        for name, signal in self.signals.items():
            if name in whole_kinds:
                whole_columns.append(len(columns))
            columns.append(signal.values)
        rows = _rows(columns)
        for numbers, status in zip(rows, self.status, strict=True):
            # `repr` is the shortest text that reads back to the same bits.
            cells = [repr(number) for number in numbers]
            for index in whole_columns:
                cells[index] = repr(int(numbers[index]))
            cells.append(status)
            yield cells


def _write(
    path: str | Path,
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
) -> Path:
    # Whole or not at all: a reader never sees half of it.
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as stream:
        # On Windows too: the same run has the same bytes on each system.
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
    return Path(path)


def _rows(columns: Sequence[Array]) -> Iterator[tuple[float, ...]]:
    """Rows of equally long columns."""
    n_rows = len(columns[0]) if columns else 0
    # A part at a time: a number of Python's takes four times the memory of NumPy's.
    for first in range(0, n_rows, ROWS_AT_ONCE):
        end = first + ROWS_AT_ONCE
        # `tolist` gives Python's numbers, whose `repr` is the plain digits.
        part = [column[first:end].tolist() for column in columns]
        yield from zip(*part, strict=True)


def read_csv(path: str | Path, scenario: Scenario) -> Trajectory:
    """Read what `Trajectory.write_csv` wrote.

    Args:
        path: the file.
        scenario: on which it was run.

    Raises:
        TrajectoryError: with file and line.
    """
    signals, status = read_signals(path)
    return Trajectory(scenario, signals, status)


def read_signals(path: str | Path) -> tuple[dict[str, Signal], list[str]]:
    """Read a trajectory's CSV or Parquet file.

    Returns:
        The signals by name, and the status of each sample.

    Raises:
        TrajectoryError: with file and line.
    """
    if Path(path).suffix == PARQUET:
        columns, (status,) = read_columns(path, [STATUS])
        return _signals_of_columns(path, columns.items()), status
    try:
        with Path(path).open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise TrajectoryError(f"'{path}' cannot be read: {cause}") from None
    # Another table, or a file that was cut after its header.
    if len(rows) < 2 or not rows[0] or rows[0][-1] != STATUS:
        raise TrajectoryError(f"'{path}' is not a trajectory: its last column is not '{STATUS}'")
    header, *body = rows
    titles = header[:-1]
    values = np.empty((len(body), len(titles)))
    status = []
    for index, row in enumerate(body):
        # The header is line 1.
        line = index + 2
        if len(row) != len(header):
            raise TrajectoryError(f"'{path}', line {line}: {len(row)} fields, not {len(header)}")
        *cells, word = row
        status.append(word)
        try:
            values[index] = _numbers_of_row(cells)
        except ValueError as error:
            raise TrajectoryError(f"'{path}', line {line}: {error}") from None
    # A copy lies in one piece, and does not keep the whole table in memory.
    copies = [column.copy() for column in values.T]
    return _signals_of_columns(path, zip(titles, copies, strict=True)), status


def _signals_of_columns(
    path: str | Path,
    columns: Iterable[tuple[str, Array]],
) -> dict[str, Signal]:
    """Signals by name of a file's columns, whose titles may have a unit; raises TrajectoryError."""
    signals: dict[str, Signal] = {}
    for title, values in columns:
        name, _, rest = title.partition(" [")
        unit = rest.removesuffix("]")
        # The later one would replace the first without a word.
        if name in signals:
            raise TrajectoryError(f"'{path}' has two columns '{name}'")
        signals[name] = Signal(name, unit, values)
    return signals


def _numbers_of_row(cells: Sequence[str]) -> list[float]:
    """Numbers of a row; raises ValueError where a cell is none."""
    # Python's float takes digits of any script, and underscores.
    text = "".join(cells)
    if not text.isascii() or "_" in text:
        raise ValueError("a number has other signs than those of ASCII, or '_'")
    return [float(cell) for cell in cells]
