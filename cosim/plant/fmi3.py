"""Co-simulation by raw FMI 3.0 calls."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, ClassVar

from fmpy.fmi3 import FMU3Slave

from cosim.plant.archive import UnpackedFmu
from cosim.plant.instance import ACCEPTED, DISCARD, Instance, Wiring

_TRUE, _FALSE = ctypes.c_bool(True), ctypes.c_bool(False)
_ZERO = ctypes.c_double(0.0)


class Fmi3Instance(Instance):
    """An FMI 3.0 co-simulation instance, without event mode and early return."""

    prefix = "fmi3"
    state_suffix = "FMUState"
    _deserialise_name = "DeserializeFMUState"
    real = "Float64"
    setters: ClassVar[dict[str, tuple[str, Any]]] = {
        "Float64": ("Float64", ctypes.c_double),
        "Float32": ("Float32", ctypes.c_float),
        "Int8": ("Int8", ctypes.c_int8),
        "UInt8": ("UInt8", ctypes.c_uint8),
        "Int16": ("Int16", ctypes.c_int16),
        "UInt16": ("UInt16", ctypes.c_uint16),
        "Int32": ("Int32", ctypes.c_int32),
        "UInt32": ("UInt32", ctypes.c_uint32),
        "Int64": ("Int64", ctypes.c_int64),
        "UInt64": ("UInt64", ctypes.c_uint64),
        "Enumeration": ("Int64", ctypes.c_int64),
        "Boolean": ("Boolean", ctypes.c_bool),
    }

    def __init__(self, fmu: UnpackedFmu, wiring: Wiring, step_size: float) -> None:
        super().__init__(fmu, wiring, step_size)
        self._bind("Float64")
        self._reset = self._function("Reset")
        self._enter = self._function("EnterInitializationMode")
        self._exit = self._function("ExitInitializationMode")
        self._event = ctypes.c_bool()
        self._terminate = ctypes.c_bool()
        self._early = ctypes.c_bool()
        self._last_time = ctypes.c_double()
        self._step_arguments = (
            self._component,
            self._time,
            self._step_size,
            _FALSE,  # a snapshot may take the FMU back before this step
            ctypes.byref(self._event),
            ctypes.byref(self._terminate),
            ctypes.byref(self._early),
            ctypes.byref(self._last_time),
        )

    def _instantiate(self, library: str) -> FMU3Slave:
        slave = FMU3Slave(
            guid=self.fmu.description.guid,
            modelIdentifier=self.fmu.description.coSimulation.modelIdentifier,
            unzipDirectory=str(self.fmu.folder),
            libraryPath=library,
        )
        messages = self.messages

        def log(_: Any, status: int, category: bytes, message: bytes) -> None:
            messages.append(message.decode("utf-8", "replace"))

        slave.instantiate(loggingOn=True, logMessage=log)
        return slave

    def _arguments(self, references: Sequence[int], values: Any) -> tuple[Any, ...]:
        count = ctypes.c_size_t(len(references))
        pointers = (ctypes.c_uint * len(references))(*references)
        return (self._component, pointers, count, values, count)

    def initialise(self, started: bool) -> None:
        """Reset (if started before), write the start values, initialise and read the states."""
        component = self._component
        if started and (status := self._reset(component)) not in ACCEPTED:
            self.fail("Reset", status)
        self._write_starts()
        if (status := self._enter(component, _FALSE, _ZERO, _ZERO, _FALSE, _ZERO)) not in ACCEPTED:
            self.fail("EnterInitializationMode", status)
        if (status := self._exit(component)) not in ACCEPTED:
            self.fail("ExitInitializationMode", status)
        if (status := self._get_values(*self._get_states)) not in ACCEPTED:
            self.fail("GetFloat64", status)

    def advance(self, time: float) -> None:
        """Write the inputs, read the outputs at `time`, step, and read the states after it."""
        self._time.value = time
        if (status := self._set_values(*self._set_inputs)) not in ACCEPTED:
            self.fail("SetFloat64", status)
        if (status := self._get_values(*self._get_outputs)) not in ACCEPTED:
            self.fail("GetFloat64", status)
        if (status := self._do_step(*self._step_arguments)) not in ACCEPTED:
            self.fail("DoStep", status)
        if self._terminate.value or self._early.value:
            self.messages.append(f"the FMU ended the step early, at {self._last_time.value} s")
            self.fail("DoStep", DISCARD)
        if (status := self._get_values(*self._get_states)) not in ACCEPTED:
            self.fail("GetFloat64", status)
