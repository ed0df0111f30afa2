"""What is known of signals as inputs of the exported controller, beside the Python controller."""

import subprocess

import fmpy
import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, Scenario
from cosim.cli.controller_fmu import sampled_controller, write_c
from cosim.core.signals import Signals
from fmus.build import build_model
from tests.controllers.export.test_plain import built
from tests.helpers.compiler import needs_compiler
from tests.helpers.instance import Instance

ACTION = 1e-10
HORIZON = {"controller": {"horizon": 4}}
# Both change within a few samples: the horizon of some samples sees a change, of others none.
PREVIEW = {"name": "least", "values": [25.0, 27.0], "period": 720.0, "bound": "x_l[X2]"}
NOW = {"name": "pressure", "values": [49.0, 51.0, 50.0], "period": 900.0, "reference": "P2"}
SIGNALS = [PREVIEW | {"known": "preview", "ahead": 2}, NOW | {"known": "now"}]

pytestmark = needs_compiler


def closed_loop(scenario, samples):
    """States, what is known, and the Python controller's actions of a run."""
    controller = naive(scenario)
    signals = Signals(scenario)
    states, knowns, actions = [], [], []
    with FmuPlant(scenario) as plant:
        s = plant.reset(5)
        for k in range(samples):
            known = signals.known(k)
            controller.inform(known)
            controller.prepare()
            action = controller.feedback(s).action
            action = np.clip(action, scenario.action_lower, scenario.action_upper)
            states.append(s)
            knowns.append(np.concatenate(list(known.values())))
            actions.append(action)
            s = plant.step(action).s
    return np.array(states), np.array(knowns), np.array(actions)


@pytest.mark.parametrize(
    ("name", "changes", "samples"),
    [
        ("paper", HORIZON | {"signal": SIGNALS}, 60),
        pytest.param("prices", {}, 300, marks=pytest.mark.slow),
        pytest.param("set-point", {}, 300, marks=pytest.mark.slow),
    ],
)
def test_plain_c_gives_the_actions_of_the_python_controller(tmp_path, name, changes, samples):
    scenario = Scenario.load(name).replace(changes)
    states, knowns, actions = closed_loop(scenario, samples)
    write_c(naive(scenario), scenario, tmp_path / "nmpc")
    program = built(tmp_path / "nmpc")
    rows = np.hstack([states, knowns])
    text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    result = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    found = np.array([list(map(float, line.split())) for line in result.stdout.splitlines()])
    assert set(found[:, 2]) == {0}
    np.testing.assert_allclose(found[:, :2], actions, rtol=0, atol=ACTION)


@pytest.mark.usefixtures("quickly_built")
@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_the_fmu_gives_them_and_one_that_is_not_finite_is_a_failure(tmp_path, version):
    scenario = Scenario.load("paper").replace(HORIZON | {"signal": SIGNALS})
    states, knowns, actions = closed_loop(scenario, 30)
    system = sampled_controller(naive(scenario), scenario)
    fmpy.extract(str(build_model(system, tmp_path / "c.fmu", version)), str(tmp_path / "c"))
    fmu = Instance(tmp_path / "c", version).initialise()
    names = [variable.name for variable in system.variables if variable.name.startswith("signal.")]
    assert names == ["signal.least[0]", "signal.least[1]", "signal.least[2]", "signal.pressure"]
    units = {variable.name: variable.unit for variable in system.variables}
    assert [units[name] for name in names[-2:]] == ["%", "kPa"]

    def give(values):
        if version == 2:
            fmu.fmu.setReal([fmu.reference(name) for name in names], values)
        else:
            arrays = [fmu.reference("signal.least"), fmu.reference("signal.pressure")]
            fmu.fmu.setFloat64(arrays, values)

    for k, (s, known, action) in enumerate(zip(states, knowns, actions, strict=True)):
        fmu.set(X2=s[0], P2=s[1])
        give(known.tolist())
        fmu.step(60.0 * k)
        np.testing.assert_allclose(fmu.get("P100", "F200"), action, rtol=0, atol=ACTION)
    for place in range(4):
        give([np.nan if i == place else 26.0 for i in range(4)])
        assert fmu.get("qp_status") == [3.0]
    fmu.close()
