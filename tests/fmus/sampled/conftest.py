"""A sampled system of a few lines: y = gain·u + the sum of the inputs of earlier samples."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import fmpy
import pytest
from fmpy import fmi2, fmi3

from fmus import BuildError
from fmus.model import Kind, Variable
from fmus.sampled import SampledSystem, build_sampled

CORE = b"""
#ifndef CORE_H
#define CORE_H
#include <math.h>
#include <stdint.h>
typedef struct { double sum, seen, y; int64_t status; } CoreState;
static const char *const CORE_MESSAGES[] = {"fine", "the input is negative"};
static void core_reset(CoreState *s) { s->sum = s->seen = s->y = 0.0; s->status = 0; }
static void core_evaluate(CoreState *s, const double u[], const double gain[]) {
    s->status = !(u[0] >= 0.0);
    s->seen = isfinite(u[0]) ? u[0] : 0.0;
    if (s->status == 0) s->y = gain[0] * u[0] + s->sum;
}
static void core_commit(CoreState *s) { s->sum += s->seen; }
static void core_outputs(const CoreState *s, double y[]) { y[0] = s->y; }
static int core_plausible(const CoreState *s) {
    return isfinite(s->sum) && isfinite(s->y) && isfinite(s->seen) && s->status >> 1 == 0;
}
#endif
"""
STEP = 2.0


@pytest.fixture(scope="session")
def adder() -> SampledSystem:
    return SampledSystem(
        name="adder",
        identifier="adder",
        description="adds its inputs",
        sampling_time=STEP,
        signals=(
            Variable("u", Kind.INPUT, unit="kPa", start=1.0, min=-10.0, max=10.0),
            Variable("y", Kind.OUTPUT, unit="kPa"),
            Variable("theta.gain[0]", Kind.TUNABLE, start=1.0),
        ),
        sources={"core.h": CORE},
    )


@pytest.fixture(scope="session", params=[2, 3], ids=["fmi2", "fmi3"])
def built(request, adder: SampledSystem, tmp_path_factory) -> tuple[int, Path]:
    folder = tmp_path_factory.mktemp("sampled")
    try:
        return request.param, build_sampled(adder, folder / "adder.fmu", request.param)
    except BuildError as error:
        pytest.skip(str(error))


class Instance:
    """An instance with the names of FMI 2.0's functions for both versions; `log` has its words."""

    def __init__(self, folder: Path, version: int) -> None:
        description = fmpy.read_model_description(str(folder))
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.log: list[str] = []
        self.version = version
        self.fmu = (fmi2.FMU2Slave if version == 2 else fmi3.FMU3Slave)(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier="adder",
            instanceName="test",
        )
        if version == 2:
            callbacks = fmi2.fmi2CallbackFunctions()
            callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(
                lambda *a: self.log.append(a[4].decode())
            )
            self.fmu.instantiate(callbacks=callbacks)
        else:
            self.fmu.instantiate(logMessage=lambda *a: self.log.append(a[3].decode()))

    def start(self, time: float = 0.0) -> Instance:
        if self.version == 2:
            self.fmu.setupExperiment(startTime=time)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=time)
        self.fmu.exitInitializationMode()
        return self

    def set(self, name: str, value: float) -> None:
        setter = self.fmu.setReal if self.version == 2 else self.fmu.setFloat64
        setter([self.references[name]], [value])

    def get(self, name: str) -> float:
        getter = self.fmu.getReal if self.version == 2 else self.fmu.getFloat64
        return getter([self.references[name]])[0]

    def step(self, time: float, size: float = STEP) -> None:
        self.fmu.doStep(currentCommunicationPoint=time, communicationStepSize=size)

    def snapshot(self) -> object:
        return self.fmu.getFMUstate() if self.version == 2 else self.fmu.getFMUState()

    def restore(self, state: object) -> None:
        (self.fmu.setFMUstate if self.version == 2 else self.fmu.setFMUState)(state)

    def serialise(self, state: object) -> bytes:
        name = "serializeFMUstate" if self.version == 2 else "serializeFMUState"
        return bytes(getattr(self.fmu, name)(state))

    def deserialise(self, data: bytes) -> object:
        name = "deSerializeFMUstate" if self.version == 2 else "deserializeFMUState"
        return getattr(self.fmu, name)(data)


@pytest.fixture
def make(built: tuple[int, Path]) -> Iterator[Callable[[], Instance]]:
    version, path = built
    folder = fmpy.extract(str(path))
    made: list[Instance] = []

    def new() -> Instance:
        made.append(Instance(Path(folder), version))
        return made[-1]

    yield new
    for instance in made:
        instance.fmu.freeInstance()
    shutil.rmtree(folder)
