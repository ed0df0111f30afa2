"""Whatever θ a controller is given, the loop goes on: actions in their box, failures counted."""

import math

import numpy as np
import pytest

from controllers import Parameters, Problem
from controllers.errors import ControllerError, ParameterError
from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate

STEPS = 60


def everywhere(change):
    """All of θ changed but the bounds, which would be refused for themselves."""
    return lambda p: (
        p.with_theta(change(p.theta)).replace({name: p[name] for name in ("x_l", "x_u")}).theta
    )


WHOLE = {
    "all zero": everywhere(lambda t: 0.0 * t),
    "all huge": everywhere(lambda t: 0.0 * t + 1e12),
    "crossed bounds": lambda p: p.replace({"x_l": p["x_u"], "x_u": p["x_l"]}).theta,
    "bounds that meet": lambda p: p.replace({"x_l": p["x_u"]}).theta,
    **{
        f"drawn, {scale:g}": everywhere(
            lambda t, scale=scale: scale * np.random.default_rng(int(scale)).normal(size=len(t))
        )
        for scale in (1.0, 1e6)
    },
}


@pytest.fixture(scope="module")
def loop():
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        yield plant, naive(scenario), Parameters.naive(Problem.from_scenario(scenario))


def hold(loop, change):
    plant, controller, start = loop
    try:
        controller.theta = change(start)
        run = simulate(plant, controller, STEPS, 0)
    except ParameterError as error:
        assert "must stay below" in str(error)
        assert "\n" not in str(error)
        return
    scenario = plant.scenario
    assert len(run) == STEPS
    assert np.isfinite(run.actions).all()
    assert (run.actions >= scenario.action_lower).all()
    assert (run.actions <= scenario.action_upper).all()
    failed = int(run["failed"].sum())
    assert run.summary()["failures"] == failed
    assert math.isfinite(run.summary()["J"])


@pytest.mark.parametrize("kind", WHOLE)
def test_an_absurd_theta_is_refused_or_the_loop_goes_on(loop, kind):
    hold(loop, WHOLE[kind])


@pytest.mark.parametrize("value", [math.nan, -math.inf])
def test_a_theta_that_is_no_number_is_refused(loop, value):
    _, controller, start = loop
    theta = start.theta.copy()
    theta[-1] = value
    with pytest.raises(ControllerError, match="finite"):
        start.with_theta(theta)
    controller.theta = start.theta
    with pytest.raises(ControllerError):
        controller.theta = theta
    assert np.array_equal(controller.theta, start.theta)
