"""The plant of the closed loop: an FMU wired by a scenario; reset, step, restore."""

from __future__ import annotations

import ctypes
import operator
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite, prod
from pathlib import Path
from typing import Any, NoReturn, Self

import numpy as np

from cosim.errors import CapabilityError, PlantError
from cosim.plant.fmi import (
    NOT_FINITE,
    Fmi2Instance,
    Fmi3Instance,
    Instance,
    Intermediate,
    Place,
    UnpackedFmu,
    library_path,
    unpack,
)
from cosim.protocols import Array, CompiledLoop, Step
from cosim.scenario import Scenario
from cosim.validation import suggestion

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
        internal = float(simulation.fixedInternalStepSize or 0)
        count = step / internal if step and internal > 0 else 1.0
        if round(count) < 1 or abs(count - round(count)) > 1e-9 * count:
            yield (
                f"{name} steps by multiples of {internal:g} s (fixedInternalStepSize), and the "
                f"communication step of {step:g} s is none"
            )
    numbers = [v for v in description.modelVariables if v.type not in _NO_NUMBERS]
    if not any(v.causality == "input" or v.variability == "tunable" for v in numbers):
        yield (
            f"{name} has no input and no tunable parameter that is a number: there is nothing for "
            "a controller to act on"
        )
    if not any(v.causality in ("output", "local") for v in numbers):
        yield f"{name} has no output that is a number: there is nothing for a controller to see"


_WIDE = ("Int64", "UInt64")
INTEGERS = ("Integer", "Int32", "UInt32", *_WIDE)
_NO_NUMBERS = ("Boolean", "Enumeration", "String", "Binary", "Clock")


def has_start(variable: Any) -> bool:
    """Whether an importer may set the variable's start value, by FMI's causality and `initial`."""
    if variable.variability == "constant":
        return False
    if variable.causality in ("output", "local"):
        return variable.initial in ("exact", "approx")
    return variable.causality not in ("calculatedParameter", "independent")


class Wiring:
    """Places in an FMU of the variables that a scenario names; raises PlantError on any misfit.

    They are `inputs`, `outputs` (stage cost first), `states`, the `seeds`, low word first, the
    parameters for the `initial` state, and all `starts` with their values.
    """

    def __init__(self, scenario: Scenario, fmu: UnpackedFmu) -> None:
        self._scenario, self._fmu, plant = scenario, fmu, scenario.plant
        self.interface = Fmi2Instance if fmu.description.fmiVersion[0] == "2" else Fmi3Instance
        self.inputs = [self._place(name, "plant.actions", _not_written) for name in plant.actions]
        self.outputs = self._numbers((plant.stage_cost, *plant.disturbances), "plant")
        self.states = self._numbers(plant.states, "plant.states")
        self.initial = self._numbers(plant.mapping.initial_state, "plant.mapping.initial_state")
        self.seeds: list[Place] = []
        for name in plant.mapping.seed:
            if not (self.seeds and self.seeds[-1].type in _WIDE):
                self.seeds.append(self._place(name, "plant.mapping.seed", _no_word))
        self.starts = self._starts()

    def changes(self) -> dict[int, tuple[list[Place], list[float]]]:
        """By the number of a sample the places to write at its start, and the values."""
        scenario = self._scenario
        found: dict[int, tuple[list[Place], list[float]]] = {}
        for change in scenario.plant.changes or ():
            places, values = found.setdefault(ceil(change.time / scenario.sampling_time), ([], []))
            for name, value in change.parameters.items():
                places.append(self._place(name, "plant.changes", _not_written))
                values.append(value)
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
        what, shape, index = misfit(variable), tuple(variable.shape or ()), 0
        if shape and not what:
            try:
                indices = name.removeprefix(variable.name).removeprefix("[").removesuffix("]")
                index = int(np.ravel_multi_index([int(i) for i in indices.split(",")], shape))
            except ValueError:
                last = ",".join(str(n - 1) for n in shape)
                what = f"is of an array of {shape}: name an element, up to {variable.name}[{last}]"
        if what:
            raise PlantError(f"variable '{name}' of FMU '{fmu.path.name}' {what}; {asked} it")
        stated = ["0"] if variable.type in _NO_NUMBERS else str(variable.start or 0).split()
        starts = tuple(map(float, stated)) * (prod(shape) // len(stated))
        return Place(int(variable.valueReference), str(variable.type), index, starts)


def _no_number(variable: Any) -> str:
    return f"is {_a(variable.type)}, not a number" if variable.type in _NO_NUMBERS else ""


def _not_written(variable: Any) -> str:
    if variable.causality != "input" and variable.variability != "tunable":
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
        number = operator.index(seed)
    except TypeError:
        number = -1
    if not 0 <= number < 1 << 64:
        raise PlantError(f"seed must be an integer in [0, 2^64), not {seed!r}")
    words, shift = [], 0
    for place in places:
        bits = 64 if place.type in _WIDE else 32
        words.append((place, number >> shift & (1 << bits) - 1))
        shift += bits
    return words


def start_values(scenario: Scenario, plant_seed: int) -> dict[str, tuple[str, float]]:
    """FMI type and value of each parameter that differs by scenario, the seed's words too.

    `plant_seed`, 64 bits, is the first of `cosim.simulation.spawn_seeds`; an Integer, which has
    32 bits and a sign, takes its low word, the next one the high word. Raises PlantError where the
    scenario's FMU does not fit it.
    """
    fmu = unpack(scenario.plant.fmu)
    wiring = Wiring(scenario, fmu)
    names = {(int(v.valueReference), v.type): name for name, v in fmu.variables.items()}
    found = {names[place[:2]]: (place.type, value) for place, value in wiring.starts}
    for place, value in seed_words(plant_seed, wiring.seeds):
        signed = value - (1 << 32) if value >= 1 << 31 and place.type == "Integer" else value
        found[names[place[:2]]] = (place.type, signed)
    return found


_NOT_STARTED = -1
_HEADER = struct.Struct("<q32s")


@dataclass(eq=False, slots=True)
class Snapshot:
    """A saved state of one plant; `FmuPlant.restore` goes back to it any number of times.

    Its memory belongs to the FMU, which frees none: a later snapshot reuses it.
    """

    plant: FmuPlant
    handle: ctypes.c_void_p
    k: int

    def __del__(self) -> None:
        self.plant.recycle(self.handle)


class FmuPlant:
    """A co-simulation FMU, FMI 2.0 or 3.0, sampled and wired as a scenario says.

    At sample k, time k·h, the action is written, and ℓ(x_k, u_k, d_k) and d_k are read. Then the
    FMU steps by the sampling time h, at once or by `plant.communication_step`, and x_{k+1} is
    read. Use it as a context manager, or call `close`. An FMU is native code: name only files that
    you trust.

    `scenario` is a `Scenario` or what `Scenario.load` takes; `fmu`, a shipped one's name or a path,
    replaces the scenario's. `intermediate` is called with time [s] and states (n,) after each
    internal step of an FMI 3.0 FMU that provides these values. Raises PlantError if the FMU is
    missing, corrupt, has no co-simulation binary for this platform or lacks a variable that the
    scenario names; CapabilityError once a capability that the FMU lacks is used.
    """

    def __init__(
        self,
        scenario: Scenario | str | Path,
        fmu: str | Path | None = None,
        intermediate: Intermediate | None = None,
    ) -> None:
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        self._fmi: Instance | None = None
        self._handles: list[ctypes.c_void_p] = []
        self._free_handles: list[ctypes.c_void_p] = []
        archive = unpack(self.scenario.plant.fmu if fmu is None else fmu)
        self._h = self.scenario.sampling_time
        step = self.scenario.plant.communication_step or self._h
        for refusal in refusals(archive, step):
            raise PlantError(refusal)
        wiring = Wiring(self.scenario, archive)
        self.unpacked = archive
        self.fmi_version = str(archive.description.fmiVersion)
        self.fmu_path = archive.path
        self.fmu_sha256 = archive.sha256
        plant = self.scenario.plant
        names = (*plant.states, *plant.actions, *plant.disturbances, plant.stage_cost)
        self.units = {name: archive.unit(name) for name in names}
        states = [archive.variable(name) for name in plant.states]
        lower = np.array([-inf if v.min is None else float(v.min) for v in states])
        upper = np.array([inf if v.max is None else float(v.max) for v in states])
        self.state_range = lower, upper
        self.penalty = self.scenario.state_penalty
        self._seeds, self._initial = wiring.seeds, wiring.initial
        self._elsewhere = False
        self._m = len(plant.actions)
        self._k = _NOT_STARTED
        self._started = False
        self._penalty_now = 0.0
        self._steps = round(self._h / step)
        exchanged = wiring.inputs, wiring.outputs, wiring.states
        step = self._h / self._steps
        self._fmi = wiring.interface(archive, exchanged, wiring.starts, step, intermediate)
        self.drivable = self._fmi.drivable and self._steps == 1 and intermediate is None
        self._changes = {k: self._fmi.writer(*change) for k, change in wiring.changes().items()}
        self._advance = self._fmi.advance if self._steps == 1 else self._advance_in_steps
        self._inputs = self._fmi.inputs
        self._outputs = self._fmi.outputs
        self._states = self._fmi.states
        self._copy_states = self._fmi.states_view.copy
        self._copy_disturbances = self._fmi.outputs_view[1:].copy

    @property
    def k(self) -> int:
        """Number of steps since the reset."""
        return self._k

    @property
    def time(self) -> float:
        """Time k·h in s, not accumulated."""
        return self._k * self._h

    @property
    def state(self) -> Array:
        """Present state, (n,), a copy."""
        return self._copy_states()

    def reset(self, seed: int, initial_state: Sequence[float] | Array | None = None) -> Array:
        """Start again at k = 0 with the disturbances of a seed in [0, 2⁶⁴); return the state (n,).

        `initial_state` (n,) replaces the scenario's for this episode. Every start value is written.
        """
        fmi = self._instance
        for place, word in seed_words(seed, self._seeds):
            fmi.change_start(place, word)
        if initial_state is not None or self._elsewhere:
            self._start_from(fmi, initial_state)
        self._k = _NOT_STARTED
        fmi.initialise(self._started)
        self._started = True
        self._k = 0
        self._penalty_now = self.penalty(self._states[:])
        return self._copy_states()

    def step(self, a: Sequence[float] | Array) -> Step:
        """Hold the action a (m,) for one sampling time; raises PlantError, then needs a reset."""
        try:
            values = a.tolist() if isinstance(a, np.ndarray) else list(a)
            acceptable = len(values) == self._m and isfinite(sum(values))
        except TypeError:
            acceptable = False
        if not acceptable:
            names = ", ".join(self.scenario.plant.actions)
            raise PlantError(f"action must be {self._m} finite numbers ({names}), not {a}")
        if self._k < 0:
            self._running()
        self._inputs[:] = values
        penalty, k = self._penalty_now, self._k
        self._k = _NOT_STARTED
        if k in self._changes:
            self._changes[k]()
        self._advance(k * self._h)
        states, cost = self._states[:], self._outputs[0]
        if not isfinite(cost + sum(states)):
            self._refuse_output(k)
        self._k = k + 1
        self._penalty_now = self.penalty(states)
        return Step(self._copy_states(), cost, penalty, self._copy_disturbances())

    def _advance_in_steps(self, time: float) -> None:
        """Step through a sample; the outputs are those of its begin."""
        fmi = self._instance
        fmi.advance(time)
        begin = self._outputs[:]
        for i in range(1, self._steps):
            fmi.advance(time + i * self._h / self._steps)
        self._outputs[:] = begin

    def drive(self, loop: CompiledLoop, table: Array) -> Array:
        """Take the next samples in a compiled loop, a row of `table` each; return the state (n,).

        As many calls of `step` give the same. Raises PlantError, then needs a reset.
        """
        fmi = self._running()
        k, first, end = self._k, self._k, self._k + len(table)
        self._k = _NOT_STARTED
        while k < end:
            if k in self._changes:
                self._changes[k]()
            stop = min((change for change in self._changes if change > k), default=end)
            stop = min(stop, end)
            k, fault, status = loop(fmi.native, k, table[k - first : stop - first])
            if fault == NOT_FINITE:
                self._refuse_output(k)
            if fault:
                fmi.fail_native(fault, status)
        self._k = end
        self._penalty_now = self.penalty(self._states[:])
        return self._copy_states()

    def snapshot(self) -> Snapshot:
        """Save the state of plant and disturbances; raises CapabilityError if the FMU cannot."""
        fmi, handle = self._running(), self._handle()
        fmi.save(handle)
        return Snapshot(self, handle, self._k)

    def restore(self, snapshot: Snapshot) -> Array:
        """Go back to a snapshot; return its state (n,). Raises PlantError on another plant's."""
        self._require_own(snapshot).load(snapshot.handle)
        self._k = snapshot.k
        self._penalty_now = self.penalty(self._states[:])
        return self._copy_states()

    def serialise(self, snapshot: Snapshot) -> bytes:
        """A snapshot as bytes, for any process; raises PlantError on another plant's."""
        state = self._require_own(snapshot).serialise(snapshot.handle)
        return _HEADER.pack(snapshot.k, bytes.fromhex(self.fmu_sha256)) + state

    def deserialise(self, data: bytes) -> Snapshot:
        """A snapshot from its bytes; raises PlantError where they are not of the same FMU file."""
        fmi = self._instance
        if len(data) < _HEADER.size:
            raise PlantError("these bytes are not a serialised plant state")
        k, digest = _HEADER.unpack_from(data)
        if digest.hex() != self.fmu_sha256:
            raise PlantError(f"this state was serialised from another FMU ({digest.hex()[:16]}…)")
        if not self._started:
            self.reset(0)
        handle = self._handle()
        fmi.deserialise(data[_HEADER.size :], handle)
        return Snapshot(self, handle, k)

    def _require_own(self, snapshot: Snapshot) -> Instance:
        if snapshot.plant is not self:
            raise PlantError("this snapshot was taken from another plant; serialise it to carry it")
        return self._instance

    def _handle(self) -> ctypes.c_void_p:
        """Memory of a dropped snapshot, or a null handle, which the FMU allocates."""
        if not self._free_handles:
            self._handles.append(handle := ctypes.c_void_p())
            return handle
        return self._free_handles.pop()

    def recycle(self, handle: ctypes.c_void_p) -> None:
        """Keep a dropped snapshot's memory for the next one; each snapshot calls this."""
        self._free_handles.append(handle)

    def close(self) -> None:
        """Free the FMU instance and every snapshot; a closed plant refuses all calls."""
        if self._fmi is None:
            return
        fmi, self._fmi = self._fmi, None
        self._k = _NOT_STARTED
        fmi.close(self._handles)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_fmi", None) is not None:
            self.close()

    @property
    def _instance(self) -> Instance:
        if self._fmi is None:
            raise PlantError("the plant is closed")
        if self._fmi.fatal:
            raise PlantError("the FMU ended in a fatal error; close this plant and make a new one")
        return self._fmi

    def _running(self) -> Instance:
        fmi = self._instance
        if self._k < 0:
            raise PlantError("call reset first: no episode has begun, or an error ended it")
        return fmi

    def _start_from(self, fmi: Instance, state: Sequence[float] | Array | None) -> None:
        """Replace the start values of the states, or put the scenario's back."""
        table = self.scenario.plant
        if not self._initial:
            raise CapabilityError(
                f"scenario '{self.scenario.name}' names no plant.mapping.initial_state: its plant "
                "always starts where the FMU does"
            )
        values = np.asarray(table.initial_state if state is None else state, dtype=float)
        if values.shape != (len(table.states),) or not np.isfinite(values).all():
            names = ", ".join(table.states)
            raise PlantError(
                f"initial_state must be {len(table.states)} finite numbers ({names}), not {state}"
            )
        for place, value in zip(self._initial, values.tolist(), strict=True):
            fmi.change_start(place, value)
        self._elsewhere = state is not None

    def _refuse_output(self, k: int) -> NoReturn:
        table = self.scenario.plant
        values = {table.stage_cost: self._outputs[0]}
        values |= dict(zip(table.states, self._states, strict=True))
        bad = ", ".join(f"{name} = {value}" for name, value in values.items() if value - value != 0)
        raise PlantError(f"FMU '{self.fmu_path.name}' returned {bad} at step {k}")
