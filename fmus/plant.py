"""A plant of one's own as an FMU: a table of variables in Python, the equations in C, no more.

The benchmark's own beside the evaporator are made so: their
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
    "deviations.h", "disturbance.h", "elementary.h", "events.h", "model_state.h", "philox.h",
    "sampled.h", "seed.h", "simulation.h",
)  # fmt: skip


LARGEST_TIME_CONSTANT = 1e6
"""Largest time constant of a disturbance's filter, in s: eleven days."""


@dataclass(frozen=True)
class Signal:
    """A variable of a plant.

    Attributes:
        name: of the variable.
        unit: as FMI writes it.
        start: a state's initial value, an input's or parameter's default, a disturbance's mean;
            outputs have none.
        min, max: its range.
        description: in words.
        range: a disturbance's half width (uniform) or standard deviation.
        time_constant: of the filter of a disturbance's draws, in s; 0: there is none.
    """

    name: str
    unit: str
    start: float = 0.0
    min: float = -inf
    max: float = inf
    description: str = ""
    range: float = 0.0
    time_constant: float = 0.0

    def variable(self, kind: Kind, uses: tuple[str, ...] = ()) -> Variable:
        """The signal as a row of a table.

        Args:
            kind: its role; what is calculated has no start.
            uses: names of the variables that its equation needs.
        """
        calculated = kind in (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT)
        start = None if calculated else self.start
        # FMI forbids a nominal value of zero.
        nominal = abs(self.start) or 1.0
        return Variable(
            self.name,
            kind,
            Type.REAL,
            self.unit,
            start=start,
            min=self.min,
            max=self.max,
            nominal=nominal,
            description=self.description,
            uses=uses,
        )


def plant_model(
    name: str,
    *,
    states: Sequence[Signal],
    inputs: Sequence[Signal],
    disturbances: Sequence[Signal],
    outputs: Sequence[Signal],
    parameters: Sequence[Signal] = (),
    hidden: Sequence[Signal] = (),
    sampling_time: float,
    description: str = "",
) -> FmuModel:
    """The table of an FMU from the signals of a plant.

    Each state x has a derivative ``der(x)`` (in C ``VR_der_x``) and a start parameter ``x_start``,
    each disturbance d a mean ``d_nominal``, a ``d_range`` and a ``d_time_constant`` [s]: 0, and it
    is drawn anew in each sample, else the draws are filtered. Beside them are the switches:
    ``stochastic``, ``law`` (1 uniform, 2 normal; FMI 2.0 has an integer ``law_number``, too),
    ``seed``, ``seedHigh`` (FMI 2.0), ``sampling_time`` [s] and ``saturate``, with which an input
    beyond its range acts at the bound.

    Args:
        name: the model's name, a C identifier.
        states: with the values at the start.
        inputs: with their defaults.
        disturbances: drawn anew at the multiples of the sampling time.
        outputs: what else the equations set.
        parameters: of the equations, tunable.
        hidden: further states, which no controller measures: the terminal does not have them.
        sampling_time: in s.
        description: of the plant, for the model description.

    Returns:
        The model; `build_plant` makes its FMU.
    """
    # What the equations may use: who wrote them is not asked which of these they do.
    every_state = (*states, *hidden)
    given = (*every_state, *inputs, *disturbances, *parameters)
    known = tuple(signal.name for signal in given)
    switches = _switches(sampling_time)
    # What the draws hang on; the other switch is about the inputs.
    draws = tuple(switch.name for switch in switches if switch.name != "saturate")
    table = [Variable("time", Kind.INDEPENDENT, unit="s", description="time")]
    for state in every_state:
        table.append(state.variable(Kind.STATE, uses=(f"{state.name}_start",)))
    for state in every_state:
        rate = Signal(
            f"der({state.name})",
            f"{state.unit}/s",
            # For the nominal value alone: what is calculated has no start.
            start=state.start,
            min=-1e6,
            max=1e6,
            description=f"time derivative of {state.name}",
        )
        table.append(rate.variable(Kind.DERIVATIVE, uses=known))
    for signal in inputs:
        table.append(signal.variable(Kind.INPUT))
    for disturbance in disturbances:
        law = (f"{disturbance.name}_nominal", f"{disturbance.name}_range")
        table.append(disturbance.variable(Kind.OUTPUT, uses=(*law, *draws, "time")))
    for output in outputs:
        table.append(output.variable(Kind.OUTPUT, uses=known))
    table += switches
    for disturbance in disturbances:
        table += _law_of(disturbance)
    for state in every_state:
        start = replace(
            state,
            name=f"{state.name}_start",
            description=f"{state.name} at the start",
        )
        table.append(start.variable(Kind.FIXED))
    for parameter in parameters:
        table.append(parameter.variable(Kind.TUNABLE))
    # Last, so that the other value references are those of a plant made before there were filters.
    for disturbance in disturbances:
        table.append(_time_constant_of(disturbance))
    return FmuModel(
        name=name,
        identifier=name,
        description=description,
        variables=tuple(table),
        step_size=sampling_time,
        model_exchange=True,
        terminal=tuple(s.name for s in (*states, *inputs)),
    )


def _switches(sampling_time: float) -> list[Variable]:
    """The switches of every plant, at this sampling time [s]."""
    switches = read_variables(RESOURCES / "switches.csv")
    for position, variable in enumerate(switches):
        if variable.name == "sampling_time":
            switches[position] = replace(variable, start=sampling_time, nominal=sampling_time)
    return switches


def _law_of(disturbance: Signal) -> tuple[Variable, Variable]:
    """Mean and range of a disturbance, which are its parameters."""
    name = disturbance.name
    mean = replace(
        disturbance,
        name=f"{name}_nominal",
        description=f"mean {disturbance.description}",
    )
    # A wider one would leave the disturbance's range whatever the mean.
    widest = disturbance.max - disturbance.min
    spread = Signal(
        f"{name}_range",
        disturbance.unit,
        start=disturbance.range,
        min=0.0,
        max=widest,
        description="half width (uniform) or standard deviation (normal)",
    )
    return mean.variable(Kind.TUNABLE), spread.variable(Kind.TUNABLE)


def _time_constant_of(disturbance: Signal) -> Variable:
    """Time constant of the filter of a disturbance's draws, which is a parameter."""
    time_constant = Signal(
        f"{disturbance.name}_time_constant",
        "s",
        start=disturbance.time_constant,
        min=0.0,
        max=LARGEST_TIME_CONSTANT,
        description=f"time constant of the filter of the {disturbance.description}; "
        "0: drawn anew in each sample",
    )
    return time_constant.variable(Kind.FIXED)


def build_plant(
    model: FmuModel,
    equations: str | bytes,
    target: str | Path,
    version: FmiVersion = 2,
    every_platform: bool = False,
) -> Path:
    """Compile a plant's equations into an FMU, for co-simulation and model exchange.

    It has snapshots and their serialisation, draws that are a function of seed and sample, filters
    of them whose values are part of its state. It is integrated by fourth-order Runge–Kutta steps
    of at most 1 s, which are cut where they would err by more than about 1e-6 of a state; a step
    in which the plant changes too fast for that, or grows without bound, is an error.

    Args:
        model: the table of its variables, by `plant_model`.
        equations: a C header that includes ``variables.h`` and defines ``static void
            evaluate(double v[N_VARIABLES])``: from the states, inputs, disturbances and parameters
            in `v`, each at its value reference ``VR_name``, it sets the outputs and the states'
            derivatives per second.
        target: path of the FMU.
        version: major version of FMI.
        every_platform: build for each of `PLATFORMS`, and not for the platform at hand alone.

    Returns:
        The path of the FMU.

    Raises:
        BuildError: if there is no compiler or it refuses the equations.
    """
    disturbances = []
    for name in model.by_name:
        # Each has a parameter of this name (`_law_of`).
        if name.endswith("_nominal"):
            disturbances.append(name.removesuffix("_nominal"))
    states = [model.by_name[name].identifier for name in model.names(Kind.STATE)]
    header = render("states.h", model=model, states=states, drawn=disturbances)
    content = equations.encode() if isinstance(equations, str) else equations
    sources = {}
    for name in _SHARED:
        sources[name] = (SOURCES / name).read_bytes()
    sources |= files_of("plant_sources")
    sources["equations.h"] = content
    sources["states.h"] = header.encode()
    complete = replace(model, sources=sources)
    return build_model(complete, target, version, every_platform=every_platform)


SHIPPED_PLANTS = {
    "reactor": ("Exothermic stirred-tank reactor with disturbed feed", 12.0),
    # Johansson (2000)
    "tanks": ("Quadruple tank with water drawn at random from the lower tanks", 5.0),
    "heater": ("Heated tank whose product is measured behind a pipe, a dead time", 60.0),
    "unstable_reactor": ("Exothermic reactor at an unstable steady state", 30.0),
}
"""By its name each plant's description and sampling time [s]."""
_ROLES = ("states", "hidden", "inputs", "disturbances", "outputs", "parameters")


def model(name: str) -> FmuModel:
    """The table of a plant of `SHIPPED_PLANTS`."""
    # Each role, also one that the table has no signal of.
    signals: dict[str, list[Signal]] = {role: [] for role in _ROLES}
    with (RESOURCES / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            signal = Signal(
                row["name"],
                row["unit"],
                start=float(row["start"]),
                min=float(row["min"]),
                max=float(row["max"]),
                description=row["description"],
                range=float(row["range"] or 0.0),
            )
            signals[row["role"]].append(signal)
    description, sampling_time = SHIPPED_PLANTS[name]
    return plant_model(name, description=description, sampling_time=sampling_time, **signals)


def equations(name: str) -> bytes:
    """The C header with a plant's right-hand side."""
    return (PACKAGE / "equations" / f"{name}.h").read_bytes()


def build_shipped_plants(folder: Path, every_platform: bool = False) -> list[Path]:
    """Build the FMUs (FMI 2.0) of `SHIPPED_PLANTS`.

    Args:
        folder: where they are written.
        every_platform: build for each of `PLATFORMS`, and not for the platform at hand alone.

    Returns:
        Their paths.
    """
    built = []
    for name in SHIPPED_PLANTS:
        fmu = build_plant(
            model(name),
            equations(name),
            folder / f"{name}.fmu",
            version=2,
            every_platform=every_platform,
        )
        built.append(fmu)
    return built
