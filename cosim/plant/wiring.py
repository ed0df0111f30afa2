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
"""FMI's types of numbers that are not whole."""
WIDE_INTEGERS = ("Int64", "UInt64")
INTEGERS = ("Integer", "Int32", "UInt32", *WIDE_INTEGERS)
"""Types that can take a word of the seed."""
NO_NUMBERS = ("Boolean", "Enumeration", "String", "Binary", "Clock")


def refusals(fmu: UnpackedFmu, step: float | None = None) -> Iterator[str]:
    """Every reason for which `FmuPlant` refuses the FMU, as its error message says it.

    Args:
        fmu: the file.
        step: communication step in s. One that is no multiple of a fixed internal step is a reason;
            canHandleVariableCommunicationStepSize = false asks for steps of one size, whichever it
            be.
    """
    name = f"FMU '{fmu.path}'"
    simulation = fmu.description.coSimulation
    if simulation is None:
        yield f"{name} has no co-simulation interface (it has: {_other_interfaces(fmu)})"
    else:
        try:
            library_path(fmu)
        except PlantError as error:
            yield str(error)
        internal = number(simulation.fixedInternalStepSize, 0.0)
        # Within rounding: both are decimal fractions of a second.
        count = step / internal if step and internal > 0 else 1.0
        whole = round(count)
        if whole < 1 or abs(count - whole) > 1e-9 * count:
            yield (
                f"{name} steps by multiples of {internal:g} s (fixedInternalStepSize), and the "
                f"communication step of {step:g} s is none"
            )
    can_be_acted_on = False
    can_be_seen = False
    for variable in fmu.description.modelVariables:
        if variable.type in NO_NUMBERS:
            continue
        if _can_act(variable):
            can_be_acted_on = True
        if variable.causality in ("output", "local"):
            can_be_seen = True
    if not can_be_acted_on:
        yield (
            f"{name} has no input and no tunable parameter that is a number: there is nothing for "
            "a controller to act on"
        )
    if not can_be_seen:
        yield f"{name} has no output that is a number: there is nothing for a controller to see"


def _other_interfaces(fmu: UnpackedFmu) -> str:
    """FMI's interfaces that the FMU has beside co-simulation, in words."""
    names = []
    if fmu.description.modelExchange is not None:
        names.append("model exchange")
    if fmu.description.scheduledExecution is not None:
        names.append("scheduled execution")
    return ", ".join(names) or "none"


def has_start(variable: Any) -> bool:
    """Whether an importer may set the variable's start value, by FMI's causality and `initial`."""
    if variable.variability == "constant":
        return False
    # FMI's default for these is "calculated": the FMU then has no start to set.
    if variable.causality in ("output", "local"):
        return variable.initial in ("exact", "approx")
    return variable.causality not in ("calculatedParameter", "independent")


def interface(fmu: UnpackedFmu) -> type[Fmi2Instance] | type[Fmi3Instance]:
    """The class of an FMU's instances, by its version of FMI."""
    # Another version has been refused as the FMU was unpacked.
    if fmu.description.fmiVersion.startswith("2"):
        return Fmi2Instance
    return Fmi3Instance


def experiment(fmu: UnpackedFmu, plant: PlantTable | None = None) -> Experiment:
    """Start time, stop time and tolerance that an FMU gets: the scenario's, else its own defaults.

    A default stop time is left out: a run may well go on beyond it.

    Args:
        fmu: has the defaults.
        plant: the scenario's table; None: the defaults alone.

    Raises:
        PlantError: the stop time is not after the start time.
    """
    default = fmu.description.defaultExperiment
    start = number(getattr(default, "startTime", None), 0.0)
    # No solver keeps to a tolerance of 0: it is none.
    tolerance = number(getattr(default, "tolerance", None), 0.0) or None
    if plant is None:
        return Experiment(start, None, tolerance)
    if plant.start_time is not None:
        start = plant.start_time
    # Only here both are known: either may be the file's.
    if plant.stop_time is not None and plant.stop_time <= start:
        raise PlantError(
            f"plant.stop_time of {plant.stop_time:g} s is not after the start time of {start:g} s, "
            f"which is that of FMU '{fmu.path.name}'"
        )
    return Experiment(start, plant.stop_time, plant.tolerance or tolerance)


class Wiring:
    """Places in an FMU of the variables that a scenario names.

    Args:
        scenario: names the variables.
        fmu: has them.

    Attributes:
        inputs, states: places of the actions and states.
        outputs: places of the stage cost, which is the first, the disturbances, and what signals
            are the prices of.
        sensors: places of the variables that sensors read.
        signals: places of the variables that signals drive.
        seeds: places of the seed's words, low word first.
        initial: places of the parameters for the initial state.
        starts: places and values of all start values.

    Raises:
        PlantError: a variable is not there, or of no use for what it is named for.
    """

    def __init__(self, scenario: Scenario, fmu: UnpackedFmu) -> None:
        plant = scenario.plant
        mapping = plant.mapping
        sensors = scenario.sensors or ()
        signals = scenario.signals or ()
        self._scenario = scenario
        self._fmu = fmu
        self.interface = interface(fmu)
        self.experiment = experiment(fmu, plant)
        own_outputs = (plant.stage_cost, *plant.disturbances)
        self.outputs = self._number_places(own_outputs, "plant")
        # Behind these, so that the disturbances stay where they are.
        self.outputs += self._number_places(scenario.priced, "signal")
        self.states = self._number_places(plant.states, "plant.states")
        sensed = [sensor.variable for sensor in sensors]
        self.sensors = self._number_places(sensed, "sensor")
        self.initial = self._number_places(mapping.initial_state, "plant.mapping.initial_state")
        self.seeds: list[Place] = []
        for name in mapping.seed:
            # One of 64 bits takes both words.
            if self.seeds and self.seeds[-1].type in WIDE_INTEGERS:
                continue
            place = self._place(name, "plant.mapping.seed", _no_word)
            self.seeds.append(place)
        # Names of the first of the starts; the seed's words stand behind them.
        self.start_names: list[str] = []
        self.starts = self._start_places()
        self._require_whole_arrays([place for place, _ in self.starts])
        self.inputs = self._written_places(plant.actions, "plant.actions")
        driven = [signal.plant for signal in signals if signal.plant is not None]
        self.signals = self._written_places(driven, "signal")

    def changes(self) -> dict[int, tuple[list[Place], list[float]]]:
        """Places to write at the start of a sample, and the values, by the sample's number."""
        scenario = self._scenario
        changes: dict[int, tuple[list[Place], list[float]]] = {}
        for change in scenario.plant.changes or ():
            # At the first sample that begins at its time or later.
            sample = ceil(change.time / scenario.sampling_time)
            # Two changes may come to one sample.
            if sample not in changes:
                changes[sample] = ([], [])
            places, values = changes[sample]
            for name, value in change.parameters.items():
                place = self._place(name, "plant.changes", _not_written)
                places.append(place)
                values.append(value)
        for places, _ in changes.values():
            self._require_whole_arrays(places)
        return changes

    def _number_places(self, names: Sequence[str], table: str) -> list[Place]:
        return [self._place(name, table, _no_number) for name in names]

    def _written_places(self, names: Sequence[str], table: str) -> list[Place]:
        """Places of variables that are written between two steps."""
        places = [self._place(name, table, _not_written) for name in names]
        self._require_whole_arrays(places)
        return places

    def _start_places(self) -> list[tuple[Place, float]]:
        """Places and values of all that the scenario sets before an episode, the seed as 0."""
        scenario = self._scenario
        plant = scenario.plant
        mapping = plant.mapping
        law = scenario.disturbance
        # An FMU with one law has no code for it.
        codes = []
        if law.law in mapping.law_codes:
            code = mapping.law_codes[law.law]
            codes.append(code)
        stochastic = float(law.law != "none")
        ranges = law.ranges
        # Without a switch nothing else keeps the FMU from drawing.
        if not stochastic and not mapping.stochastic:
            ranges = (0.0,) * len(mapping.ranges)
        starts: list[tuple[Place, float]] = []

        def add(
            field: str,
            names: str | Sequence[str] | None,
            values: Sequence[float],
        ) -> None:
            listed = [names] if isinstance(names, str) else names or ()
            # Either may be left out; the scenario has checked that they fit.
            for name, value in zip(listed, values, strict=False):
                start = self._start_value(name, float(value), field)
                starts.append(start)

        add("plant.mapping.initial_state", mapping.initial_state, plant.initial_state)
        add("plant.mapping.sampling_time", mapping.sampling_time, [scenario.sampling_time])
        add("plant.mapping.stochastic", mapping.stochastic, [stochastic])
        add("plant.mapping.law", mapping.law, codes)
        add("plant.mapping.nominal", mapping.nominal, law.nominal)
        add("plant.mapping.ranges", mapping.ranges, ranges)
        if law.time_constant is not None:
            add("plant.mapping.time_constant", mapping.time_constant, law.time_constant)
        else:
            # Left out they are 0, whatever the FMU's own are; an FMU that has none draws anew.
            for name in mapping.time_constant or ():
                if self._fmu.variable(name) is not None:
                    add("plant.mapping.time_constant", name, [0.0])
        # After all others: what the user sets by name is in force.
        for name, value in plant.parameters.items():
            add("plant.parameters", name, [value])
        # Each reset puts the episode's words in the place of these (`seed_words`).
        for place in self.seeds:
            starts.append((place, 0.0))
        return starts

    def _start_value(
        self,
        name: str,
        value: float,
        table: str,
    ) -> tuple[Place, float]:
        def misfit(variable: Any) -> str:
            if variable.type not in self.interface.setters:
                return f"is {_a(variable.type)}, which cannot be set here"
            # It would be rounded without a word as it is written.
            if variable.type not in REALS and value != int(value):
                return f"is {_a(variable.type)} and cannot take {value}"
            if not has_start(variable):
                return f"is {_a(variable.causality)} without a start to set"
            return ""

        self.start_names.append(name)
        place = self._place(name, table, misfit)
        return place, value

    def _place(
        self,
        name: str,
        table: str,
        misfit: Callable[[Any], str],
    ) -> Place:
        """Address of variable `name`, or of an element ``NAME[i]``, ``NAME[i,j]`` of an array.

        `misfit` says what is wrong with a variable, if anything.
        """
        fmu = self._fmu
        asked = f"{table} of scenario '{self._scenario.name}' names"
        variable = fmu.variable(name)
        if variable is None:
            raise PlantError(
                f"FMU '{fmu.path.name}' has no variable '{name}'{suggestion(name, fmu.variables)}, "
                f"which {asked}"
            )
        shape = self._shape(variable)
        index = 0
        # The kind first: of a wrong variable no element helps.
        fault = misfit(variable)
        if shape and not fault:
            brackets = name.removeprefix(variable.name)
            words = brackets.removeprefix("[").removesuffix("]").split(",")
            # No number, another count of them, or one beyond the array's end.
            try:
                indices = [int(word) for word in words]
                index = int(np.ravel_multi_index(indices, shape))
            except ValueError:
                last = ",".join(str(size - 1) for size in shape)
                fault = f"is of an array of {shape}: name an element, up to {variable.name}[{last}]"
        if fault:
            raise PlantError(f"variable '{name}' of FMU '{fmu.path.name}' {fault}; {asked} it")
        size = prod(shape)
        unknown = (nan,) * size
        return Place(
            reference=int(variable.valueReference),
            type=str(variable.type),
            element=index,
            starts=_start_values(variable, size) or unknown,
            structural=variable.causality == "structuralParameter",
        )

    def _require_whole_arrays(self, places: Sequence[Place]) -> None:
        """Raise PlantError where an array whose start values are not known is set in part."""
        # FMI sets an array as a whole, so that the elements nobody names need a value.
        named_elements: dict[tuple[int, str], set[int]] = {}
        unknown = []
        for place in places:
            if any(map(isnan, place.starts)):
                unknown.append(place)
                array = (place.reference, place.type)
                named_elements.setdefault(array, set()).add(place.element)
        for place in unknown:
            array = (place.reference, place.type)
            n_elements = len(place.starts)
            if len(named_elements[array]) == n_elements:
                continue
            raise PlantError(
                f"array '{self._name_of(place)}' of FMU '{self._fmu.path.name}' has "
                f"{n_elements} elements by plant.parameters, for which its description "
                f"states no start values: scenario '{self._scenario.name}' must name each where "
                "it names one"
            )

    def _name_of(self, place: Place) -> str:
        """Name of the variable at a place."""
        for variable in self._fmu.variables.values():
            if (variable.valueReference, variable.type) == (place.reference, place.type):
                return str(variable.name)
        raise AssertionError(place)

    def _shape(self, variable: Any) -> tuple[int, ...]:
        """Shape of a variable, by the structural parameters as the scenario sets them."""
        # FMI 3.0: a dimension may be a parameter, which the scenario may set.
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
    stated = ["0"]
    if variable.type not in NO_NUMBERS:
        stated = str(variable.start or 0).split()
    if size == 1:
        # Its name gives all of it.
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
    if variable.type in INTEGERS:
        return ""
    return f"is {_a(variable.type)}, not an integer of 32 or 64 bits"


def _a(noun: str) -> str:
    # Not of "UInt32", which begins with a sound of y.
    article = "an" if noun[:1].lower() in "aeio" else "a"
    return f"{article} {noun}"


def seed_words(seed: int, places: Sequence[Place]) -> list[tuple[Place, int]]:
    """A seed in words, low word first, each with its place.

    Args:
        seed: in [0, 2⁶⁴).
        places: `Wiring.seeds`.

    Raises:
        PlantError: the seed is no such integer.
    """
    # NumPy's integers are some too, and a float is none.
    try:
        integer = operator.index(seed)
    except TypeError:
        integer = -1
    if not 0 <= integer < 1 << 64:
        raise PlantError(f"seed must be an integer in [0, 2^64), not {seed!r}")
    words = []
    for place in places:
        bits = 64 if place.type in WIDE_INTEGERS else 32
        lowest_bits = (1 << bits) - 1
        words.append((place, integer & lowest_bits))
        integer >>= bits
    return words


def start_values(scenario: Scenario, plant_seed: int) -> dict[str, tuple[str, float]]:
    """FMI type and value of each parameter that differs by scenario, the seed's words too.

    Args:
        scenario: names FMU and parameters.
        plant_seed: 64 bits, the first of `cosim.core.simulation.spawn_seeds`.

    Raises:
        PlantError: the scenario's FMU does not fit it.
    """
    fmu = unpack(scenario.plant.fmu)
    wiring = Wiring(scenario, fmu)
    # FMI 2.0 counts value references anew for each type.
    names = {}
    for name, variable in fmu.variables.items():
        reference = int(variable.valueReference)
        names[reference, variable.type] = name
    values: dict[str, tuple[str, float]] = {}
    for place, start in wiring.starts:
        name = names[place.reference, place.type]
        values[name] = (place.type, start)
    # After the starts, in which the seed's words are 0.
    for place, word in seed_words(plant_seed, wiring.seeds):
        name = names[place.reference, place.type]
        signed = word
        # FMI 2.0's Integer has a sign.
        if place.type == "Integer" and word >= 1 << 31:
            signed -= 1 << 32
        values[name] = (place.type, signed)
    return values
