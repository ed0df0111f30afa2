"""Reference signals in the FMI cross-check format, in `fmus/reference`.

Each case is a folder with ``evaporator_in.csv`` (inputs), ``evaporator_ref.csv`` (outputs),
``evaporator_ref.opt`` (experiment) and ``start_values.csv`` (parameters, which that format lacks).
``python -m tests.helpers.crosscheck`` writes them anew.
"""

import csv
from pathlib import Path

import fmpy
import numpy as np

import fmus
from fmus.evaporator import EVAPORATOR

FOLDER = Path(fmus.__file__).parent / "reference"
CASES = {
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
NOT_USED = {
    f"{name}_in": EVAPORATOR.by_name[f"{name}_in"].start for name in ("X1", "F1", "T1", "T200")
}


def input_signals() -> np.ndarray:
    """Steps of P100 and F200, a change being two rows of one time, and the other inputs held."""
    rows = []
    for k, values in enumerate(zip(P100, F200, strict=True)):
        rows += [(t * HOLD, *values, *NOT_USED.values()) for t in (k, k + 1)]
    names = ("time", "P100", "F200", *NOT_USED)
    return np.array(rows, dtype=[(name, float) for name in names])


def simulate(fmu: Path, case: str, interface: str = "CoSimulation", **options) -> np.ndarray:
    """Run `case` with fmpy; columns time and `OUTPUTS`, one row for each communication point."""
    return fmpy.simulate_fmu(
        str(fmu),
        stop_time=STOP_TIME,
        output_interval=STEP_SIZE,
        start_values=CASES[case],
        input=input_signals(),
        output=list(OUTPUTS),
        fmi_type=interface,
        **options,
    )


def load(case: str, kind: str = "ref") -> np.ndarray:
    """The stored signals of `case`: kind ``"in"`` or ``"ref"``."""
    path = FOLDER / case / f"evaporator_{kind}.csv"
    return np.genfromtxt(path, delimiter=",", names=True, deletechars="")


def hold(fmu: Path) -> None:
    """Raise AssertionError where a signal of `fmu` differs from the stored one in any bit."""
    for case in CASES:
        expected, actual = load(case), simulate(fmu, case)
        for name in ("time", *OUTPUTS):
            np.testing.assert_array_equal(actual[name], expected[name], f"{case}: {name}")


def update(fmu: Path) -> None:
    """Write the reference signals anew from `fmu`."""
    options = {
        "StartTime": 0.0, "StopTime": STOP_TIME, "StepSize": STEP_SIZE, "RelTol": 1e-6,
        "OutputIntervalLength": STEP_SIZE,
    }  # fmt: skip
    for case, values in CASES.items():
        tables = {
            "evaporator_in.csv": _lines(input_signals()),
            "evaporator_ref.csv": _lines(simulate(fmu, case)),
            "evaporator_ref.opt": options.items(),
            "start_values.csv": values.items(),
        }
        for name, lines in tables.items():
            with (FOLDER / case / name).open("w", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows(lines)


def _lines(signals: np.ndarray) -> list[tuple]:
    return [signals.dtype.names, *signals.tolist()]


if __name__ == "__main__":
    update(fmus.path())
