"""Compares two runs sample by sample: names, units, order, and each value within a tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.core.errors import ComparisonError, ScenarioError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.core.trajectory import RunSignals, Signal, clocked, read_signals
from cosim.core.validation import instead

RESIDUAL = "residual"
"""Signal that is itself a rounding error: a share of it is no tolerance."""


def load_run(path: str | Path) -> RunSignals:
    """Load a run.

    Args:
        path: a folder that holds trajectory.csv or trajectory.parquet, such a file, or a `.rrd`.

    Raises:
        ComparisonError: there is no run.
        TrajectoryError: the CSV is not readable.
        RecordingError: the recording is not readable.
    """
    path = Path(path)
    if path.is_dir():
        # A long run is written by columns.
        by_columns = path / "trajectory.parquet"
        path = by_columns if by_columns.is_file() else path / "trajectory.csv"
    if not path.is_file():
        raise ComparisonError(
            f"there is no run at '{path}'; give a run's folder, CSV, Parquet or .rrd"
        )
    if path.suffix == ".rrd":
        return _load_recording(path)
    bounds: Mapping[str, tuple[float, float]] = {}
    # A run without its scenario can be compared, and drawn without bounds.
    with suppress(ScenarioError):
        bounds = Scenario.load(path.parent / "scenario.toml").limits
    signals, status = read_signals(path)
    return RunSignals(str(path), signals, status, bounds)


def _load_recording(path: Path) -> RunSignals:
    """Signals of a `.rrd` file, without times of the clock and predictions."""
    from cosim.recording.read import read_recording  # noqa: PLC0415 - half a second

    recording = read_recording(path)
    clock_names = clocked()
    signals = {}
    for name, values in recording.signals.items():
        # A prediction has an axis of its own.
        if values.ndim != 1 or name in clock_names:
            continue
        unit = recording.units[name]
        signals[name] = Signal(name, unit, values)
    return RunSignals(str(path), signals, recording.status, ordered=False)


@dataclass(frozen=True)
class Difference:
    """Difference of one signal between runs A and B over their common samples.

    Attributes:
        name, unit: of the signal.
        tolerance: in its unit; None: every bit counts.
        maximum: max |a − b|, infinite where only one is NaN.
        at: number of the sample where it is.
        a, b: the values there.
        first: first sample with |a − b| > `tolerance`, or whose bits differ; None if there is none.
    """

    name: str
    unit: str
    tolerance: float | None
    maximum: float
    at: int
    a: float
    b: float
    first: int | None

    def text(self) -> str:
        """Largest difference and tolerance, with units and both values."""
        # "1" is FMI's unit of a number without dimension.
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        beyond = ""
        if self.tolerance is not None:
            beyond = f", tolerance {self.tolerance:.6g}{unit}"
        # `repr`: where single bits differ fewer digits would show two equal numbers.
        return (
            f"{self.name} differs by up to {self.maximum:.6g}{unit} "
            f"(sample {self.at}: {self.a!r} against {self.b!r}){beyond}"
        )


@dataclass(frozen=True)
class Comparison:
    """The differences of two runs, A and B.

    Attributes:
        samples: the two lengths.
        differences: one for each signal of both.
        only_first, only_second: signals of one run alone.
        units: different units, by signal.
        order: first position at which the order of the signals differs; None: nowhere.
        status: first sample whose status differs; None: nowhere.
        times: of A's samples in s, (K,).
    """

    samples: tuple[int, int]
    differences: Sequence[Difference]
    only_first: Sequence[str] = ()
    only_second: Sequence[str] = ()
    units: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    order: int | None = None
    status: int | None = None
    times: Array = field(default_factory=lambda: np.empty(0))

    @property
    def equal(self) -> bool:
        """Whether the runs have the same samples, signals and status, all within tolerance."""
        return not self.lines()

    @property
    def first(self) -> int | None:
        """First sample at which any signal or the status differs."""
        candidates = [difference.first for difference in self.differences]
        candidates.append(self.status)
        samples = [sample for sample in candidates if sample is not None]
        return min(samples, default=None)

    def lines(self) -> list[str]:
        """The differences in words: the first one, then names, units and order."""
        lines = self._lines_of_first()
        first_length, second_length = self.samples
        if first_length != second_length:
            lines.append(f"{first_length} samples against {second_length}")
        if self.only_first:
            lines.append(f"only the first has {', '.join(self.only_first)}")
        if self.only_second:
            lines.append(f"only the second has {', '.join(self.only_second)}")
        for name, (unit, other_unit) in self.units.items():
            lines.append(f"{name} is in '{unit}' against '{other_unit}'")
        if self.order is not None:
            lines.append(f"the columns stand in another order from column {self.order + 1} on")
        return lines

    def _lines_of_first(self) -> list[str]:
        """Signals that differ at the first sample with a difference."""
        sample = self.first
        if sample is None:
            return []
        time = ""
        # A run of another tool may have no column of times.
        if len(self.times) > sample:
            time = f" (time {self.times[sample]:g} s)"
        lines = [f"first difference at sample {sample}{time}:"]
        for difference in self.differences:
            if difference.first == sample:
                lines.append(f"  {difference.text()}")
        if self.status == sample:
            lines.append("  status")
        return lines

    def document(self) -> dict[str, Any]:
        """The comparison as plain values, ready for JSON."""
        document: dict[str, Any] = {"equal": self.equal, "first_difference": self.first}
        for name in ("samples", "only_first", "only_second", "units", "order"):
            document[name] = getattr(self, name)
        signals = {}
        for difference in self.differences:
            signals[difference.name] = {
                "unit": difference.unit,
                "tolerance": difference.tolerance,
                "maximum": difference.maximum,
                "at": difference.at,
                "first": difference.first,
            }
        document["signals"] = signals
        return document


def compare(
    a: RunSignals,
    b: RunSignals,
    tolerances: Mapping[str, float] | None = None,
    *,
    relative: float = 0.0,
) -> Comparison:
    """Compare two runs; two NaN are equal.

    A signal's tolerance is its own of `tolerances`, else `relative` times its largest magnitude in
    A; without either every bit counts, so that −0.0 is not 0.0. The solver's `residual` is left out
    of `relative`: it counts with a tolerance of its own, or to the bit.

    Args:
        a: a run.
        b: another one.
        tolerances: by signal, in its unit.
        relative: share of a signal's largest magnitude.

    Raises:
        ComparisonError: a tolerance is negative, or for a signal that neither run has.
    """
    if not 0 <= relative < inf:
        raise ComparisonError(f"relative (--relative) must be finite and ≥ 0, not {relative}")
    tolerances = tolerances or {}
    known = {**a.signals, **b.signals}
    for name, value in tolerances.items():
        if name not in known:
            raise ComparisonError(
                f"tolerance for the unknown signal '{name}'{instead(name, known)}"
            )
        if not value >= 0:
            raise ComparisonError(f"the tolerance of '{name}' must not be negative, not {value}")
    # In the order of A, so that the report names them as its file does.
    common = [name for name in a.signals if name in b.signals]
    differences = []
    units = {}
    for name in common:
        signal = a.signals[name]
        other = b.signals[name]
        tolerance = tolerances.get(name)
        if tolerance is None and relative:
            tolerance = _tolerance_of_size(signal, relative)
        differences.append(_difference(signal, other, tolerance))
        if signal.unit != other.unit:
            units[name] = (signal.unit, other.unit)
    # A recording keeps its signals by name, in no order.
    order = common
    if a.ordered and b.ordered:
        order = [name for name in b.signals if name in a.signals]
    time = a.signals.get("time")
    return Comparison(
        samples=(len(a), len(b)),
        differences=differences,
        only_first=[name for name in a.signals if name not in b.signals],
        only_second=[name for name in b.signals if name not in a.signals],
        units=units,
        order=_first_unequal(common, order),
        status=_first_unequal(a.status, b.status),
        times=np.empty(0) if time is None else time.values,
    )


def _tolerance_of_size(signal: Signal, relative: float) -> float:
    """`relative` times a signal's largest magnitude."""
    if signal.name == RESIDUAL:
        return inf
    finite = signal.values[np.isfinite(signal.values)]
    return float(relative * np.abs(finite).max(initial=0.0))


def _difference(
    a: Signal,
    b: Signal,
    tolerance: float | None,
) -> Difference:
    # As far as both go; the lengths are compared apart.
    count = min(len(a.values), len(b.values))
    x = a.values[:count]
    y = b.values[:count]
    both_missing = np.isnan(x) & np.isnan(y)
    # ∞ − ∞ is no number, and no difference.
    with np.errstate(invalid="ignore"):
        distance = np.abs(x - y)
    distance[np.isnan(distance)] = inf
    distance[(x == y) | both_missing] = 0.0
    # The bits, since −0.0 equals 0.0.
    if tolerance is None:
        beyond = (x.view(np.int64) != y.view(np.int64)) & ~both_missing
    else:
        beyond = distance > tolerance
    first = _first(beyond)
    if not count:
        return Difference(a.name, a.unit, tolerance, 0.0, 0, np.nan, np.nan, first)
    at = int(np.argmax(distance))
    # −0.0 and 0.0 differ in their bits, by no distance.
    if distance[at] == 0:
        at = first or 0
    return Difference(
        name=a.name,
        unit=a.unit,
        tolerance=tolerance,
        maximum=float(distance[at]),
        at=at,
        a=float(x[at]),
        b=float(y[at]),
        first=first,
    )


def _first(differs: NDArray[np.bool_]) -> int | None:
    """Place of the first True, or None."""
    rows = np.flatnonzero(differs)
    return int(rows[0]) if rows.size else None


def _first_unequal(words: Sequence[str], others: Sequence[str]) -> int | None:
    """First place at which two lists of words differ, as far as both go; or None."""
    for place, (word, other) in enumerate(zip(words, others, strict=False)):
        if word != other:
            return place
    return None
