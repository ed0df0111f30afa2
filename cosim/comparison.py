"""Compares two runs sample by sample, each signal within a tolerance in its own unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.errors import ComparisonError
from cosim.trajectory import Signal
from cosim.validation import suggestion

Array = NDArray[np.float64]
# Itself an error, of the size of rounding: no share of it is a tolerance.
_ERROR = "residual"
STEMS = ("trajectory", "run")
"""Names of a run's files that say nothing of the run."""


@dataclass(frozen=True)
class RunSignals:
    """A run's `signals` by name, all of K samples, and the status of each ([] if not known).

    `name` is where it was read, `label` what figures call it; `bounds` are (lower, upper) of the
    signals that have any, as far as the run says.
    """

    name: str
    signals: Mapping[str, Signal]
    status: Sequence[str] = ()
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The run's folder, or the file where it has another name than a folder's."""
        path = Path(self.name)
        return path.parent.name or path.stem if path.stem in STEMS else path.stem

    def __len__(self) -> int:
        """Return the number of samples K."""
        return max((len(signal.values) for signal in self.signals.values()), default=0)


@dataclass(frozen=True)
class Difference:
    """How one signal, with its name and unit, differs between runs A and B where both have samples.

    `maximum` is max |a − b| (infinite where only one is NaN) at sample `at`, with the values `a`
    and `b` there; `first` is the first sample with |a − b| > `tolerance`, None if there is none.
    """

    name: str
    unit: str
    tolerance: float
    maximum: float
    at: int
    a: float
    b: float
    first: int | None

    def text(self) -> str:
        """Largest difference and tolerance, with units and both values."""
        return (
            f"{self.name} differs by up to {_with_unit(self.maximum, self.unit)} "
            f"(sample {self.at}: {self.a!r} against {self.b!r}), "
            f"tolerance {_with_unit(self.tolerance, self.unit)}"
        )


@dataclass(frozen=True)
class Comparison:
    """The `differences` by signal, and what else sets two runs apart.

    `samples` are the two lengths; `only_a` and `only_b` signals that one run has; `status` is the
    first sample whose status differs, None if there is none; `times` (K,) in s are those of A.
    """

    samples: tuple[int, int]
    differences: Sequence[Difference]
    only_a: Sequence[str] = ()
    only_b: Sequence[str] = ()
    status: int | None = None
    times: Array = field(default_factory=lambda: np.empty(0))

    @property
    def equal(self) -> bool:
        """Whether the runs have the same samples, signals and status, all within tolerance."""
        return (
            self.first is None
            and not self.only_a
            and not self.only_b
            and len(set(self.samples)) == 1
        )

    @property
    def first(self) -> int | None:
        """First sample at which any signal or the status differs."""
        steps = [d.first for d in self.differences if d.first is not None]
        return min((*steps, *([] if self.status is None else [self.status])), default=None)

    def lines(self) -> list[str]:
        """What differs, in words: the first difference, then what is missing; [] if nothing."""
        text = []
        if (step := self.first) is not None:
            at = f" (time {self.times[step]:g} s)" if len(self.times) > step else ""
            found = [d.text() for d in self.differences if d.first == step]
            found += ["status"] if self.status == step else []
            text.append(f"first difference at sample {step}{at}: {'; '.join(found)}")
        if len(set(self.samples)) > 1:
            text.append(f"{self.samples[0]} samples against {self.samples[1]}")
        for missing, side in ((self.only_a, "first"), (self.only_b, "second")):
            if missing:
                text.append(f"only the {side} has {', '.join(missing)}")
        return text


def compare(
    a: RunSignals,
    b: RunSignals,
    tolerances: Mapping[str, float] | None = None,
    *,
    relative: float = 0.0,
) -> Comparison:
    """Compare two runs; two NaN are equal.

    A signal's tolerance is `tolerances[name]`, in its unit, else `relative` times its largest
    magnitude in A; without either every bit counts. The solver's `residual` is left out of
    `relative`: it counts with a tolerance of its own, or to the bit.

    Raises
    ------
    ComparisonError : a tolerance for a signal that neither run has, or a negative one.
    """
    if not 0 <= relative < inf:
        raise ComparisonError(f"relative (--relative) must be finite and ≥ 0, not {relative}")
    tolerances = tolerances or {}
    known = {**a.signals, **b.signals}
    for name, value in tolerances.items():
        if name not in known:
            raise ComparisonError(
                f"tolerance for the unknown signal '{name}'{suggestion(name, known)}; "
                f"there are {', '.join(known)}"
            )
        if not value >= 0:
            raise ComparisonError(f"the tolerance of '{name}' must not be negative, not {value}")
    both = [name for name in a.signals if name in b.signals]
    differences = []
    for name in both:
        values = a.signals[name].values
        finite = np.abs(values[np.isfinite(values)])
        share = np.inf if name == _ERROR and relative else relative * finite.max(initial=0.0)
        tolerance = float(tolerances.get(name, share))
        differences.append(_difference(a.signals[name], b.signals[name], tolerance))
    time = a.signals.get("time")
    return Comparison(
        samples=(len(a), len(b)),
        differences=differences,
        only_a=[name for name in a.signals if name not in b.signals],
        only_b=[name for name in b.signals if name not in a.signals],
        status=_first([x != y for x, y in zip(a.status, b.status, strict=False)]),
        times=np.empty(0) if time is None else time.values,
    )


def _difference(a: Signal, b: Signal, tolerance: float) -> Difference:
    common = min(len(a.values), len(b.values))
    x, y = a.values[:common], b.values[:common]
    with np.errstate(invalid="ignore"):
        distance = np.abs(x - y)
    same = (x == y) | (np.isnan(x) & np.isnan(y))
    distance = np.where(same, 0.0, np.where(np.isnan(distance), np.inf, distance))
    at = int(np.argmax(distance)) if common else 0
    here = (float(x[at]), float(y[at]), float(distance[at])) if common else (np.nan, np.nan, 0.0)
    first = _first(distance > tolerance)
    return Difference(a.name, a.unit, tolerance, here[2], at, here[0], here[1], first)


def _first(differs: Sequence[bool] | NDArray[np.bool_]) -> int | None:
    rows = np.flatnonzero(differs)
    return int(rows[0]) if rows.size else None


def _with_unit(value: float, unit: str) -> str:
    return f"{value:.6g} {unit}".rstrip() if unit != "1" else f"{value:.6g}"


def as_document(comparison: Comparison) -> dict[str, Any]:
    """Return the comparison as plain values, ready for JSON."""
    return {
        "equal": comparison.equal,
        "first_difference": comparison.first,
        "samples": list(comparison.samples),
        "only_first": list(comparison.only_a),
        "only_second": list(comparison.only_b),
        "signals": {
            d.name: {
                "unit": d.unit,
                "maximum": d.maximum,
                "at": d.at,
                "tolerance": d.tolerance,
                "first": d.first,
            }
            for d in comparison.differences
        },
    }
