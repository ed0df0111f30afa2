"""An FMU of a sampled system, called from Python sample by sample."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from ctypes import c_double, c_uint32
from pathlib import Path

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
from numpy.typing import ArrayLike, NDArray

from fmus.errors import FmuError


class SampledInstance:
    """An instance of an FMI 2.0 FMU that is stepped by its default step size from time zero.

    `sample(values)` sets the variables `inputs`, steps, and returns the variables `outputs`,
    through buffers that are made once. Raises FmuError where the FMU is not FMI 2.0 or lacks a
    variable. Close it when done.
    """

    def __init__(self, path: Path, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        description = read_model_description(str(path))
        if description.fmiVersion != "2.0" or description.coSimulation is None:
            raise FmuError(f"{path} is not an FMI 2.0 FMU for co-simulation")
        reference = {v.name: v.valueReference for v in description.modelVariables}
        if missing := [name for name in (*inputs, *outputs) if name not in reference]:
            raise FmuError(f"{path} has no variable '{missing[0]}'")
        self._folder = extract(str(path))
        self._fmu = FMU2Slave(
            guid=description.guid,
            unzipDirectory=self._folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="sampled",
        )
        self._fmu.instantiate()
        self._fmu.setupExperiment(startTime=0.0)
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        self._inputs, self._outputs = [
            (c_uint32 * len(names))(*(reference[name] for name in names))
            for names in (inputs, outputs)
        ]
        self._given, self._found = (c_double * len(inputs))(), (c_double * len(outputs))()
        self._values: NDArray[np.float64] = np.ctypeslib.as_array(self._given)
        self._result: NDArray[np.float64] = np.ctypeslib.as_array(self._found)
        self._step = float(description.defaultExperiment.stepSize)
        self._count = 0

    def sample(self, values: ArrayLike) -> NDArray[np.float64]:
        """Outputs (n_outputs,) of the next sample for inputs (n_inputs,), in a shared buffer."""
        fmu, component = self._fmu, self._fmu.component
        self._values[:] = values
        fmu.fmi2SetReal(component, self._inputs, len(self._inputs), self._given)
        fmu.fmi2DoStep(component, self._count * self._step, self._step, 0)
        fmu.fmi2GetReal(component, self._outputs, len(self._outputs), self._found)
        self._count += 1
        return self._result

    def close(self) -> None:
        """Free the instance and its folder."""
        self._fmu.terminate()
        self._fmu.freeInstance()
        shutil.rmtree(self._folder, ignore_errors=True)
