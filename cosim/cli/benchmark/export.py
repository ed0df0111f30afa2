"""Times a sample of the exported controller's FMU beside the Python controller, in one run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from controllers import RtiNmpc, compile_functions
from cosim.cli.benchmark.figures import clock, figure
from cosim.cli.compose import build_plant
from cosim.cli.controller_fmu import rti_controller, sampled_controller, write_fmu
from cosim.files import temporary_folder
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds
from fmus.sampled import SampledInstance

TARGET = 30.0
WARM_UP = 20


def measure(
    scenario: Scenario, controller: str, steps: int, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Time each sample of one closed loop in both, in µs, and compare their actions.

    The FMU is built by the local compiler and called through preallocated buffers: state in,
    `doStep`, action out. Python's time is `prepare` and `feedback` with the scenario's backend.
    Raises ControllerLookupError on a controller that cannot be exported.
    """
    python = rti_controller(controller, scenario)
    compile_functions(python)
    with build_plant(scenario) as plant, temporary_folder("cosim-") as folder:
        system = sampled_controller(python, scenario, plant.units)
        path = write_fmu(system, python, scenario, folder / "controller.fmu", 2, False)
        fmu = SampledInstance(path, scenario.plant.states, scenario.plant.actions)
        try:
            seconds, differences = _run(plant, python, fmu, steps, progress)
        finally:
            fmu.close()
    row = figure("exported FMU", seconds["FMU"], "Python", seconds["Python"], at_most=TARGET)
    return {
        "scenario": scenario.name,
        "controller": controller,
        "hessian": scenario.controller.hessian,
        "steps": steps,
        "functions": python.functions,
        "largest_difference": max(differences),
        "rows": [row, figure("Python", seconds["Python"])],
    }


def _run(
    plant: Any, python: RtiNmpc, fmu: SampledInstance, steps: int, progress: Callable[[int], None]
) -> tuple[dict[str, list[float]], list[float]]:
    seconds: dict[str, list[float]] = {"Python": [], "FMU": []}
    differences = []
    lower, upper = plant.scenario.action_lower, plant.scenario.action_upper
    s = plant.reset(spawn_seeds(0)[0])
    for k in range(WARM_UP + steps):
        begin = clock()
        python.prepare()
        solution = python.feedback(s)
        middle = clock()
        action = fmu.sample(s)
        end = clock()
        applied = np.clip(solution.action, lower, upper)
        if k >= WARM_UP:
            seconds["Python"].append(middle - begin)
            seconds["FMU"].append(end - middle)
            differences.append(float(np.abs(action - applied).max()))
            progress(k - WARM_UP + 1)
        s = plant.step(applied).s
    return seconds, differences
