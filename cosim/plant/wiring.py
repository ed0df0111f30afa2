"""An FMU wired by a scenario: places of its variables, start values, why it may be refused."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from math import ceil, isnan, nan, prod
from typing import Any

import numpy as np

from cosim.core.errors import PlantError
from cosim.core.scenario import PlantTable, Scenario
from cosim.core.validation import suggestion
from cosim.plant.fmi import (
    Experiment,
    Fmi2Instance,
    Fmi3Instance,
    Place,
    UnpackedFmu,
    library_path,
    number,
    unpack,
)

REALS = ("Real", "Float64", "Float32")


def refusals(fmu: UnpackedFmu, step: float | None = None) -> Iterator[str]:
    """Every reason for which `FmuPlant` refuses the FMU, as its error message says it.

    One is a communication `step` [s] that is no multiple of a fixed internal step;
    canHandleVariableCommunicationStepSize = false asks for steps of one size, whichever it be.
    """
    description, name = fmu.description, f"FMU '{fmu.path}'"
    simulation = description.coSimulation
    if simulation is None:
        faces = {
            "model exchange": description.modelExchange,
            "scheduled execution": description.scheduledExecution,
        }
        others = ", ".join(words for words, face in faces.items() if face is not None)
        yield f"{name} has no co-simulation interface (it has: {others or 'none'})"
    else:
        try:
            library_path(fmu)
        except PlantError as error:
            yield str(error)
        internal = number(simulation.fixedInternalStepSize, 0.0)
        count = step / internal if step and internal > 0 else 1.0
        if round(count) < 1 or abs(count - round(count)) > 1e-9 * count:
            yield (
                f"{name} steps by multiples of {internal:g} s (fixedInternalStepSize), and the "
                f"communication step of {step:g} s is none"
            )
    numbers = [v for v in description.modelVariables if v.type not in NO_NUMBERS]
    if not any(_can_act(variable) for variable in numbers):
        yield (
            f"{name} has no input and no tunable parameter that is a number: there is nothing for "
            "a controller to act on"
        )
    if not any(v.causality in ("output", "local") for v in numbers):
        yield f"{name} has no output that is a number: there is nothing for a controller to see"


_WIDE = ("Int64", "UInt64")
INTEGERS = ("Integer", "Int32", "UInt32", *_WIDE)
NO_NUMBERS = ("Boolean", "Enumeration", "String", "Binary", "Clock")


def has_start(variable: Any) -> bool:
    """Whether an importer may set the variable's start value, by FMI's causality and `initial`."""
    if variable.variability == "constant":
        return False
    if variable.causality in ("output", "local"):
        return variable.initial in ("exact", "approx")
    return variable.causality not in ("calculatedParameter", "independent")


def interface(fmu: UnpackedFmu) -> type[Fmi2Instance] | type[Fmi3Instance]:
    """The class of an FMU's instances, by its version of FMI."""
    return Fmi2Instance if fmu.description.fmiVersion[0] == "2" else Fmi3Instance


def experiment(fmu: UnpackedFmu, plant: PlantTable | None = None) -> Experiment:
    """What an FMU is told of the simulation: what a scenario states, else its own default.

    A default stop time is left out: a run may well go on beyond it.
    """
    default = fmu.description.defaultExperiment
    start = number(getattr(default, "startTime", None), 0.0)
    tolerance = number(getattr(default, "tolerance", None), 0.0) or None
    if plant is None:
        return Experiment(start, None, tolerance)
    if plant.start_time is not None:
        start = plant.start_time
    if plant.stop_time is not None and plant.stop_time <= start:
        raise PlantError(
            f"plant.stop_time of {plant.stop_time:g} s is not after the start time of {start:g} s, "
            f"which is that of FMU '{fmu.path.name}'"
        )
    return Experiment(start, plant.stop_time, plant.tolerance or tolerance)


class Wiring:
    """Places in an FMU of the variables that a scenario names; raises PlantError on any misfit.

    They are `inputs`, `outputs` (stage cost first), `states`, the `seeds`, low word first, the
    parameters for the `initial` state, and all `starts` with their values.
    """

    def __init__(self, scenario: Scenario, fmu: UnpackedFmu) -> None:
        self._scenario, self._fmu, plant = scenario, fmu, scenario.plant
        self.interface = interface(fmu)
        self.experiment = experiment(fmu, plant)
        self.outputs = self._numbers((plant.stage_cost, *plant.disturbances), "plant")
        self.states = self._numbers(plant.states, "plant.states")
        self.initial = self._numbers(plant.mapping.initial_state, "plant.mapping.initial_state")
        self.seeds: list[Place] = []
        for name in plant.mapping.seed:
            if not (self.seeds and self.seeds[-1].type in _WIDE):
                self.seeds.append(self._place(name, "plant.mapping.seed", _no_word))
        self.start_names: list[str] = []
        self.starts = self._starts()
        self._require_whole_arrays([place for place, _ in self.starts])
        self.inputs = [self._place(name, "plant.actions", _not_written) for name in plant.actions]
        self._require_whole_arrays(self.inputs)

    def changes(self) -> dict[int, tuple[list[Place], list[float]]]:
        """By the number of a sample the places to write at its start, and the values."""
        scenario = self._scenario
        found: dict[int, tuple[list[Place], list[float]]] = {}
        for change in scenario.plant.changes or ():
            places, values = found.setdefault(ceil(change.time / scenario.sampling_time), ([], []))
            for name, value in change.parameters.items():
                places.append(self._place(name, "plant.changes", _not_written))
                values.append(value)
        for places, _ in found.values():
            self._require_whole_arrays(places)
        return found

    def _numbers(self, names: Sequence[str], table: str) -> list[Place]:
        return [self._place(name, table, _no_number) for name in names]

    def _starts(self) -> list[tuple[Place, float]]:
        scenario, mapping = self._scenario, self._scenario.plant.mapping
        law, codes = scenario.disturbance, mapping.law_codes
        fields: dict[str, tuple[str | Sequence[str] | None, Sequence[float]]] = {
            "initial_state": (mapping.initial_state, scenario.plant.initial_state),
            "sampling_time": (mapping.sampling_time, [scenario.sampling_time]),
            "stochastic": (mapping.stochastic, [float(law.law != "none")]),
            "law": (mapping.law, [codes[law.law]] if law.law in codes else []),
            "nominal": (mapping.nominal, law.nominal),
            "ranges": (mapping.ranges, law.ranges),
        }
        starts = []
        for field, (names, values) in fields.items():
            listed = [names] if isinstance(names, str) else names or ()
            # Either may be left out; the scenario has checked that they fit.
            for name, value in zip(listed, values, strict=False):
                starts.append(self._start_value(name, float(value), f"plant.mapping.{field}"))
        for name, value in scenario.plant.parameters.items():
            starts.append(self._start_value(name, float(value), "plant.parameters"))
        return starts + [(place, 0.0) for place in self.seeds]

    def _start_value(self, name: str, value: float, table: str) -> tuple[Place, float]:
        def misfit(variable: Any) -> str:
            if variable.type not in self.interface.setters:
                return f"is {_a(variable.type)}, which cannot be set here"
            if variable.type not in REALS and value != int(value):
                return f"is {_a(variable.type)} and cannot take {value}"
            if not has_start(variable):
                return f"is {_a(variable.causality)} without a start to set"
            return ""

        self.start_names.append(name)
        return self._place(name, table, misfit), value

    def _place(self, name: str, table: str, misfit: Callable[[Any], str]) -> Place:
        """Where variable `name`, or element ``NAME[i]``, ``NAME[i,j]`` of an array, is.

        `misfit` says what is wrong with a variable, if anything.
        """
        fmu, asked = self._fmu, f"{table} of scenario '{self._scenario.name}' names"
        if (variable := fmu.variable(name)) is None:
            raise PlantError(
                f"FMU '{fmu.path.name}' has no variable '{name}'{suggestion(name, fmu.variables)}, "
                f"which {asked}"
            )
        what, shape, index = misfit(variable), self._shape(variable), 0
        if shape and not what:
            try:
                indices = name.removeprefix(variable.name).removeprefix("[").removesuffix("]")
                index = int(np.ravel_multi_index([int(i) for i in indices.split(",")], shape))
            except ValueError:
                last = ",".join(str(n - 1) for n in shape)
                what = f"is of an array of {shape}: name an element, up to {variable.name}[{last}]"
        if what:
            raise PlantError(f"variable '{name}' of FMU '{fmu.path.name}' {what}; {asked} it")
        structural = variable.causality == "structuralParameter"
        starts = _start_values(variable, prod(shape)) or (nan,) * prod(shape)
        reference = int(variable.valueReference)
        return Place(reference, str(variable.type), index, starts, structural)

    def _require_whole_arrays(self, places: Sequence[Place]) -> None:
        """Raise PlantError where an array whose start values are not known is set in part."""
        unknown = [place for place in places if any(map(isnan, place.starts))]
        for place in unknown:
            named = {other.element for other in unknown if other[:2] == place[:2]}
            if len(named) < len(place.starts):
                name = next(
                    variable.name
                    for variable in self._fmu.variables.values()
                    if (variable.valueReference, variable.type) == place[:2]
                )
                raise PlantError(
                    f"array '{name}' of FMU '{self._fmu.path.name}' has {len(place.starts)} "
                    "elements by plant.parameters, for which its description states no start "
                    f"values: scenario '{self._scenario.name}' must name each where it names one"
                )

    def _shape(self, variable: Any) -> tuple[int, ...]:
        """Shape of a variable, by the structural parameters as the scenario sets them."""
        parameters = self._scenario.plant.parameters
        shape = []
        for dimension in variable.dimensions:
            size = dimension.start
            if size is None:
                by = dimension.variable
                size = parameters.get(by.name, number(by.start, 0.0))
            shape.append(int(size))
        return tuple(shape)


def _start_values(variable: Any, size: int) -> tuple[float, ...] | None:
    """Start values of a variable of so many elements; None where it states another number of them.

    That is so where a structural parameter gives an array another size.
    """
    stated = ["0"] if variable.type in NO_NUMBERS else str(variable.start or 0).split()
    if size == 1:  # its name gives all of it
        stated = stated[:1]
    elif len(stated) == 1:
        stated *= size
    if len(stated) != size:
        return None
    return tuple(number(text, 0.0) for text in stated)


def _no_number(variable: Any) -> str:
    return f"is {_a(variable.type)}, not a number" if variable.type in NO_NUMBERS else ""


def _can_act(variable: Any) -> bool:
    """Whether a variable can be written between two steps; a structural parameter cannot."""
    tunable = variable.variability == "tunable" and variable.causality == "parameter"
    return tunable or bool(variable.causality == "input")


def _not_written(variable: Any) -> str:
    if not _can_act(variable):
        return f"is {_a(variable.causality)}, not an input, and is not tunable"
    return _no_number(variable)


def _no_word(variable: Any) -> str:
    what = f"is {_a(variable.type)}, not an integer of 32 or 64 bits"
    return "" if variable.type in INTEGERS else what


def _a(noun: str) -> str:
    return f"{'an' if noun[:1].lower() in 'aeio' else 'a'} {noun}"


def seed_words(seed: int, places: Sequence[Place]) -> list[tuple[Place, int]]:
    """A seed's words for the `places` of `Wiring.seeds`, each with its own.

    Raises PlantError for anything but an integer in [0, 2⁶⁴).
    """
    try:
        integer = operator.index(seed)
    except TypeError:
        integer = -1
    if not 0 <= integer < 1 << 64:
        raise PlantError(f"seed must be an integer in [0, 2^64), not {seed!r}")
    words, shift = [], 0
    for place in places:
        bits = 64 if place.type in _WIDE else 32
        words.append((place, integer >> shift & (1 << bits) - 1))
        shift += bits
    return words


def start_values(scenario: Scenario, plant_seed: int) -> dict[str, tuple[str, float]]:
    """FMI type and value of each parameter that differs by scenario, the seed's words too.

    `plant_seed`, 64 bits, is the first of `cosim.core.simulation.spawn_seeds`; an Integer, which
    has 32 bits and a sign, takes its low word, the next one the high word. Raises PlantError where
    the scenario's FMU does not fit it.
    """
    fmu = unpack(scenario.plant.fmu)
    wiring = Wiring(scenario, fmu)
    names = {(int(v.valueReference), v.type): name for name, v in fmu.variables.items()}
    found = {names[place[:2]]: (place.type, value) for place, value in wiring.starts}
    for place, value in seed_words(plant_seed, wiring.seeds):
        signed = value - (1 << 32) if value >= 1 << 31 and place.type == "Integer" else value
        found[names[place[:2]]] = (place.type, signed)
    return found
