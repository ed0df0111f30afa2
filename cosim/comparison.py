"""Compares two runs sample by sample: names, units, order, and each value within a tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from cosim.errors import ComparisonError, ScenarioError
from cosim.scenario import Scenario
from cosim.trajectory import Signal, clocked, read_signals
from cosim.validation import instead

# The residual is itself a rounding error: a share of it is no tolerance.
_ERROR = "residual"


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


def load_run(path: str | Path) -> RunSignals:
    """Load a run from a folder that holds trajectory.csv, from such a CSV, or from a `.rrd` file.

    Raises ComparisonError where there is no run, TrajectoryError or RecordingError where one is not
    readable.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "trajectory.csv"
    if not path.is_file():
        raise ComparisonError(f"there is no run at '{path}'; give a run's folder, CSV or .rrd")
    if path.suffix != ".rrd":
        bounds: Mapping[str, tuple[float, float]] = {}
        with suppress(ScenarioError):
            bounds = Scenario.load(path.parent / "scenario.toml").limits
        return RunSignals(str(path), *read_signals(path), bounds)
    from cosim.recording.read import read_recording  # noqa: PLC0415 - half a second, for .rrd only

    recording = read_recording(path)
    signals = {
        name: Signal(name, recording.units[name], values)
        for name, values in recording.signals.items()
        if values.ndim == 1 and name not in clocked()
    }
    return RunSignals(str(path), signals, recording.status, ordered=False)


@dataclass(frozen=True)
class Difference:
    """Difference of one signal between runs A and B over their common samples.

    `maximum` is max |a − b| (infinite where only one is NaN) at sample `at`, with the values `a`
    and `b` there; `first` is the first sample with |a − b| > `tolerance`, or, without a tolerance,
    whose bits differ; None if there is none.
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
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        beyond = "" if self.tolerance is None else f", tolerance {self.tolerance:.6g}{unit}"
        return (
            f"{self.name} differs by up to {self.maximum:.6g}{unit} "
            f"(sample {self.at}: {self.a!r} against {self.b!r}){beyond}"
        )


@dataclass(frozen=True)
class Comparison:
    """The `differences` of two runs by signal, and all `words` there are to say, none if equal.

    `samples` are the two lengths; `first` is the first sample at which any signal or the status
    differs.
    """

    samples: tuple[int, int]
    differences: Sequence[Difference]
    first: int | None
    words: Sequence[str]

    @property
    def equal(self) -> bool:
        """Whether the runs have the same samples, signals and status, all within tolerance."""
        return not self.words

    def lines(self) -> list[str]:
        """The differences in words: the first one, then samples, names, units and order."""
        return list(self.words)

    def document(self) -> dict[str, Any]:
        """The comparison as plain values, ready for JSON."""
        shown = ("unit", "tolerance", "maximum", "at", "first")
        return {
            "equal": self.equal,
            "first_difference": self.first,
            "samples": self.samples,
            "lines": self.lines(),
            "signals": {d.name: {key: getattr(d, key) for key in shown} for d in self.differences},
        }


def compare(
    a: RunSignals,
    b: RunSignals,
    tolerances: Mapping[str, float] | None = None,
    *,
    relative: float = 0.0,
) -> Comparison:
    """Compare two runs; two NaN are equal.

    A signal's tolerance is `tolerances[name]`, in its unit, else `relative` times its largest
    magnitude in A; without either every bit counts, so that −0.0 is not 0.0. The solver's
    `residual` is left out of `relative`: it counts with a tolerance of its own, or to the bit.

    Raises ComparisonError on a tolerance for a signal that neither run has, or a negative one.
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
    both = [name for name in a.signals if name in b.signals]
    differences = []
    for name in both:
        tolerance = tolerances.get(name)
        if tolerance is None and relative:
            values = a.signals[name].values
            largest = np.abs(values[np.isfinite(values)]).max(initial=0.0)
            tolerance = inf if name == _ERROR else float(relative * largest)
        differences.append(_difference(a.signals[name], b.signals[name], tolerance))
    status = _first([x != y for x, y in zip(a.status, b.status, strict=False)])
    steps = [step for step in (status, *(d.first for d in differences)) if step is not None]
    words = []
    if (first := min(steps, default=None)) is not None:
        times = a.signals["time"].values if "time" in a.signals else ()
        at = f" (time {times[first]:g} s)" if len(times) > first else ""
        words = [f"first difference at sample {first}{at}:"]
        words += [f"  {d.text()}" for d in differences if d.first == first]
        words += ["  status"] * (status == first)
    return Comparison((len(a), len(b)), differences, first, words + _others(a, b, both))


def _others(a: RunSignals, b: RunSignals, both: Sequence[str]) -> list[str]:
    """Differences of length, names, units and order in words."""
    words = []
    if len(a) != len(b):
        words.append(f"{len(a)} samples against {len(b)}")
    for side, one, other in (("first", a, b), ("second", b, a)):
        if missing := [name for name in one.signals if name not in other.signals]:
            words.append(f"only the {side} has {', '.join(missing)}")
    for name in both:
        units = a.signals[name].unit, b.signals[name].unit
        words += [f"{name} is in '{units[0]}' against '{units[1]}'"] * (units[0] != units[1])
    if a.ordered and b.ordered:
        order = [name for name in b.signals if name in a.signals]
        if (at_column := _first([x != y for x, y in zip(both, order, strict=True)])) is not None:
            words.append(f"the columns stand in another order from column {at_column + 1} on")
    return words


def _difference(a: Signal, b: Signal, tolerance: float | None) -> Difference:
    common = min(len(a.values), len(b.values))
    x, y = a.values[:common], b.values[:common]
    with np.errstate(invalid="ignore"):
        distance = np.abs(x - y)
    missing = np.isnan(x) & np.isnan(y)
    distance = np.where((x == y) | missing, 0.0, np.where(np.isnan(distance), inf, distance))
    if tolerance is None:
        beyond = (x.view(np.int64) != y.view(np.int64)) & ~missing
    else:
        beyond = distance > tolerance
    first = _first(beyond)
    at = int(np.argmax(distance)) if common and distance.max() > 0 else first or 0
    here = (float(x[at]), float(y[at]), float(distance[at])) if common else (np.nan, np.nan, 0.0)
    return Difference(a.name, a.unit, tolerance, here[2], at, here[0], here[1], first)


def _first(differs: Sequence[bool] | np.ndarray) -> int | None:
    rows = np.flatnonzero(differs)
    return int(rows[0]) if rows.size else None
