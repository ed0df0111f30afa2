"""A sample of the exported controller's FMU beside the Python controller's, in one closed loop."""

import numpy as np

from benchmarks.measuring import clock, figure
from controllers import compile_functions
from cosim import FmuPlant
from cosim.cli.controller_fmu import rti_controller, sampled_controller, write_fmu
from cosim.files import temporary_folder
from cosim.simulation import spawn_seeds
from fmus.sampled import SampledInstance

TARGET, WARM_UP = 30.0, 20


def measure(scenario, steps, controller="tuned"):
    """Time each sample in both, in µs; the FMU is built by the local compiler.

    Raises AssertionError where their actions differ by more than 1e-6.
    """
    python = rti_controller(controller, scenario)
    compile_functions(python)
    seconds = {"Python": [], "FMU": []}
    lower, upper = scenario.action_lower, scenario.action_upper
    with FmuPlant(scenario) as plant, temporary_folder("cosim-") as folder:
        system = sampled_controller(python, scenario, plant.units)
        path = write_fmu(system, python, scenario, folder / "controller.fmu", 2, False)
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
