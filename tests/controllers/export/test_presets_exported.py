"""Each preset with sensors or signals, exported in all forms, beside Python over 500 samples."""

import subprocess

import fmpy
import numpy as np
import pytest

from controllers.factories import build_controller
from cosim import FmuPlant, Scenario
from cosim.cli.controller_fmu import rti_controller, sampled_controller, write_c
from cosim.core.signals import Signals
from fmus.build import build_model
from tests.controllers.export.test_plain import built
from tests.helpers.compiler import needs_compiler
from tests.helpers.instance import Instance

PRESETS = ("assay", "late", "levels", "prices", "set-point", "forecast")
CONTROLLER = "tuned"
SAMPLES = 500
SEED = 11
ACTION = 1e-10

pytestmark = [pytest.mark.slow, needs_compiler]


def closed_loop(name):
    """What a controller is given at each sample of a run, and the Python controller's actions.

    Returns:
        Readings or states (K, n_y), NaN where nothing came; known values of each signal, by name,
        (K, 1 + ahead); actions (K, m).
    """
    scenario = Scenario.load(name)
    law = build_controller(CONTROLLER, scenario)
    law.reset()
    signals = Signals(scenario)
    rows, actions = [], []
    known = {}
    with FmuPlant(scenario) as plant:
        signals.foresee(plant, SEED, SAMPLES)
        s = plant.reset(SEED)
        for k in range(SAMPLES):
            given = plant.y if scenario.sensors else s
            for signal, values in signals.known(k).items():
                known.setdefault(signal, []).append(values)
            if scenario.signals:
                law.inform(signals.known(k))
            law.prepare()
            action = law.feedback(given).action
            action = np.clip(action, scenario.action_lower, scenario.action_upper)
            if scenario.sensors:
                law.applied(action)
            rows.append(given)
            actions.append(action)
            s = plant.step(action).s
    known = {signal: np.array(values) for signal, values in known.items()}
    return np.array(rows), known, np.array(actions)


@pytest.mark.parametrize("name", PRESETS)
def test_plain_c(name, tmp_path):
    scenario = Scenario.load(name)
    rows, known, actions = closed_loop(name)
    write_c(rti_controller(CONTROLLER, scenario), scenario, tmp_path / "nmpc")
    table = np.hstack([rows, *known.values()])
    text = "\n".join(" ".join(map(repr, row)) for row in table.tolist())
    program = built(tmp_path / "nmpc")
    result = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    found = np.array([list(map(float, line.split())) for line in result.stdout.splitlines()])
    m = actions.shape[1]
    assert set(found[:, m]) == {0}
    np.testing.assert_allclose(found[:, :m], actions, rtol=0, atol=ACTION)


@pytest.mark.usefixtures("quickly_built")
@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("name", PRESETS)
def test_the_fmu(name, version, tmp_path):
    scenario = Scenario.load(name)
    rows, known, actions = closed_loop(name)
    system = sampled_controller(rti_controller(CONTROLLER, scenario), scenario)
    fmpy.extract(str(build_model(system, tmp_path / "c.fmu", version)), str(tmp_path / "c"))
    fmu = Instance(tmp_path / "c", version).initialise()
    tables = scenario.sensors or ()
    names = [sensor.variable for sensor in tables] or list(scenario.plant.states)
    for k, row in enumerate(rows):
        for variable, value in zip(names, row.tolist(), strict=True):
            if not tables:
                fmu.set(**{variable: value})
                continue
            fresh = not np.isnan(value)
            fmu.set(**{f"y_{variable}": value if fresh else 0.0, f"y_{variable}_fresh": fresh})
        for signal, values in known.items():
            give(fmu, version, signal, values[k].tolist())
        fmu.step(scenario.sampling_time * k)
        found = fmu.get(*scenario.plant.actions)
        np.testing.assert_allclose(found, actions[k], rtol=0, atol=ACTION)
    assert fmu.get("failures") == [0.0]
    fmu.close()


def give(fmu, version, signal, values):
    """Set what is known of a signal: in FMI 3 an array, in FMI 2 a variable for each value."""
    name = f"signal.{signal}"
    if version == 3 or len(values) == 1:
        setter = fmu.fmu.setFloat64 if version == 3 else fmu.fmu.setReal
        setter([fmu.reference(name)], values)
        return
    references = [fmu.reference(f"{name}[{j}]") for j in range(len(values))]
    fmu.fmu.setReal(references, values)
