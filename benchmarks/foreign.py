"""Which FMUs of others run as plants: python -m benchmarks.foreign FILE_OR_FOLDER …

Of each FMU it makes a plant: its outputs are the states, its first input is the action; 20 samples
of its default step size. A row says that they ran, or the line by which the FMU was refused. The
FMUs are native code that this runs. docs/how-to/fmu.md says where to get some.
"""

from __future__ import annotations

import sys
from pathlib import Path

from cosim import FmuPlant, Scenario
from cosim.errors import CosimError
from cosim.plant.fmi import unpack
from cosim.plant.wiring import refusals
from cosim.result import markdown_table

SAMPLES, STEP = 20, 0.1
NUMBERS = ("Real", "Float", "Int", "UInt")


def names(description, causality):
    """The numbers of a causality, of an array the first element."""
    found = [
        variable
        for variable in description.modelVariables
        if variable.causality == causality and variable.type.startswith(NUMBERS)
    ]
    return [v.name + (f"[{','.join('0' for _ in v.shape)}]" if v.shape else "") for v in found]


def scenario(fmu, description):
    outputs = names(description, "output") or names(description, "local")
    inputs = names(description, "input")
    tunable = [v.name for v in description.modelVariables if v.variability == "tunable"]
    internal = description.coSimulation.fixedInternalStepSize
    preferred = getattr(description.defaultExperiment, "stepSize", None)
    action = (inputs + tunable)[0]
    known = {variable.name: variable for variable in description.modelVariables}
    start = float(str(known[action.partition("[")[0]].start or 0).split()[0])
    size = len(outputs)
    document = {
        "schema": 1,
        "name": fmu.stem,
        "sampling_time": float(preferred or internal or STEP),
        "discount": 0.9,
        "plant": {
            "fmu": str(fmu), "states": outputs, "actions": [action], "stage_cost": outputs[0],
            "initial_state": [0.0] * size,
        },
        "bounds": {
            "state_lower": [float("-inf")] * size, "state_upper": [float("inf")] * size,
            "action_lower": [start - 1], "action_upper": [start + 1],
        },
        "penalty": {"linear": [0.0] * size, "quadratic": [0.0] * size},
        "controller": {
            "reference_state": [0.0] * size, "reference_action": [start], "reference_cost": 0.0,
        },
    }  # fmt: skip
    return Scenario.from_dict(document), start


def verdict(fmu):
    """What came of a plant made of the FMU."""
    try:
        archive = unpack(fmu)
        for refusal in refusals(archive):
            return "", f"refused: {refusal}"
        description = archive.description
        made, action = scenario(fmu, description)
        with FmuPlant(made) as plant:
            plant.reset(0)
            for _ in range(SAMPLES):
                state = plant.step([action]).s
        about = f"FMI {description.fmiVersion}, {description.generationTool or 'no tool named'}"
        return about, f"{SAMPLES} samples; then {', '.join(f'{x:.4g}' for x in state[:4])}"
    except CosimError as error:
        return "", f"refused: {' '.join(str(error).split())}"


if __name__ == "__main__":
    given = [Path(argument) for argument in sys.argv[1:]]
    files = [file for path in given for file in (path.rglob("*.fmu") if path.is_dir() else [path])]
    rows = [(file.stem, *verdict(file)) for file in sorted(files)]
    print(markdown_table(("FMU", "made by", "as a plant"), rows).replace("---:", "---"))
