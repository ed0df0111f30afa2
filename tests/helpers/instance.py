"""One adapter over fmpy's FMI 2.0 and 3.0 classes, so that a test runs on either FMU."""

from __future__ import annotations

from ctypes import c_double, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import fmpy
from fmpy import fmi2, fmi3


@cache
def _description(folder: Path) -> Any:
    return fmpy.read_model_description(str(folder))


class Instance:
    """An instance of an FMU of ours; `messages` holds its log as (status, category, text)."""

    def __init__(self, folder: Path, version: int, exchange=False, logging=False, **asked) -> None:
        description = _description(folder)
        self.variables = {v.name: v for v in description.modelVariables}
        self.step_size = float(description.defaultExperiment.stepSize)
        self.version = version
        self.exchange = exchange
        self.messages: list[tuple[int, str, str]] = []
        kind = {
            (2, False): fmi2.FMU2Slave,
            (2, True): fmi2.FMU2Model,
            (3, False): fmi3.FMU3Slave,
            (3, True): fmi3.FMU3Model,
        }[version, exchange]
        self.fmu = kind(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="test",
        )
        if version == 2:
            callbacks = fmi2.fmi2CallbackFunctions()
            callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(self._log2)
            self.fmu.instantiate(callbacks=callbacks, loggingOn=logging)
        else:
            self.fmu.instantiate(logMessage=self._log3, loggingOn=logging, **asked)

    def _log2(self, _: object, name: bytes, status: int, category: bytes, text: bytes) -> None:
        assert name == b"test"
        self.messages.append((status, category.decode(), text.decode()))

    def _log3(self, _: object, status: int, category: bytes, text: bytes) -> None:
        self.messages.append((status, category.decode(), text.decode()))

    @property
    def handle(self) -> c_void_p:
        """The instance pointer, for calls that fmpy's classes do not have."""
        return c_void_p(self.fmu.component)

    def close(self) -> None:
        self.fmu.freeInstance()

    def initialise(
        self, start: float = 0.0, stop: float | None = None, **values: float
    ) -> Instance:
        self.set(**values)
        self.enter_initialisation(start, stop)
        self.fmu.exitInitializationMode()
        return self

    def enter_initialisation(self, start: float = 0.0, stop: float | None = None) -> None:
        if self.version == 2:
            self.fmu.setupExperiment(startTime=start, stopTime=stop)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=start, stopTime=stop)

    def set(self, **values: float) -> None:
        for name, value in values.items():
            getattr(self.fmu, "set" + self._suffix(name))([self.reference(name)], [value])

    def get(self, *names: str) -> list[float]:
        return [
            getattr(self.fmu, "get" + self._suffix(name))([self.reference(name)])[0]
            for name in names
        ]

    def reference(self, name: str) -> int:
        return int(self.variables[name].valueReference)

    def _suffix(self, name: str) -> str:
        enumeration = "Integer" if self.version == 2 else "Int64"
        return str(self.variables[name].type).replace("Enumeration", enumeration)

    def step(self, time: float, size: float | None = None) -> None:
        size = self.step_size if size is None else size
        self.fmu.doStep(currentCommunicationPoint=time, communicationStepSize=size)

    def run(self, steps: int, size: float = 60.0, start: float = 0.0) -> list[list[float]]:
        """Step and return every real variable at each communication point."""
        reals = (v for v in self.variables.values() if v.type in ("Real", "Float64"))
        names = [v.name for v in reals if v.name != "time"]
        rows = [self.get(*names)]
        for k in range(steps):
            self.step(start + k * size, size)
            rows.append(self.get(*names))
        return rows

    def save(self) -> object:
        return self.fmu.getFMUstate() if self.version == 2 else self.fmu.getFMUState()

    def restore(self, state: object) -> None:
        (self.fmu.setFMUstate if self.version == 2 else self.fmu.setFMUState)(state)

    def free(self, state: object) -> None:
        (self.fmu.freeFMUstate if self.version == 2 else self.fmu.freeFMUState)(state)

    def serialise(self, state: object) -> bytes:
        fmu = self.fmu
        return (fmu.serializeFMUstate if self.version == 2 else fmu.serializeFMUState)(state)

    def deserialise(self, data: bytes) -> object:
        fmu = self.fmu
        return (fmu.deSerializeFMUstate if self.version == 2 else fmu.deserializeFMUState)(data)

    def directional(self, unknowns: list[str], knowns: list[str], seed: list[float]) -> list[float]:
        arguments = ([self.reference(n) for n in unknowns], [self.reference(n) for n in knowns])
        return list(self.fmu.getDirectionalDerivative(*arguments, seed))

    def start_continuous_time(self) -> float | None:
        """Event mode → continuous-time mode; returns the next event time, None if there is none."""
        if self.version == 2:
            info = self.fmu.newDiscreteStates()
            defined, time = info[-2], info[-1]
        else:
            *_, defined, time = self.fmu.updateDiscreteStates()
        self.fmu.enterContinuousTimeMode()
        return time if defined else None

    def set_states(self, x: list[float]) -> None:
        self.fmu.setContinuousStates((c_double * len(x))(*x), len(x))

    def derivatives(self) -> list[float]:
        buffer = (c_double * 2)()
        if self.version == 2:
            self.fmu.getDerivatives(buffer, 2)
        else:
            self.fmu.getContinuousStateDerivatives(buffer, 2)
        return list(buffer)
