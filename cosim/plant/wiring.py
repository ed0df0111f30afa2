"""Whether an FMU can be a scenario's plant, and which of its variables are the scenario's."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from math import ceil, inf
from typing import Any

import numpy as np

from cosim.errors import PlantError
from cosim.plant.archive import UnpackedFmu, unpack
from cosim.plant.fmi import Fmi2Instance, Instance, StartValue, Wiring, library_path
from cosim.protocols import Array
from cosim.scenario import Scenario
from cosim.validation import suggestion

_REAL = ("Real", "Float64")


def refusals(fmu: UnpackedFmu) -> Iterator[str]:
    """Every reason for which `FmuPlant` refuses the FMU, as its error message says it."""
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
        if simulation.needsExecutionTool:
            yield (
                f"{name} needs the tool that made it to run (needsExecutionTool); export it as an "
                "FMU that stands alone"
            )
        try:
            library_path(fmu)
        except PlantError as error:
            yield str(error)
    scalars = [v for v in description.modelVariables if v.type in _REAL and not v.dimensions]
    if not any(v.causality == "input" or v.variability == "tunable" for v in scalars):
        yield (
            f"{name} has no scalar real input and no tunable parameter: there is nothing for a "
            "controller to act on"
        )
    if not any(v.causality in ("output", "local") for v in scalars):
        yield f"{name} has no scalar real output: there is nothing for a controller to see"


def check_step(fmu: UnpackedFmu, sampling_time: float) -> None:
    """Raise PlantError where the sampling time [s] is no multiple of a fixed internal step.

    canHandleVariableCommunicationStepSize = false asks for steps of one size, whichever it be.
    """
    internal = fmu.description.coSimulation.fixedInternalStepSize
    if internal is None or float(internal) <= 0:
        return
    count = sampling_time / float(internal)
    if round(count) < 1 or abs(count - round(count)) > 1e-9 * count:
        raise PlantError(
            f"FMU '{fmu.path}' steps by multiples of {float(internal):g} s "
            f"(fixedInternalStepSize), and the sampling time of {sampling_time:g} s is none"
        )


_WIDE = ("Int64", "UInt64")


def has_start(variable: Any) -> bool:
    """Whether an importer may set the variable's start value, by FMI's causality and `initial`."""
    if variable.variability == "constant":
        return False
    if variable.causality in ("output", "local"):
        return variable.initial in ("exact", "approx")
    return variable.causality not in ("calculatedParameter", "independent")


class Wirer:
    """Looks up the variables of one FMU for one scenario; raises PlantError on any misfit."""

    def __init__(self, scenario: Scenario, fmu: UnpackedFmu, interface: type[Instance]) -> None:
        self._scenario = scenario
        self._fmu = fmu
        self._interface = interface
        self._variables = {variable.name: variable for variable in fmu.description.modelVariables}

    def wiring(self) -> Wiring:
        """Value references of inputs, outputs (stage cost first), states and start values."""
        plant = self._scenario.plant
        outputs = (plant.stage_cost, *plant.disturbances)
        return Wiring(
            inputs=[self._input(name) for name in plant.actions],
            outputs=[self._real(name, "plant") for name in outputs],
            states=[self._real(name, "plant.states") for name in plant.states],
            starts=self._starts(),
        )

    def changes(self) -> dict[int, tuple[list[int], list[float]]]:
        """By the number of a sample the value references to write at its start, and the values."""
        scenario = self._scenario
        found: dict[int, tuple[list[int], list[float]]] = {}
        for change in scenario.plant.changes or ():
            references, values = found.setdefault(
                ceil(change.time / scenario.sampling_time), ([], [])
            )
            for name, value in change.parameters.items():
                reference = self._real(name, "plant.changes")
                variable = self._variables[name]
                if variable.variability != "tunable" and variable.causality != "input":
                    raise self._misfit(name, "plant.changes", "is not tunable")
                references.append(reference)
                values.append(value)
        return found

    def seeds(self) -> list[tuple[str, int]]:
        """FMI type and value reference of the variables that take the seed, low word first."""
        words = []
        for name in self._scenario.plant.mapping.seed:
            variable = self._find(name, "plant.mapping.seed")
            if variable.type not in (*_WIDE, "Integer", "Int32", "UInt32"):
                what = f"is {_a(variable.type)}, not an integer of 32 or 64 bits"
                raise self._misfit(name, "plant.mapping.seed", what)
            words.append((str(variable.type), int(variable.valueReference)))
            if variable.type in _WIDE:
                break
        return words

    def initial_states(self) -> list[int]:
        """Value references of the states' start parameters; none if the scenario names none."""
        names = self._scenario.plant.mapping.initial_state
        return [self._real(name, "plant.mapping.initial_state") for name in names]

    def state_range(self) -> tuple[Array, Array]:
        """Least and greatest value, (n,), that the FMU declares for the states; else infinite."""
        found = [self._find(name, "plant.states") for name in self._scenario.plant.states]
        lower = [-inf if v.min is None else float(v.min) for v in found]
        upper = [inf if v.max is None else float(v.max) for v in found]
        return np.array(lower), np.array(upper)

    def units(self) -> dict[str, str]:
        """Unit of each exchanged variable by name, empty where the FMU states none."""
        plant = self._scenario.plant
        names = (*plant.states, *plant.actions, *plant.disturbances, plant.stage_cost)
        return {name: _unit(self._find(name, "plant")) for name in names}

    def _starts(self) -> list[StartValue]:
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
            # Either may be left out; the scenario has seen to it that they fit.
            for name, value in zip(listed, values, strict=False):
                starts.append(self._start_value(name, float(value), f"plant.mapping.{field}"))
        for name, value in scenario.plant.parameters.items():
            starts.append(self._start_value(name, float(value), "plant.parameters"))
        return starts + [StartValue(reference, kind, 0.0) for kind, reference in self.seeds()]

    def _start_value(self, name: str, value: float, table: str) -> StartValue:
        variable = self._find(name, table)
        if variable.type not in self._interface.setters:
            raise self._misfit(name, table, f"is {_a(variable.type)}, which cannot be set here")
        if variable.type not in ("Real", "Float64", "Float32") and value != int(value):
            raise self._misfit(name, table, f"is {_a(variable.type)} and cannot take {value}")
        if variable.variability == "constant":
            raise self._misfit(name, table, "is a constant")
        if not has_start(variable):
            raise self._misfit(name, table, f"is {_a(variable.causality)} without a start to set")
        return StartValue(int(variable.valueReference), variable.type, value)

    def _input(self, name: str) -> int:
        reference = self._real(name, "plant.actions")
        variable = self._variables[name]
        if variable.causality != "input" and variable.variability != "tunable":
            raise self._misfit(name, "plant.actions", f"is {_a(variable.causality)}, not an input")
        return reference

    def _real(self, name: str, table: str) -> int:
        variable = self._find(name, table)
        if variable.type != self._interface.real or variable.shape:
            kind = f"{variable.type} array" if variable.shape else variable.type
            raise self._misfit(name, table, f"is {_a(kind)}, not a scalar {self._interface.real}")
        return int(variable.valueReference)

    def _find(self, name: str, table: str) -> Any:
        if name not in self._variables:
            raise PlantError(
                f"FMU '{self._fmu.path.name}' has no variable '{name}'"
                f"{suggestion(name, self._variables)}, which {table} of scenario "
                f"'{self._scenario.name}' names"
            )
        return self._variables[name]

    def _misfit(self, name: str, table: str, what: str) -> PlantError:
        return PlantError(
            f"variable '{name}' of FMU '{self._fmu.path.name}' {what}; {table} of scenario "
            f"'{self._scenario.name}' names it"
        )


def _a(noun: str) -> str:
    return f"{'an' if noun[:1].lower() in 'aeio' else 'a'} {noun}"


def _unit(variable: Any) -> str:
    declared = variable.declaredType.unit if variable.declaredType is not None else None
    return str(variable.unit or declared or "")


def seed_words(seed: int, variables: Sequence[tuple[str, int]]) -> list[tuple[str, int, int]]:
    """A seed's words, each with type and value reference, for variables of `Wirer.seeds`.

    Raises PlantError for anything but an integer in [0, 2⁶⁴).
    """
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if not 0 <= number < 1 << 64:
        raise PlantError(f"seed must be an integer in [0, 2^64), not {seed!r}")
    words, shift = [], 0
    for kind, reference in variables:
        bits = 64 if kind in _WIDE else 32
        words.append((kind, reference, number >> shift & (1 << bits) - 1))
        shift += bits
    return words


def start_values(scenario: Scenario, plant_seed: int) -> dict[str, tuple[str, float]]:
    """FMI 2.0 type and value of each parameter that differs by scenario, the seed's words too.

    `plant_seed`, 64 bits, is the first of `cosim.simulation.spawn_seeds`; an Integer, which has
    32 bits and a sign, takes its low word, the next one the high word. Raises PlantError where the
    scenario's FMU does not fit it.
    """
    fmu = unpack(scenario.plant.fmu)
    wirer = Wirer(scenario, fmu, Fmi2Instance)
    names = {
        (int(variable.valueReference), variable.type): variable.name
        for variable in fmu.description.modelVariables
    }
    found = {
        names[start.reference, start.type]: (start.type, start.value)
        for start in wirer.wiring().starts
    }
    for kind, reference, value in seed_words(plant_seed, wirer.seeds()):
        signed = value - (1 << 32) if value >= 1 << 31 and kind == "Integer" else value
        found[names[reference, kind]] = (kind, signed)
    return found
