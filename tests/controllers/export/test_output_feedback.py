"""Filter and NMPC as plain C and as an FMU, beside the Python controller in a closed loop."""

import subprocess

import fmpy
import numpy as np
import pytest

from controllers import ExtendedKalmanFilter, OutputFeedback
from controllers.factories import nmpc, tuned
from controllers.problem import Problem
from controllers.theta import add_margin
from cosim import FmuPlant, Scenario
from cosim.cli.controller_fmu import rti_controller, sampled_controller, write_c
from cosim.core.errors import CosimError
from cosim.core.signals import Signals
from fmus.build import build_model
from tests.controllers.export.test_plain import built
from tests.helpers.compiler import needs_compiler
from tests.helpers.instance import Instance

ACTION = 1e-10
SHORT = {"controller": {"horizon": 3}}
LATE = {
    "sensor": [
        {"variable": "X2", "every": 5, "delay": 3, "deviation": 0.1},
        {"variable": "P2", "deviation": 0.5},
    ]
}


FEED = {
    "name": "feed",
    "values": [5.0, 4.8, 5.1],
    "period": 540.0,
    "plant": "X1_nominal",
    "model": "X1",
    "known": "preview",
}


def with_noise(scenario):
    """A controller whose θ has variances of the filter, which are not the scenario's."""
    estimator = ExtendedKalmanFilter.from_scenario(scenario)
    estimator.noise = estimator.noise + np.linspace(-1.0, 1.0, estimator.noise.size)
    return nmpc(scenario, estimator.add_noise(tuned(scenario).parameters))


def with_margin(scenario):
    """The same whose bounds follow the estimate's deviation; one of them as far as they may."""
    parameters = with_noise(scenario).parameters
    parameters = add_margin(parameters, Problem.from_scenario(scenario))
    # No deviation is as small as a hundredth of the width that the last factor makes the limit.
    return nmpc(scenario, parameters.replace({"margin": [1.8, 0.4, 0.3, 100.0]}))


def closed_loop(scenario, controller, samples):
    """Readings of a run, NaN where nothing came, and the Python controller's actions and state."""
    law = OutputFeedback.from_scenario(scenario, controller)
    law.reset()
    signals = Signals(scenario)
    readings, actions, estimates = [], [], []
    with FmuPlant(scenario) as plant:
        plant.reset(7)
        for k in range(samples):
            known = signals.known(k)
            readings.append(np.concatenate([plant.y, *known.values()]))
            law.inform(known)
            law.prepare()
            action = law.feedback(plant.y).action
            action = np.clip(action, scenario.action_lower, scenario.action_upper)
            law.applied(action)
            actions.append(action)
            parameters = list(law.estimator.parameters.values())
            estimates.append([*law.estimate, *parameters])
            plant.step(action)
    return np.array(readings), np.array(actions), np.array(estimates)


def printed(program, readings):
    """What the example program prints of each sample."""
    text = "\n".join(" ".join(map(repr, y)) for y in readings.tolist())
    result = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    return np.array([list(map(float, line.split())) for line in result.stdout.splitlines()])


@needs_compiler
@pytest.mark.parametrize(
    ("changes", "make", "samples"),
    [
        (SHORT | LATE | {"signal": [FEED]}, with_noise, 100),
        (SHORT, with_margin, 100),
        pytest.param(SHORT | LATE, with_margin, 500, marks=pytest.mark.slow),
        pytest.param({}, tuned, 500, marks=pytest.mark.slow),
        pytest.param(SHORT | LATE, with_noise, 500, marks=pytest.mark.slow),
    ],
)
def test_plain_c_gives_the_actions_of_the_python_controller(tmp_path, changes, make, samples):
    scenario = Scenario.load("assay").replace(changes)
    controller = make(scenario)
    readings, actions, _ = closed_loop(scenario, controller, samples)
    assert np.isnan(readings).any()
    write_c(controller, scenario, tmp_path / "nmpc")
    rows = printed(built(tmp_path / "nmpc"), readings)
    assert set(rows[:, 2]) == {0}
    np.testing.assert_allclose(rows[:, :2], actions, rtol=0, atol=ACTION)


@needs_compiler
@pytest.mark.usefixtures("quickly_built")
@pytest.mark.slow
@pytest.mark.parametrize(("version", "make"), [(2, with_noise), (3, with_margin)])
def test_the_fmu_gives_them_and_goes_on_from_its_bytes(tmp_path, version, make):
    """Actions and estimates of both; a second instance from bytes in the middle has the same."""
    scenario = Scenario.load("assay").replace(SHORT | LATE)
    controller = make(scenario)
    samples = 40
    readings, actions, estimates = closed_loop(scenario, controller, samples)
    system = sampled_controller(controller, scenario)
    fmpy.extract(str(build_model(system, tmp_path / "c.fmu", version)), str(tmp_path / "c"))
    one, other = (Instance(tmp_path / "c", version).initialise() for _ in range(2))
    outputs = ("P100", "F200", "estimated.X2", "estimated.P2", "estimated.UA2")
    for k, y in enumerate(readings):
        if k == samples // 2:
            other.restore(other.deserialise(one.serialise(one.save())))
        found = []
        for fmu in (one,) if k < samples // 2 else (one, other):
            # A reading that was set before the sample's own one leaves no trace.
            fmu.set(y_X2=99.0, y_X2_fresh=True, y_P2=1.0, y_P2_fresh=True)
            fmu.get("P100")
            for name, value in zip(("X2", "P2"), y.tolist(), strict=True):
                fresh = not np.isnan(value)
                fmu.set(**{f"y_{name}": value if fresh else 0.0, f"y_{name}_fresh": fresh})
            fmu.step(60.0 * k)
            found.append(fmu.get(*outputs))
        assert found[0] == found[-1]
        np.testing.assert_allclose(found[0][:2], actions[k], rtol=0, atol=ACTION)
        np.testing.assert_allclose(found[0][2:], estimates[k], rtol=1e-10)
    for fmu in (one, other):
        fmu.close()


@pytest.mark.slow
@needs_compiler
@pytest.mark.usefixtures("quickly_built")
def test_a_failed_sensor_is_no_reading_and_units_are_the_sensors(tmp_path):
    scenario = Scenario.load("assay").replace(SHORT)
    system = sampled_controller(rti_controller("naive", scenario), scenario)
    units = {variable.name: variable.unit for variable in system.variables}
    assert (units["y_X2"], units["y_P2"]) == (units["estimated.X2"], units["estimated.P2"])
    assert units["y_P2"] == "kPa"
    fmpy.extract(str(build_model(system, tmp_path / "c.fmu")), str(tmp_path / "c"))
    found = []
    for fresh in (True, False):
        fmu = Instance(tmp_path / "c", 2).initialise()
        for k in range(3):
            failed = fresh and k == 1
            y = np.nan if failed else 50.0
            fmu.set(y_P2=y, y_P2_fresh=k != 1 or fresh)
            fmu.step(60.0 * k)
        found.append(fmu.get("P100", "qp_status", "failures", "estimated.P2"))
        fmu.close()
    assert found[0] == found[1]
    assert found[0][1:3] == [0.0, 0.0]


def test_other_estimators_and_very_late_readings_are_refused():
    late = [{"variable": "X2", "delay": 60}, {"variable": "P2"}]
    scenario = Scenario.load("assay").replace({"sensor": late})
    with pytest.raises(CosimError, match="shorten its delay"):
        sampled_controller(rti_controller("naive", scenario), scenario)
    other = Scenario.load("assay").replace({"estimator": {"kind": "none"}})
    with pytest.raises(CosimError, match="of kind 'none' cannot be exported"):
        sampled_controller(tuned(other), other)
