"""Foreign FMUs as plants, against fmpy: python -m benchmarks.foreign FILE_OR_FOLDER …

Each FMU is stepped by `FmuPlant` and simulated by `fmpy.simulate_fmu` under the same inputs: the
start values held, then a varied table. All numbers among its outputs after each of 20 steps are
compared bit by bit. A row says `same`; where, by how much and why they differ; or the line by which
the FMU was refused. The FMUs are native code that this runs, each in a process of its own.
docs/reference/scenario.md says where to get some.
"""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from pathlib import Path

import fmpy
import numpy as np

from cosim import FmuPlant, Scenario
from cosim.core.errors import CosimError
from cosim.core.result import markdown_table
from cosim.plant.draft import elements, limits_of, start_value
from cosim.plant.fmi import number, unpack
from cosim.plant.wiring import refusals

SAMPLES, STEP = 20, 0.125  # fmpy's sums of this step are exact
TIMEOUT = 300.0  # s for one FMU
WORDS = 200  # last characters of what a crashed process said
NUMBERS = ("Real", "Float", "Int", "UInt")
PATTERN = np.array([0.0, 1.0, -1.0, 0.5, 0.25, -0.5, 0.75])
"""The varied input by sample, again and again, as a share of a quarter of the input's range."""


def first_elements(description, causality):
    """Names of the numbers of a causality, of an array its first element."""
    numbers = [
        variable
        for variable in description.modelVariables
        if variable.causality == causality and variable.type.startswith(NUMBERS)
    ]
    return [elements(variable)[0] for variable in numbers]


def scenario_of(fmu, archive):
    """A scenario: outputs are states, inputs are actions, the step size is the file's."""
    description = archive.description
    states = first_elements(description, "output") or first_elements(description, "local")
    tunable = [
        variable.name
        for variable in description.modelVariables
        if variable.variability == "tunable" and variable.causality == "parameter"
    ]
    actions = first_elements(description, "input") or tunable[:1]
    start = [start_value(archive, name) for name in actions]
    limits = [limits_of(archive, *pair) for pair in zip(actions, start, strict=True)]
    internal = number(description.coSimulation.fixedInternalStepSize, 0.0)
    preferred = number(getattr(description.defaultExperiment, "stepSize", None), 0.0)
    n = len(states)
    document = {
        "schema": 1,
        "name": fmu.stem,
        "sampling_time": preferred or internal or STEP,
        "discount": 0.9,
        "plant": {
            "fmu": str(fmu), "states": states, "actions": actions, "stage_cost": states[0],
            "initial_state": [0.0] * n,
        },
        "bounds": {
            "state_lower": [-np.inf] * n, "state_upper": [np.inf] * n,
            "action_lower": [low for low, _ in limits],
            "action_upper": [high for _, high in limits],
        },
        "penalty": {"linear": [0.0] * n, "quadratic": [0.0] * n},
        "controller": {
            "reference_state": [0.0] * n, "reference_action": start, "reference_cost": 0.0,
        },
    }  # fmt: skip
    return Scenario.from_dict(document)


def inputs_of(scenario, archive, varied):
    """Inputs (samples, m): the start values, or a table about them within the actions' range."""
    start = np.clip(scenario.reference_action, scenario.action_lower, scenario.action_upper)
    table = np.tile(start, (SAMPLES, 1))
    if varied:
        quarter = (scenario.action_upper - scenario.action_lower) / 4.0
        table += np.resize(PATTERN, SAMPLES)[:, None] * quarter
        table = np.clip(table, scenario.action_lower, scenario.action_upper)
    for column, name in zip(table.T, scenario.plant.actions, strict=True):
        if not archive.variable(name).type.startswith(("Real", "Float")):
            column[:] = np.round(column)
    return table


def stepped(scenario, table):
    """States (samples, n) after each step of `FmuPlant`."""
    with FmuPlant(scenario) as plant:
        plant.reset(0)
        return np.array([plant.step(action).s for action in table])


def simulated(scenario, archive, table, *, exact_steps=False):
    """The same by fmpy; with `exact_steps` each step has the sampling time to the last bit."""
    description, h = archive.description, scenario.sampling_time
    start = number(getattr(description.defaultExperiment, "startTime", None), 0.0)
    # A value is held up to the next sample: two rows of one time are a step in fmpy's tables.
    times = start + np.arange(SAMPLES + 1) * h
    columns, values = [("time", float)], []
    for name, column in zip(scenario.plant.actions, table.T, strict=True):
        variable = archive.variable(name)
        # Of an array the other elements keep their start values.
        whole = [[start_value(archive, other) for other in elements(variable)]] * SAMPLES
        whole = np.array(whole).reshape(SAMPLES, *variable.shape)
        whole[:, *[0] * len(variable.shape)] = column
        columns.append((variable.name, variable._python_type, variable.shape))
        values.append(whole)
    signals = np.zeros(2 * SAMPLES, dtype=columns)
    signals["time"] = np.repeat(times, 2)[1:-1]
    for (name, *_), whole in zip(columns[1:], values, strict=True):
        signals[name] = np.repeat(whole, 2, axis=0)
    outputs = [archive.variable(name) for name in scenario.plant.states]
    instance = fmpy.instantiate_fmu(str(archive.folder), description, "CoSimulation")
    if exact_steps:
        step = instance.doStep
        instance.doStep = lambda **where: step(**where | {"communicationStepSize": h})
    try:
        result = fmpy.simulate_fmu(
            str(archive.folder),
            validate=False,
            model_description=description,
            fmu_instance=instance,
            start_time=start,
            stop_time=times[-1],
            output_interval=h,
            input=signals,
            output=[variable.name for variable in outputs],
            fmi_type="CoSimulation",
        )
    finally:
        instance.freeInstance()
    last = np.searchsorted(result["time"], times[1:] + 1e-6 * h) - 1
    columns = [result[v.name][last].reshape(SAMPLES, -1)[:, 0] for v in outputs]
    return np.stack(columns, axis=1).astype(float)


def difference(scenario, rows, expected):
    """Where two tables differ first, and by how much at most; empty if nowhere."""
    differs = ~((rows == expected) | (np.isnan(rows) & np.isnan(expected)))
    if not differs.any():
        return ""
    k, i = np.argwhere(differs)[0]
    scale = np.maximum(np.max(np.abs(expected), axis=0), np.finfo(float).tiny)
    most = np.max(np.abs(rows - expected) / scale)
    name = scenario.plant.states[i]
    pair = f"{float(rows[k, i])!r}, not {float(expected[k, i])!r}"
    return f"{name} at sample {k + 1}: {pair}; at most {most:.1e} of its range"


def comparison(scenario, archive, varied):
    """`same`, or where and why the plant differs from fmpy."""
    table = inputs_of(scenario, archive, varied)
    rows = stepped(scenario, table)
    expected = simulated(scenario, archive, table)
    where = difference(scenario, rows, expected)
    if not where:
        return "same"
    if not difference(scenario, rows, simulated(scenario, archive, table, exact_steps=True)):
        return "same but for fmpy's step sizes, (k+1)h − kh rounded"
    if difference(scenario, expected, simulated(scenario, archive, table)):
        return f"fmpy differs from itself: the FMU does not repeat; {where}"
    if difference(scenario, rows, stepped(scenario, table)):
        return f"FmuPlant differs from itself: {where}"
    return f"differs: {where}"


def verdict(fmu):
    """Who made the FMU, and what came of it with constant and with varied inputs."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            archive = unpack(fmu)
        for refusal in refusals(archive):
            return "", f"refused: {refusal}", ""
        about = f"FMI {archive.description.fmiVersion}, {archive.description.generationTool or '–'}"
        scenario = scenario_of(fmu, archive)
    except CosimError as error:
        return "", f"refused: {' '.join(str(error).split())}", ""
    words = []
    for varied in (False, True):
        try:
            words.append(comparison(scenario, archive, varied))
        except CosimError as error:
            words.append(f"refused: {' '.join(str(error).split())}")
        except Exception as error:  # fmpy raises bare Exception
            words.append(f"fmpy fails: {' '.join(str(error).split())}")
    return about, *words


def row(fmu):
    """A row of the table, found in a process of its own: an FMU may crash."""
    command = [sys.executable, "-m", "benchmarks.foreign", "--one", str(fmu.resolve())]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return fmu.stem, "", f"no result after {TIMEOUT:.0f} s", ""
    lines = [line for line in done.stdout.splitlines() if line.startswith('["')]
    if done.returncode or not lines:
        said = " ".join(done.stderr.split())[-WORDS:]
        return fmu.stem, "", f"ended with code {done.returncode}: {said}", ""
    return fmu.stem, *json.loads(lines[-1])


def main(arguments):
    """Print the table of the files and folders, or the row of one file as JSON."""
    if arguments[:1] == ["--one"]:
        print("\n" + json.dumps(verdict(Path(arguments[1]))))
        return
    given = [Path(argument) for argument in arguments]
    files = [file for path in given for file in (path.rglob("*.fmu") if path.is_dir() else [path])]
    header = ("FMU", "made by", "constant inputs", "varied inputs")
    table = markdown_table(header, [row(file) for file in sorted(files)])
    print(table.replace("---:", "---"))


if __name__ == "__main__":
    main(sys.argv[1:])
