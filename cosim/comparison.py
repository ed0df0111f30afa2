"""Compares two runs sample by sample: names, units, order, and each value within a tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.errors import ComparisonError, ScenarioError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.core.trajectory import RunSignals, Signal, clocked, read_signals
from cosim.core.validation import instead

# The residual is itself a rounding error: a share of it is no tolerance.
_ERROR = "residual"


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
    """The `differences` of two runs by signal, and all others.

    `samples` are the two lengths; `only_first` and `only_second` signals of one run; `units`
    different units by signal; `order` the first position at which the order of the signals differs;
    `status` the first sample whose status differs; `times` (K,) in s are those of A.
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
        steps = [d.first for d in self.differences if d.first is not None]
        return min((*steps, *([] if self.status is None else [self.status])), default=None)

    def lines(self) -> list[str]:
        """The differences in words: the first one, then names, units and order."""
        text = []
        if (step := self.first) is not None:
            at = f" (time {self.times[step]:g} s)" if len(self.times) > step else ""
            found = [d.text() for d in self.differences if d.first == step]
            found += ["status"] if self.status == step else []
            text += [f"first difference at sample {step}{at}:", *(f"  {one}" for one in found)]
        if len(set(self.samples)) > 1:
            text.append(f"{self.samples[0]} samples against {self.samples[1]}")
        for missing, side in ((self.only_first, "first"), (self.only_second, "second")):
            if missing:
                text.append(f"only the {side} has {', '.join(missing)}")
        text += [f"{name} is in '{a}' against '{b}'" for name, (a, b) in self.units.items()]
        if self.order is not None:
            text.append(f"the columns stand in another order from column {self.order + 1} on")
        return text

    def document(self) -> dict[str, Any]:
        """The comparison as plain values, ready for JSON."""
        names = ("samples", "only_first", "only_second", "units", "order")
        shown = ("unit", "tolerance", "maximum", "at", "first")
        return {
            "equal": self.equal,
            "first_difference": self.first,
            **{name: getattr(self, name) for name in names},
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
    time = a.signals.get("time")
    order = [name for name in b.signals if name in a.signals] if a.ordered and b.ordered else both
    return Comparison(
        samples=(len(a), len(b)),
        differences=differences,
        only_first=[name for name in a.signals if name not in b.signals],
        only_second=[name for name in b.signals if name not in a.signals],
        units={
            name: units
            for name in both
            if len(set(units := (a.signals[name].unit, b.signals[name].unit))) > 1
        },
        order=_first([x != y for x, y in zip(both, order, strict=True)]),
        status=_first([x != y for x, y in zip(a.status, b.status, strict=False)]),
        times=np.empty(0) if time is None else time.values,
    )


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
