"""What the raw FMI 2 and FMI 3 instances share: variables, buffers, messages, failures."""

from __future__ import annotations

import ctypes
import os
import threading
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cosim.errors import CapabilityError, PlantError
from cosim.plant.archive import UnpackedFmu
from cosim.plant.library import library_path

OK, WARNING, DISCARD, FATAL = 0, 1, 2, 4
ACCEPTED = frozenset((OK, WARNING))
_STATUS = {2: "discard", 3: "error", 4: "fatal", 5: "pending"}

# fmpy changes the working directory while it loads a library.
construction_lock = threading.Lock()
_alive: Counter[str] = Counter()


@dataclass(frozen=True)
class StartValue:
    """A start value to write at every reset: value reference and FMI type of its variable."""

    reference: int
    type: str
    value: float


@dataclass(frozen=True)
class Wiring:
    """Value references of what a plant exchanges with its FMU."""

    inputs: Sequence[int]
    outputs: Sequence[int]
    states: Sequence[int]
    starts: Sequence[StartValue]


class Instance:
    """One co-simulation instance, called through raw function pointers and fixed buffers.

    The pointers carry no argument types: ctypes then passes the ready-made C objects through,
    at half the cost of a checked call. `inputs`, `outputs` and `states` are the buffers, each
    with a NumPy view of the same memory (`…_view`).
    """

    prefix: ClassVar[str]
    real: ClassVar[str]
    state_suffix: ClassVar[str]
    setters: ClassVar[dict[str, tuple[str, Any]]]

    def __init__(self, fmu: UnpackedFmu, wiring: Wiring, step_size: float) -> None:
        self.fmu = fmu
        self.messages: deque[str] = deque(maxlen=8)
        interface = fmu.description.coSimulation
        self._can_save = bool(interface.canGetAndSetFMUstate)
        self._can_serialise = bool(interface.canSerializeFMUstate)
        self.fatal = False
        if interface.canBeInstantiatedOnlyOncePerProcess and _alive[fmu.sha256]:
            raise CapabilityError(
                f"FMU '{fmu.path}' can be instantiated only once per process; close the other plant"
            )
        self._slave = self._load()
        _alive[fmu.sha256] += 1
        self._component = ctypes.c_void_p(self._slave.component)
        self._free_instance = self._slave.dll[f"{self.prefix}FreeInstance"]
        self._free_instance.restype = None
        self._step_size = ctypes.c_double(step_size)
        self._time = ctypes.c_double(0.0)
        self.inputs, _, self._set_inputs = self._exchange(wiring.inputs)
        self.outputs, self.outputs_view, self._get_outputs = self._exchange(wiring.outputs)
        self.states, self.states_view, self._get_states = self._exchange(wiring.states)
        self._starts: list[tuple[str, Any, tuple[Any, ...]]] = []
        self._slots: dict[tuple[str, int], tuple[Any, int]] = {}
        for kind in dict.fromkeys(start.type for start in wiring.starts):
            self._add_starts([start for start in wiring.starts if start.type == kind])

    def _load(self) -> Any:
        library = str(library_path(self.fmu).resolve())
        with construction_lock:
            folder = Path.cwd()
            try:
                return self._instantiate(library)
            # fmpy raises bare Exception when the library does not load or instantiate.
            except Exception as error:
                raise PlantError(
                    f"FMU '{self.fmu.path}' cannot be instantiated: {error}{self._log()}"
                ) from None
            finally:
                os.chdir(folder)

    def initialise(self, started: bool) -> None:
        """Reset (if started before), write the start values, initialise and read the states."""
        raise NotImplementedError

    def advance(self, time: float) -> None:
        """Write the inputs, read the outputs at `time`, step, and read the states after it."""
        raise NotImplementedError

    def _instantiate(self, library: str) -> Any:
        raise NotImplementedError

    def _function(self, name: str) -> Any:
        """A function pointer of our own, free of the argument types that fmpy attaches."""
        pointer = self._slave.dll[self.prefix + name]
        pointer.restype = ctypes.c_int
        return pointer

    def _exchange(
        self, references: Sequence[int]
    ) -> tuple[Any, NDArray[np.float64], tuple[Any, ...]]:
        buffer = (ctypes.c_double * len(references))()
        view: NDArray[np.float64] = np.frombuffer(memoryview(buffer), dtype=np.float64)
        return buffer, view, self._arguments(references, buffer)

    def _arguments(self, references: Sequence[int], values: Any) -> tuple[Any, ...]:
        raise NotImplementedError

    def _add_starts(self, starts: list[StartValue]) -> None:
        suffix, ctype = self.setters[starts[0].type]
        convert = float if ctype in (ctypes.c_double, ctypes.c_float) else int
        buffer = (ctype * len(starts))(*(convert(start.value) for start in starts))
        arguments = self._arguments([start.reference for start in starts], buffer)
        name = f"Set{suffix}"
        self._starts.append((name, self._function(name), arguments))
        # FMI 2 counts value references anew for each type.
        self._slots |= {(s.type, s.reference): (buffer, i) for i, s in enumerate(starts)}

    def change_start(self, type_: str, reference: int, value: float) -> None:
        """Replace the start value of a variable, by type and reference, for the next reset."""
        buffer, index = self._slots[type_, reference]
        buffer[index] = value

    def _write_starts(self) -> None:
        for name, function, arguments in self._starts:
            if (status := function(*arguments)) not in ACCEPTED:
                self.fail(name, status)

    def save(self, handle: ctypes.c_void_p) -> None:
        """Copy the FMU's state into a handle; a non-empty handle's memory is used again."""
        if not self._can_save:
            self._lacks("save and restore its state", "canGetAndSetFMUstate")
        if (status := self._get_state(self._component, ctypes.byref(handle))) not in ACCEPTED:
            self.fail(f"Get{self.state_suffix}", status)

    def load(self, handle: ctypes.c_void_p) -> None:
        """Set the FMU's state from a handle and read the plant's states."""
        if (status := self._set_state(self._component, handle)) not in ACCEPTED:
            self.fail(f"Set{self.state_suffix}", status)
        if (status := self._get_values(*self._get_states)) not in ACCEPTED:
            self.fail("Get", status)

    def free(self, handle: ctypes.c_void_p) -> None:
        """Free a handle's memory."""
        if handle.value is not None and not self.fatal:
            self._free_state(self._component, ctypes.byref(handle))

    def serialise(self, handle: ctypes.c_void_p) -> bytes:
        """Return a saved state as bytes that any instance of this FMU can read."""
        if not self._can_serialise:
            self._lacks("serialise its state", "canSerializeFMUstate")
        size = ctypes.c_size_t()
        name = f"Serialized{self.state_suffix}Size"
        if (
            status := self._function(name)(self._component, handle, ctypes.byref(size))
        ) not in ACCEPTED:
            self.fail(name, status)
        buffer = ctypes.create_string_buffer(size.value)
        name = f"Serialize{self.state_suffix}"
        if (status := self._function(name)(self._component, handle, buffer, size)) not in ACCEPTED:
            self.fail(name, status)
        return buffer.raw

    def deserialise(self, data: bytes, handle: ctypes.c_void_p) -> None:
        """Fill a handle from bytes; raises PlantError if the FMU refuses them."""
        if not self._can_serialise:
            self._lacks("serialise its state", "canSerializeFMUstate")
        buffer = ctypes.create_string_buffer(data, len(data))
        size = ctypes.c_size_t(len(data))
        name = self._deserialise_name
        pointer = ctypes.byref(handle)
        if (status := self._function(name)(self._component, buffer, size, pointer)) not in ACCEPTED:
            self.fail(name, status)

    _deserialise_name: ClassVar[str]

    def _bind(self, setter: str) -> None:
        self._set_values = self._function(f"Set{setter}")
        self._get_values = self._function(f"Get{setter}")
        self._do_step = self._function("DoStep")
        if self._can_save:
            self._get_state = self._function(f"Get{self.state_suffix}")
            self._set_state = self._function(f"Set{self.state_suffix}")
            self._free_state = self._function(f"Free{self.state_suffix}")

    def _lacks(self, ability: str, flag: str) -> None:
        raise CapabilityError(
            f"FMU '{self.fmu.path}' cannot {ability}: its model description lacks {flag}"
        )

    def fail(self, function: str, status: int) -> None:
        """Raise PlantError for a failed call, with what the FMU logged about it."""
        self.fatal |= status == FATAL
        label = _STATUS.get(status, f"status {status}, which FMI does not have")
        raise PlantError(
            f"FMU '{self.fmu.path.name}': {self.prefix}{function} returned {label}{self._log()}"
        )

    def _log(self) -> str:
        text = "; ".join(dict.fromkeys(self.messages))
        self.messages.clear()
        return f": {text}" if text else ""

    def close(self) -> None:
        """Free the instance; after a fatal error FMI forbids every call, this one too.

        The library stays loaded, as fmpy would not leave it: the FMU may have started threads.
        """
        _alive[self.fmu.sha256] -= 1
        if not self.fatal:
            self._free_instance(self._component)
