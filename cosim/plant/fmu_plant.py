"""The plant of the closed loop: an FMU wired by a scenario; reset, step, restore."""

from __future__ import annotations

import ctypes
import operator
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import NoReturn, Self

import numpy as np

from cosim.core.errors import CapabilityError, PlantError
from cosim.core.protocols import Array, CompiledLoop, Step
from cosim.core.scenario import Scenario
from cosim.core.sensors import Sensors
from cosim.core.signals import Signals
from cosim.plant.fmi import NOT_FINITE_STATUS, Instance, Intermediate, UnpackedFmu, unpack
from cosim.plant.probe import Restart, as_asked, probe_of, subject_of
from cosim.plant.wiring import Wiring, refusals, seed_words

_NOT_STARTED = -1
_HEADER = struct.Struct("<q32s")
"""Before a serialised state: the sample's number, and the SHA-256 of the FMU."""


@dataclass(eq=False, slots=True)
class Snapshot:
    """A saved state of one plant; `FmuPlant.restore` goes back to it any number of times.

    Its memory belongs to the FMU, which frees none: a later snapshot reuses it.
    """

    plant: FmuPlant
    instance: Instance
    handle: ctypes.c_void_p
    k: int
    sensors: tuple[int, Array] | None = None

    def __del__(self) -> None:
        self.plant.recycle(self.instance, self.handle)


class FmuPlant:
    """A co-simulation FMU, FMI 2.0 or 3.0, sampled and wired as a scenario says.

    At sample k, time k·h, signals and the action are written, and ℓ(x_k, u_k, d_k) and d_k are
    read, before or after the step as the FMU needs it (`cosim.plant.probe`). The FMU steps by the
    sampling time h, at once or by `plant.communication_step`, and x_{k+1} is read. The FMU's own
    time is `plant.start_time` + k·h. Use it as a context manager, or call `close`. An FMU is native
    code: name only files that you trust.

    Args:
        scenario: a `Scenario` or what `Scenario.load` takes.
        fmu: a shipped one's name or a path, in place of the scenario's.
        intermediate: is called with time [s] and states (n,) after each internal step of an FMI 3.0
            FMU that provides these values.

    Attributes:
        units: unit of each variable of the scenario, by name.
        state_range: least and greatest values of the states, (n,) each, as the FMU states them.
        drivable: whether compiled code can step the FMU (`drive`).
        y: what the scenario's sensors show at the present sample, (n_y,), NaN where nothing new
            came; None without sensors.

    Raises:
        PlantError: the FMU is missing, corrupt, has no co-simulation binary for this platform or
            lacks a variable that the scenario names.
        CapabilityError: a capability that the FMU lacks is used.
    """

    def __init__(
        self,
        scenario: Scenario | str | Path,
        fmu: str | Path | None = None,
        intermediate: Intermediate | None = None,
    ) -> None:
        if not isinstance(scenario, Scenario):
            scenario = Scenario.load(scenario)
        self.scenario = scenario
        plant = scenario.plant
        # Before what may fail: `close` looks at them.
        self._fmi: Instance | None = None
        self._handles: list[ctypes.c_void_p] = []
        self._free_handles: list[ctypes.c_void_p] = []
        self._h = scenario.sampling_time
        step = plant.communication_step or self._h
        self._steps = round(self._h / step)
        archive = unpack(plant.fmu if fmu is None else fmu)
        _refuse(scenario, archive, step)
        wiring = Wiring(scenario, archive)
        self._wiring = wiring
        self._seeds = wiring.seeds
        self._initial = wiring.initial
        self._intermediate = intermediate
        self.unpacked = archive
        self.fmi_version = str(archive.description.fmiVersion)
        self.fmu_path = archive.path
        self.fmu_sha256 = archive.sha256
        self.units = _units(scenario, archive)
        ranges = np.array([archive.range(name) for name in plant.states])
        self.state_range = ranges[:, 0], ranges[:, 1]
        self.penalty = scenario.state_penalty
        sensors = scenario.sensors
        self._sensors = Sensors(sensors) if sensors else None
        self._signals = Signals(scenario) if scenario.signals else None
        self.y: Array | None = None
        self._n = len(plant.states)
        self._m = len(plant.actions)
        # The initial state that the FMU was given last.
        self._asked = list(plant.initial_state)
        self._elsewhere = False
        self._k = _NOT_STARTED
        self._started = False
        # Whether snapshots have been proven.
        self._saves = False
        # Penalty of the present state, which the next step returns.
        self._penalty_now = 0.0
        # What the FMU was seen to do decides, not what its description says.
        subject = subject_of(scenario, archive, wiring)
        self._probe = probe_of(subject)
        self._reading = self._probe.reading
        # Where a probe cannot tell, the scenario may say which instant an output belongs to.
        if plant.outputs is not None:
            self._reading = self._probe.stated(plant.outputs)
        # A scenario with a model of its plant is for comparisons with the optimum.
        if plant.model is not None:
            self.require_cost_of_sample()
        if self._probe.misfit:
            raise PlantError(self._probe.misfit)
        findings = self._probe.findings
        self._resets = findings.restart is Restart.RESET
        self._start_time = findings.experiment.start_time
        self._instantiate()

    def require_cost_of_sample(self) -> None:
        """Refuse what is compared with the optimum, where the stage cost is of another instant.

        Raises:
            PlantError: The stage cost that the FMU gives is that of the end of a step; the optimum
                is for ℓ(x_k, u_k, d_k).
        """
        if not self._probe.cost_of_sample:
            raise PlantError(
                f"'{self.scenario.plant.stage_cost}' of FMU '{self.fmu_path.name}' is known at the "
                "end of a step only, and the optimum is for the cost at a sample's begin: there is "
                "no J* of this plant (leave plant.model out)"
            )

    def _instantiate(self) -> None:
        """Make an instance of the FMU, and look up what a step uses of it."""
        wiring = self._wiring
        # The sensors' variables are read with the states, behind these.
        states = [*wiring.states, *wiring.sensors]
        intermediate = None if self._intermediate is None else self._since_reset
        fmi = wiring.interface(
            self.unpacked,
            (wiring.inputs, wiring.outputs, states),
            wiring.starts,
            self._h / self._steps,
            self._reading,
            self._probe.findings.experiment,
            intermediate,
        )
        self._fmi = fmi
        # Compiled code takes one FMI step a sample, and knows no sensors and signals.
        in_one_step = self._steps == 1 and self._intermediate is None
        bare = self._sensors is None and self._signals is None
        self.drivable = fmi.drivable and in_one_step and bare
        self._drive_signals = fmi.channel(wiring.signals)
        self._changes = {}
        for k, (places, values) in wiring.changes().items():
            self._changes[k] = fmi.writer(places, values)
        # Bound once: a step looks nothing up that stays the same.
        self._advance = fmi.advance
        if self._steps > 1:
            self._advance = self._advance_in_steps
        self._inputs = fmi.inputs
        self._outputs = fmi.outputs
        self._exchanged = fmi.states
        self._copy_states = fmi.states_view[: self._n].copy
        n_disturbances = len(self.scenario.plant.disturbances)
        self._copy_disturbances = fmi.outputs_view[1 : 1 + n_disturbances].copy

    @property
    def _states(self) -> list[float]:
        """Present state as numbers, (n,)."""
        states: list[float] = self._exchanged[: self._n]
        return states

    def _since_reset(self, time: float, states: Array) -> None:
        """Tell of an internal step, at its time since the reset."""
        assert self._intermediate is not None
        self._intermediate(time - self._start_time, states[: self._n])

    @property
    def k(self) -> int:
        """Number of steps since the reset."""
        return self._k

    @property
    def time(self) -> float:
        """Time since the reset, k·h in s, not accumulated."""
        return self._k * self._h

    @property
    def state(self) -> Array:
        """Present state, (n,), a copy."""
        return self._copy_states()

    def reset(self, seed: int, initial_state: Sequence[float] | Array | None = None) -> Array:
        """Start again at k = 0; every start value is written.

        Args:
            seed: of the disturbances, in [0, 2⁶⁴).
            initial_state: in place of the scenario's for this episode, (n,).

        Returns:
            The state, (n,).

        Raises:
            PlantError: the FMU fails, or starts elsewhere than it was asked to.
            CapabilityError: it cannot begin a second episode.
        """
        fmi = self._instance
        # Before anything changes: a wrong seed leaves the plant as it is.
        words = seed_words(seed, self._seeds)
        if self._started and not self._resets:
            fmi = self._begin_anew()
        for place, word in words:
            fmi.change_start(place, word)
        # The FMU keeps its start values: those of another episode have to be put back.
        if initial_state is not None or self._elsewhere:
            self._start_from(fmi, initial_state)
        # An FMU that fails now is before any episode.
        self._k = _NOT_STARTED
        fmi.initialise(self._started)
        # Equal to the bit in most cases, which spares the look at each of them.
        if self._initial and self._states != self._asked:
            self._check_initial_state()
        self._started = True
        self._k = 0
        self._penalty_now = self.penalty(self._states)
        if self._sensors is not None:
            sensed = self._exchanged[self._n :]
            self.y = self._sensors.start(operator.index(seed), sensed)
        return self._copy_states()

    def _begin_anew(self) -> Instance:
        """Take a new instance for an episode, where a reset was not seen to repeat the start."""
        if self._probe.findings.restart is Restart.NEVER:
            raise CapabilityError(
                f"FMU '{self.fmu_path.name}' cannot begin a second episode: its reset does not "
                "repeat the first start, and it can be instantiated only once per process"
            )
        self._instance.close(self._handles)
        self._handles = []
        self._free_handles = []
        self._started = False
        self._elsewhere = False
        self._asked = list(self.scenario.plant.initial_state)
        self._instantiate()
        return self._instance

    def _check_initial_state(self) -> None:
        """Refuse an FMU that starts elsewhere than it was asked to."""
        names = self.scenario.plant.states
        for name, asked, value in zip(names, self._asked, self._states, strict=True):
            if not as_asked(asked, value):
                raise PlantError(
                    f"FMU '{self.fmu_path.name}' was to start at {name} = {asked:g} and starts at "
                    f"{value:g}: plant.mapping.initial_state names parameters that do not set it"
                )

    def step(self, a: Sequence[float] | Array) -> Step:
        """Hold the action a (m,) for one sampling time; raises PlantError, then needs a reset."""
        # A sum is finite where each of its terms is: one call for all of them.
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
        penalty = self._penalty_now
        k = self._k
        prices: list[float] = []
        if self._signals is not None:
            # Before anything changes: a signal may have ended.
            penalty = self._signals.penalty(k)(self._states)
            prices = self._write_signals(k)
        # Until the step is done: after an error the plant needs a reset.
        self._k = _NOT_STARTED
        if self._changes and k in self._changes:
            self._changes[k]()
        self._advance(self._start_time + k * self._h)
        exchanged = self._exchanged[:]
        cost = self._outputs[0]
        if prices:
            cost += self._charge(prices)
        if not isfinite(cost + sum(exchanged)):
            self._refuse_output(k)
        self._k = k + 1
        self._penalty_now = self.penalty(exchanged[: self._n])
        if self._sensors is not None:
            self.y = self._sensors.read(k + 1, exchanged[self._n :])
        return Step(self._copy_states(), cost, penalty, self._copy_disturbances(), self.y)

    def _write_signals(self, k: int) -> list[float]:
        """Drive the FMU by the signals of sample k; prices beyond those that its cost includes."""
        assert self._signals is not None
        driving = []
        prices = []
        for i, table in enumerate(self._signals.tables):
            if table.plant is not None:
                driving.append(self._signals.value(i, k))
            if table.price_of is not None:
                prices.append(self._signals.value(i, k) - table.included)
        if driving:
            self._drive_signals(driving)
        return prices

    def _charge(self, prices: Sequence[float]) -> float:
        """Cost of what signals are the prices of, as it was read in the last step."""
        first = 1 + len(self.scenario.plant.disturbances)
        quantities: list[float] = self._outputs[first:]
        pairs = zip(prices, quantities, strict=True)
        return sum(price * quantity for price, quantity in pairs)

    def _advance_in_steps(self, time: float) -> None:
        """Step through a sample; the outputs are those of its first step."""
        fmi = self._instance
        fmi.advance(time)
        # Stage cost and disturbance are those of the sample's begin.
        outputs = self._outputs[:]
        for i in range(1, self._steps):
            # Multiples of the step, never sums of it, in which rounding would add up.
            since_begin = i * self._h / self._steps
            fmi.advance(time + since_begin)
        self._outputs[:] = outputs

    def drive(self, loop: CompiledLoop, table: Array) -> Array:
        """Let the next samples pass in a compiled loop; as many calls of `step` give the same.

        Args:
            loop: the controller's.
            table: gets a row for each sample.

        Returns:
            The state, (n,).

        Raises:
            PlantError: the FMU fails; it then needs a reset.
        """
        fmi = self._running()
        first = self._k
        end = first + len(table)
        k = first
        # Until all samples are done, as in `step`.
        self._k = _NOT_STARTED
        while k < end:
            if k in self._changes:
                self._changes[k]()
            # Up to the next change of the plant's parameters.
            stop = end
            for change in self._changes:
                if k < change < stop:
                    stop = change
            rows = table[k - first : stop - first]
            k, fault, status = loop(fmi.native, k, rows)
            if fault == NOT_FINITE_STATUS:
                self._refuse_output(k)
            if fault:
                fmi.fail_native(fault, status)
        self._k = end
        self._penalty_now = self.penalty(self._states)
        return self._copy_states()

    def snapshot(self) -> Snapshot:
        """Save the state of plant and disturbances; raises CapabilityError if the FMU cannot."""
        fmi = self._running()
        # The proof takes some steps of another instance: once a plant.
        if not self._saves:
            fmi.require_state()
            self._require_proof(self._probe.snapshots, "save and restore")
            self._saves = True
        handle = self._handle(fmi)
        fmi.save(handle)
        sensors = None if self._sensors is None else self._sensors.state()
        return Snapshot(self, fmi, handle, self._k, sensors)

    def restore(self, snapshot: Snapshot) -> Array:
        """Go back to a snapshot; return its state (n,). Raises PlantError on another plant's."""
        fmi = self._require_own(snapshot)
        fmi.load(snapshot.handle)
        self._k = snapshot.k
        self._penalty_now = self.penalty(self._states)
        if self._sensors is not None and snapshot.sensors is not None:
            self._sensors.restore(snapshot.sensors)
            # The reading is a function of the values and the sample: once more it is the same.
            sensed = self._exchanged[self._n :]
            self.y = self._sensors.read(self._k, sensed)
        return self._copy_states()

    def serialise(self, snapshot: Snapshot) -> bytes:
        """A snapshot as bytes, for any process; raises PlantError on another plant's."""
        fmi = self._require_own(snapshot)
        fmi.require_serialised_state()
        self._require_proof(self._probe.serialises, "serialise")
        state = fmi.serialise(snapshot.handle)
        digest = bytes.fromhex(self.fmu_sha256)
        header = _HEADER.pack(snapshot.k, digest)
        if self._sensors is None or snapshot.sensors is None:
            return header + state
        sensors = self._sensors.to_bytes(snapshot.sensors)
        return header + sensors + state

    def deserialise(self, data: bytes) -> Snapshot:
        """A snapshot from its bytes; raises PlantError where they are not of the same FMU file."""
        fmi = self._instance
        if len(data) < _HEADER.size:
            raise PlantError("these bytes are not a serialised plant state")
        # Another build of the same model may lay out its memory otherwise.
        k, digest = _HEADER.unpack_from(data)
        if digest.hex() != self.fmu_sha256:
            raise PlantError(f"this state was serialised from another FMU ({digest.hex()[:16]}…)")
        fmi.require_serialised_state()
        self._require_proof(self._probe.serialises, "serialise")
        # So that every later call finds an initialised instance.
        if not self._started:
            self.reset(0)
        handle = self._handle(fmi)
        state = data[_HEADER.size :]
        sensors = None
        if self._sensors is not None:
            sensors, state = self._sensors.from_bytes(state)
        fmi.deserialise(state, handle)
        return Snapshot(self, fmi, handle, k, sensors)

    def _require_proof(self, fault: str, ability: str) -> None:
        if fault:
            raise CapabilityError(
                f"FMU '{self.fmu_path.name}' declares that it can {ability} its state, but {fault}"
            )

    def _require_own(self, snapshot: Snapshot) -> Instance:
        if snapshot.plant is not self:
            raise PlantError("this snapshot was taken from another plant; serialise it to carry it")
        if snapshot.instance is not self._instance:
            raise PlantError(
                "this snapshot was taken in an earlier episode, and this FMU does not reset: each "
                "episode is a new instance; serialise a snapshot to carry it"
            )
        return self._instance

    def _handle(self, fmi: Instance) -> ctypes.c_void_p:
        """Memory of a dropped snapshot, or a null handle, which the FMU allocates."""
        fmi.no_return.value = False
        if not self._free_handles:
            handle = ctypes.c_void_p()
            self._handles.append(handle)
            return handle
        return self._free_handles.pop()

    def recycle(self, instance: Instance, handle: ctypes.c_void_p) -> None:
        """Keep a dropped snapshot's memory for the next one; each snapshot calls this.

        Args:
            instance: of which it is.
            handle: the memory.
        """
        # An instance that has been closed has freed it.
        if instance is not self._fmi:
            return
        self._free_handles.append(handle)
        # Without a snapshot left nothing takes the FMU back, and it may forget its past.
        nothing_is_kept = len(self._free_handles) == len(self._handles)
        instance.no_return.value = nothing_is_kept

    def close(self) -> None:
        """Free the FMU instance and every snapshot; a closed plant refuses all calls."""
        if self._fmi is None:
            return
        fmi = self._fmi
        self._fmi = None
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
        asked = table.initial_state if state is None else state
        values = np.asarray(asked, dtype=float)
        n = len(table.states)
        if values.shape != (n,) or not np.isfinite(values).all():
            names = ", ".join(table.states)
            raise PlantError(f"initial_state must be {n} finite numbers ({names}), not {state}")
        self._asked = values.tolist()
        for place, value in zip(self._initial, self._asked, strict=True):
            fmi.change_start(place, value)
        self._elsewhere = state is not None

    def _refuse_output(self, k: int) -> NoReturn:
        """Raise PlantError with the variables that are no finite numbers."""
        table = self.scenario.plant
        sensors = self.scenario.sensors or ()
        values = {table.stage_cost: self._outputs[0]}
        # In the order in which they are exchanged: states, then what sensors read.
        exchanged_names = list(table.states)
        for sensor in sensors:
            exchanged_names.append(sensor.variable)
        values |= dict(zip(exchanged_names, self._exchanged, strict=True))
        bad = []
        for name, value in values.items():
            if not isfinite(value):
                bad.append(f"{name} = {value}")
        raise PlantError(f"FMU '{self.fmu_path.name}' returned {', '.join(bad)} at step {k}")


def _units(scenario: Scenario, archive: UnpackedFmu) -> dict[str, str]:
    """Units of a scenario's variables, readings, estimates and signals, by name."""
    plant = scenario.plant
    sensors = scenario.sensors or ()
    # Of each name in records the FMU's variable whose unit it has.
    variables: dict[str, str] = {}
    own_names = (
        *plant.states,
        *plant.actions,
        *plant.disturbances,
        plant.stage_cost,
    )
    for name in own_names:
        variables[name] = name
    for sensor in sensors:
        variables[sensor.variable] = sensor.variable
    # A measurement and an estimate have the unit of what they are of.
    for name, sensor in zip(scenario.measurement_names, sensors, strict=True):
        variables[name] = sensor.variable
    # Without sensors there are no estimates.
    for name, state in zip(scenario.estimate_names, plant.states, strict=False):
        variables[name] = state
    # A signal has that of what it drives, or is; a price has none.
    for signal, name in zip(scenario.valued_signals, scenario.signal_names, strict=True):
        variables[name] = signal.plant or signal.bounded_state or signal.reference or ""
    units = {}
    for name, variable in variables.items():
        units[name] = archive.unit(variable) if variable else ""
    return units


def _refuse(scenario: Scenario, archive: UnpackedFmu, step: float) -> None:
    """Raise PlantError where the FMU cannot be this scenario's plant at this step in s."""
    # The first reason suffices: the others may follow from it.
    for refusal in refusals(archive, step):
        raise PlantError(refusal)
    refuse_bounds_elsewhere(scenario, archive)


def refuse_bounds_elsewhere(scenario: Scenario, archive: UnpackedFmu) -> None:
    """Refuse bounds that no value of the FMU's variable keeps: they are in another unit.

    Args:
        scenario: has the bounds.
        archive: the FMU, which may state the least and the greatest value of a variable.

    Raises:
        PlantError: names the variable and both ranges.
    """
    for name, (lower, upper) in scenario.limits.items():
        least, greatest = archive.range(name)
        if lower > greatest or upper < least:
            raise PlantError(
                f"scenario '{scenario.name}' bounds {name} to {lower:g} … {upper:g}, and the FMU "
                f"has it from {least:g} to {greatest:g}: another unit?"
            )
