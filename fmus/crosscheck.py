"""Reference signals in the FMI cross-check format, in the folder `reference/`.

Each case is a folder with ``evaporator_in.csv`` (inputs), ``evaporator_ref.csv`` (outputs),
``evaporator_ref.opt`` (experiment) and ``start_values.csv`` (parameters, which that format lacks).
They are written by ``cosim fmu reference --update`` alone.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import fmpy
import numpy as np
from numpy.typing import NDArray

from fmus import FmuError
from fmus.check import description_of
from fmus.evaporator import BY_NAME, DISTURBANCES

FOLDER = Path(__file__).parent / "reference"
CASES: dict[str, dict[str, str]] = {
    "nominal": {"stochastic": "false"},
    "seed1": {"seed": "1"},
    "seed2": {"seed": "2"},
    "drifting": {
        "seed": "3",
        "law": "2",
        "fouling_rate": "20",
        "fouling_floor": "0.6",
        "cleaning_period": "0.03",
    },
}
OUTPUTS = ("X2", "P2", "X1", "F1", "T1", "T200", "economic_cost", "F2", "F100")
STOP_TIME = 6000.0  # s
STEP_SIZE = 60.0  # s
HOLD = 1200.0  # s between changes of the inputs
P100 = (191.71322, 230.0, 175.0, 210.0, 191.71322)  # kPa
F200 = (215.88844, 215.88844, 300.0, 150.0, 215.88844)  # kg/min
NOT_USED = {f"{name}_in": BY_NAME[f"{name}_in"].start for name in DISTURBANCES}

Signals = NDArray[np.void]


@dataclass(frozen=True)
class Deviation:
    """The first sample at which a signal is not the stored one."""

    case: str
    signal: str
    time: float
    expected: float
    actual: float

    def __str__(self) -> str:
        """One line with key, time and both values."""
        return (
            f"{self.case}: {self.signal} at {self.time:g} s is {self.actual!r}, "
            f"stored is {self.expected!r}"
        )


def input_signals() -> Signals:
    """Steps of P100 and F200, a change being two rows of one time, and the other inputs held."""
    rows = []
    for k, values in enumerate(zip(P100, F200, strict=True)):
        rows += [(t * HOLD, *values, *NOT_USED.values()) for t in (k, k + 1)]
    names = ("time", "P100", "F200", *NOT_USED)
    return np.array(rows, dtype=[(name, float) for name in names])


def simulate(fmu: Path, case: str, interface: str = "CoSimulation", **options: object) -> Signals:
    """Run `case` with fmpy; columns time and `OUTPUTS`, one row for each communication point."""
    result: Signals = fmpy.simulate_fmu(
        str(fmu),
        stop_time=STOP_TIME,
        output_interval=STEP_SIZE,
        start_values=CASES[case],
        input=input_signals(),
        output=list(OUTPUTS),
        fmi_type=interface,
        **options,
    )
    return result


def load(case: str, kind: str = "ref") -> Signals:
    """The stored signals of `case`: kind ``"in"`` or ``"ref"``; raises FmuError if missing."""
    path = FOLDER / case / f"evaporator_{kind}.csv"
    if not path.is_file():
        raise FmuError(f"{path} is missing; reinstall the package")
    return np.genfromtxt(path, delimiter=",", names=True, deletechars="")


def deviations(fmu: Path) -> list[Deviation]:
    """For each case and signal the first sample that differs in any bit.

    Raises FmuError when `fmu` is no evaporator.
    """
    _require_evaporator(fmu)
    found = []
    for case in CASES:
        expected, actual = load(case), simulate(fmu, case)
        for name in ("time", *OUTPUTS):
            differing = np.flatnonzero(expected[name] != actual[name])
            if len(differing) > 0:
                k = differing[0]
                values = (expected["time"][k], expected[name][k], actual[name][k])
                found.append(Deviation(case, name, *map(float, values)))
    return found


def update(fmu: Path) -> list[Path]:
    """Write the reference signals anew from `fmu`; returns the files."""
    _require_evaporator(fmu)
    options = {
        "StartTime": 0.0, "StopTime": STOP_TIME, "StepSize": STEP_SIZE, "RelTol": 1e-6,
        "OutputIntervalLength": STEP_SIZE,
    }  # fmt: skip
    files = []
    for case, values in CASES.items():
        folder = FOLDER / case
        folder.mkdir(parents=True, exist_ok=True)
        tables = {
            "evaporator_in.csv": _lines(input_signals()),
            "evaporator_ref.csv": _lines(simulate(fmu, case)),
            "evaporator_ref.opt": [[name, repr(value)] for name, value in options.items()],
            "start_values.csv": [[name, value] for name, value in values.items()],
        }
        for name, lines in tables.items():
            with (folder / name).open("w", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows(lines)
            files.append(folder / name)
    return files


def _require_evaporator(fmu: Path) -> None:
    names = {variable.name for variable in description_of(fmu).modelVariables}
    missing = {"seed", "stochastic", "P100", "F200", *NOT_USED, *OUTPUTS} - names
    if missing:
        raise FmuError(f"{fmu} is no evaporator: it lacks {', '.join(sorted(missing))}")


def _lines(signals: Signals) -> list[list[str]]:
    names = list(signals.dtype.names or ())
    return [names, *([repr(float(row[name])) for name in names] for row in signals)]
