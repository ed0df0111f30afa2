"""A sample of the exported controller's FMU beside the Python controller's, in one closed loop."""

import shutil
from ctypes import c_double, c_uint32

import numpy as np
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

from benchmarks.measuring import clock, figure
from controllers import compile_functions
from cosim import FmuPlant
from cosim.cli.controller_fmu import rti_controller, write_fmu
from cosim.core.files import temporary_folder
from cosim.core.simulation import spawn_seeds

TARGET, WARM_UP = 30.0, 20


class SampledInstance:
    """An exported controller, stepped by its default step size from time zero: `sample`, `close`.

    Inputs and outputs go through buffers that are made once.
    """

    def __init__(self, path, inputs, outputs):
        description = read_model_description(str(path))
        reference = {v.name: v.valueReference for v in description.modelVariables}
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
        self._values = np.ctypeslib.as_array(self._given)
        self._result = np.ctypeslib.as_array(self._found)
        self._step = float(description.defaultExperiment.stepSize)
        self._count = 0

    def sample(self, values):
        fmu, component = self._fmu, self._fmu.component
        self._values[:] = values
        fmu.fmi2SetReal(component, self._inputs, len(self._inputs), self._given)
        fmu.fmi2DoStep(component, self._count * self._step, self._step, 0)
        fmu.fmi2GetReal(component, self._outputs, len(self._outputs), self._found)
        self._count += 1
        return self._result

    def close(self):
        self._fmu.terminate()
        self._fmu.freeInstance()
        shutil.rmtree(self._folder, ignore_errors=True)


def measure(scenario, steps, controller="tuned"):
    """Time each sample in both, in µs; the FMU is built by the local compiler.

    Raises AssertionError where their actions differ by more than 1e-6.
    """
    python = rti_controller(controller, scenario)
    compile_functions(python)
    seconds = {"Python": [], "FMU": []}
    lower, upper = scenario.action_lower, scenario.action_upper
    with FmuPlant(scenario) as plant, temporary_folder("cosim-") as folder:
        path = write_fmu(python, scenario, folder / "controller.fmu", 2)
        fmu = SampledInstance(path, scenario.plant.states, scenario.plant.actions)
        s = plant.reset(spawn_seeds(0)[0])
        for _ in range(WARM_UP + steps):
            begin = clock()
            python.prepare()
            solution = python.feedback(s)
            middle = clock()
            action = fmu.sample(s)
            end = clock()
            seconds["Python"].append(middle - begin)
            seconds["FMU"].append(end - middle)
            applied = np.clip(solution.action, lower, upper)
            assert np.abs(action - applied).max() < 1e-6
            s = plant.step(applied).s
        fmu.close()
    own, other = seconds["FMU"][WARM_UP:], seconds["Python"][WARM_UP:]
    return [figure("exported FMU", own, "Python", other, at_most=TARGET), figure("Python", other)]
