"""A plant of one's own as an FMU: a table of variables in Python, the equations in C, no more.

The benchmark's own beside the evaporator, an exothermic reactor and four tanks, are made so: their
variables are in `resources/NAME.csv`, their right-hand sides in `equations/NAME.h`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path

from fmus.build import PACKAGE, RESOURCES, SOURCES, build_model, files_of
from fmus.model import FmiVersion, FmuModel, Kind, Type, Variable, read_variables, render

# The evaporator's sources that serve any plant; the others are its own or generated.
_SHARED = (
    "disturbance.h", "elementary.h", "events.h", "model_state.h", "philox.h", "sampled.h", "seed.h",
    "simulation.h",
)  # fmt: skip


@dataclass(frozen=True)
class Signal:
    """A variable of a plant: its `name`, unit, value at the start, `min`, `max`, `description`.

    `start` is a state's initial value, an input's or parameter's default, a disturbance's mean;
    outputs have none. `range` is a disturbance's half width (uniform) or standard deviation.
    """

    name: str
    unit: str
    start: float = 0.0
    min: float = -inf
    max: float = inf
    description: str = ""
    range: float = 0.0

    def variable(self, kind: Kind, uses: tuple[str, ...] = ()) -> Variable:
        """The signal as a row of a table; one that is calculated `uses` others and has no start."""
        start = None if kind in (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT) else self.start
        return Variable(
            self.name, kind, Type.REAL, self.unit, start, self.min, self.max,
            abs(self.start) or 1.0, self.description, uses,
        )  # fmt: skip


def plant_model(
    name: str,
    *,
    states: Sequence[Signal],
    inputs: Sequence[Signal],
    disturbances: Sequence[Signal],
    outputs: Sequence[Signal],
    parameters: Sequence[Signal] = (),
    sampling_time: float,
    description: str = "",
) -> FmuModel:
    """The table of an FMU from the signals of a plant.

    Each state x has a derivative ``der(x)`` (in C ``VR_der_x``) and a start parameter ``x_start``,
    each disturbance d a mean ``d_nominal`` and a ``d_range``; beside them are the switches
    ``stochastic``, ``law`` (1 uniform, 2 normal; FMI 2.0 has an integer ``law_number``, too),
    ``seed``, ``seedHigh`` (FMI 2.0), ``sampling_time`` [s], whose multiples are when the
    disturbances are drawn anew, and ``saturate``, with which an input beyond its range acts at the
    bound.
    """
    switches = [
        replace(v, start=sampling_time, nominal=sampling_time) if v.name == "sampling_time" else v
        for v in read_variables(RESOURCES / "switches.csv")
    ]
    drawn = (*(each.name for each in switches if each.name != "saturate"), "time")
    known = tuple(s.name for s in (*states, *inputs, *disturbances, *parameters))
    table = [
        Variable("time", Kind.INDEPENDENT, unit="s", description="time"),
        *(s.variable(Kind.STATE, (f"{s.name}_start",)) for s in states),
        *(
            Signal(
                f"der({s.name})", f"{s.unit}/s", s.start, -1e6, 1e6, f"time derivative of {s.name}"
            ).variable(Kind.DERIVATIVE, known)
            for s in states
        ),
        *(s.variable(Kind.INPUT) for s in inputs),
        *(
            d.variable(Kind.OUTPUT, (f"{d.name}_nominal", f"{d.name}_range", *drawn))
            for d in disturbances
        ),
        *(s.variable(Kind.OUTPUT, known) for s in outputs),
        *switches,
    ]
    about = "half width (uniform) or standard deviation (normal)"
    for d in disturbances:
        spread = Signal(f"{d.name}_range", d.unit, d.range, 0.0, d.max - d.min, about)
        mean = replace(d, name=f"{d.name}_nominal", description=f"mean {d.description}")
        table += [mean.variable(Kind.TUNABLE), spread.variable(Kind.TUNABLE)]
    for s in states:
        start = replace(s, name=f"{s.name}_start", description=f"{s.name} at the start")
        table.append(start.variable(Kind.FIXED))
    table += [s.variable(Kind.TUNABLE) for s in parameters]
    return FmuModel(
        name=name,
        identifier=name,
        description=description,
        variables=tuple(table),
        step_size=sampling_time,
        model_exchange=True,
        terminal=tuple(s.name for s in (*states, *inputs)),
    )


def build_plant(
    model: FmuModel,
    equations: str | bytes,
    target: str | Path,
    version: FmiVersion = 2,
    every_platform: bool = False,
) -> Path:
    """Compile a plant's equations into the FMU `target`; returns its path.

    `equations` is a C header that includes ``variables.h`` and defines ``static void
    evaluate(double v[N_VARIABLES])``: from the states, inputs, disturbances and parameters in `v`,
    each at its value reference ``VR_name``, it sets the outputs and the states' derivatives per
    second. FMI 2.0 or 3.0, co-simulation and model exchange; snapshots and their serialisation;
    draws that are a function of seed and sample; fourth-order Runge–Kutta steps of at most 1 s.
    Raises BuildError where there is no compiler or it refuses the equations.
    """
    own = {name: (SOURCES / name).read_bytes() for name in _SHARED} | files_of("plant_sources")
    own["equations.h"] = equations.encode() if isinstance(equations, str) else equations
    own["states.h"] = render(
        "states.h",
        model=model,
        states=[model.by_name[name].identifier for name in model.names(Kind.STATE)],
        drawn=[n.removesuffix("_nominal") for n in model.by_name if n.endswith("_nominal")],
    ).encode()
    return build_model(replace(model, sources=own), target, version, every_platform=every_platform)


PLANTS = {
    "reactor": ("Exothermic stirred-tank reactor with disturbed feed", 12.0),
    # Johansson (2000)
    "tanks": ("Quadruple tank with water drawn at random from the lower tanks", 5.0),
}
"""By its name each plant's description and sampling time [s]."""
_ROLES = ("states", "inputs", "disturbances", "outputs", "parameters")


def model(name: str) -> FmuModel:
    """The table of a plant of `PLANTS`."""
    signals: dict[str, list[Signal]] = {role: [] for role in _ROLES}
    with (RESOURCES / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            start, low, high = (float(row[key]) for key in ("start", "min", "max"))
            signals[row["role"]].append(
                Signal(
                    row["name"], row["unit"], start, low, high, row["description"],
                    float(row["range"] or 0.0),
                )
            )  # fmt: skip
    description, sampling_time = PLANTS[name]
    return plant_model(name, description=description, sampling_time=sampling_time, **signals)


def equations(name: str) -> bytes:
    """The C header with a plant's right-hand side."""
    return (PACKAGE / "equations" / f"{name}.h").read_bytes()


def build(folder: Path, every_platform: bool = False) -> list[Path]:
    """Build both FMUs (FMI 2.0) into `folder` and return their paths."""
    return [
        build_plant(model(name), equations(name), folder / f"{name}.fmu", 2, every_platform)
        for name in PLANTS
    ]
