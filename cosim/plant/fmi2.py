"""Co-simulation by raw FMI 2.0 calls."""

from __future__ import annotations

import ctypes
import itertools
import sys
from collections import deque
from collections.abc import Sequence
from typing import Any, ClassVar
from weakref import WeakValueDictionary

from fmpy import calloc, free
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)
from fmpy.logging import addLoggerProxy

from cosim.plant.archive import UnpackedFmu
from cosim.plant.instance import ACCEPTED, WARNING, Instance, Wiring

_numbers = itertools.count()
_logs: WeakValueDictionary[bytes, deque[str]] = WeakValueDictionary()


def _log(_: Any, instance: bytes, status: int, category: bytes, message: bytes) -> None:
    text = message.decode("utf-8", "replace")
    if (log := _logs.get(instance)) is not None:
        log.append(text)
    elif status > WARNING:
        print(f"{instance.decode('utf-8', 'replace')}: {text}", file=sys.stderr)


# fmpy's proxy, which formats the variadic message, knows one Python logger per process.
_callbacks = fmi2CallbackFunctions()
_callbacks.logger = fmi2CallbackLoggerTYPE(_log)
_callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
_callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
addLoggerProxy(ctypes.byref(_callbacks))

_TRUE, _FALSE = ctypes.c_int(1), ctypes.c_int(0)
_ZERO = ctypes.c_double(0.0)


class Fmi2Instance(Instance):
    """An FMI 2.0 co-simulation instance."""

    prefix = "fmi2"
    state_suffix = "FMUstate"
    _deserialise_name = "DeSerializeFMUstate"
    real = "Real"
    setters: ClassVar[dict[str, tuple[str, Any]]] = {
        "Real": ("Real", ctypes.c_double),
        "Integer": ("Integer", ctypes.c_int),
        "Enumeration": ("Integer", ctypes.c_int),
        "Boolean": ("Boolean", ctypes.c_int),
    }

    def __init__(self, fmu: UnpackedFmu, wiring: Wiring, step_size: float) -> None:
        super().__init__(fmu, wiring, step_size)
        self._bind("Real")
        self._reset = self._function("Reset")
        self._setup = self._function("SetupExperiment")
        self._enter = self._function("EnterInitializationMode")
        self._exit = self._function("ExitInitializationMode")

    def _instantiate(self, library: str) -> FMU2Slave:
        name = f"cosim-{next(_numbers)}"
        _logs[name.encode()] = self.messages
        slave = FMU2Slave(
            guid=self.fmu.description.guid,
            modelIdentifier=self.fmu.description.coSimulation.modelIdentifier,
            unzipDirectory=str(self.fmu.folder),
            libraryPath=library,
            instanceName=name,
        )
        slave.instantiate(callbacks=_callbacks, loggingOn=True)
        return slave

    def _arguments(self, references: Sequence[int], values: Any) -> tuple[Any, ...]:
        count = len(references)
        pointers = (ctypes.c_uint * count)(*references)
        return (self._component, pointers, ctypes.c_size_t(count), values)

    def initialise(self, started: bool) -> None:
        """Reset (if started before), write the start values, initialise and read the states."""
        component = self._component
        if started and (status := self._reset(component)) not in ACCEPTED:
            self.fail("Reset", status)
        self._write_starts()
        if (status := self._setup(component, _FALSE, _ZERO, _ZERO, _FALSE, _ZERO)) not in ACCEPTED:
            self.fail("SetupExperiment", status)
        if (status := self._enter(component)) not in ACCEPTED:
            self.fail("EnterInitializationMode", status)
        if (status := self._exit(component)) not in ACCEPTED:
            self.fail("ExitInitializationMode", status)
        if (status := self._get_values(*self._get_states)) not in ACCEPTED:
            self.fail("GetReal", status)

    def advance(self, time: float) -> None:
        """Write the inputs, read the outputs at `time`, step, and read the states after it."""
        self._time.value = time
        if (status := self._set_values(*self._set_inputs)) not in ACCEPTED:
            self.fail("SetReal", status)
        if (status := self._get_values(*self._get_outputs)) not in ACCEPTED:
            self.fail("GetReal", status)
        # The last argument is false: a snapshot may take the FMU back before this step.
        if (
            status := self._do_step(self._component, self._time, self._step_size, _FALSE)
        ) not in ACCEPTED:
            self.fail("DoStep", status)
        if (status := self._get_values(*self._get_states)) not in ACCEPTED:
            self.fail("GetReal", status)
