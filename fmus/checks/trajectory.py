"""The trajectory that all importers must reproduce: the default experiment, start values held."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.model_description import ModelDescription, ScalarVariable
from numpy.typing import NDArray

from fmus import CheckError
from fmus.checks.outcome import NotOfferedError

MAX_STEPS = 500
_REALS = ("Real", "Float64")


@dataclass(frozen=True)
class Experiment:
    """Step size [s], number of steps and the real scalar outputs to compare."""

    step_size: float
    steps: int
    outputs: tuple[ScalarVariable, ...]

    @property
    def names(self) -> list[str]:
        """The outputs' names."""
        return [variable.name for variable in self.outputs]

    @property
    def stop_time(self) -> float:
        """The end of the last step [s]."""
        return self.steps * self.step_size


def experiment(description: ModelDescription) -> Experiment:
    """The default experiment from time zero, at most `MAX_STEPS` long."""
    default = description.defaultExperiment
    stop = float(default.stopTime) if default and default.stopTime else 1.0
    size = float(default.stepSize) if default and default.stepSize else stop / 100
    steps = min(MAX_STEPS, max(1, round(stop / size)))
    outputs = tuple(
        v
        for v in description.modelVariables
        if v.causality == "output" and v.type in _REALS and not v.dimensions
    )
    if not outputs:
        raise NotOfferedError("the FMU has no real output to compare")
    return Experiment(size, steps, outputs)


def reference(fmu: Path) -> NDArray[np.float64]:
    """Outputs (steps + 1, outputs) of a plain loop over the co-simulation interface."""
    description = fmpy.read_model_description(str(fmu))
    if description.coSimulation is None:
        raise NotOfferedError("the FMU has no co-simulation interface")
    plan = experiment(description)
    is_fmi2 = description.fmiVersion == "2.0"
    folder = fmpy.extract(str(fmu))
    try:
        instance = (FMU2Slave if is_fmi2 else FMU3Slave)(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="reference",
        )
        instance.instantiate()
        if is_fmi2:
            instance.setupExperiment(startTime=0.0)
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        references = [variable.valueReference for variable in plan.outputs]
        read = instance.getReal if is_fmi2 else instance.getFloat64
        rows = [list(read(references))]
        for k in range(plan.steps):
            instance.doStep(
                currentCommunicationPoint=k * plan.step_size,
                communicationStepSize=plan.step_size,
            )
            rows.append(list(read(references)))
        instance.terminate()
        instance.freeInstance()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return np.array(rows)


def require_identical(rows: NDArray[np.float64], fmu: Path) -> str:
    """A detail for the table; raises CheckError unless `rows` are the reference bit for bit."""
    expected = reference(fmu)[-len(rows) :]
    if np.array_equal(rows, expected):
        return f"{len(rows)} points of {rows.shape[1]} outputs, bit-identical"
    error = relative_difference(rows, expected)
    raise CheckError(f"differs from a plain doStep loop by up to {error:.1e} relative")


def relative_difference(rows: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    """Largest difference relative to the expected value, but at least to 0.1 % of its signal."""
    scale = np.maximum(np.abs(expected), 1e-3 * np.max(np.abs(expected), axis=0))
    return float(np.max(np.abs(rows - expected) / np.maximum(scale, np.finfo(float).tiny)))
