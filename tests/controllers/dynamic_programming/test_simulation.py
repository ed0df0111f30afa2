import pytest

from controllers.dynamic_programming.certificate import certify, simulate_policy, study
from controllers.dynamic_programming.policy_iteration import Settings, solve
from tests.helpers.linear_plant import SCALAR

PLANT = SCALAR.plant


@pytest.fixture(scope="module")
def optimum():
    return solve(PLANT, Settings())


def test_the_simulated_mean_cost_is_the_linear_regulators(optimum):
    mean, half_width = simulate_policy(PLANT, optimum, paths=400, steps=1000)
    exact = SCALAR.mean_cost(SCALAR.riccati()[1])
    assert half_width < 0.01 * exact
    assert abs(mean - exact) < 2 * half_width


def test_a_study_is_certified_by_what_it_found(optimum):
    rows = study(PLANT, Settings(), optimum)
    certified = certify(PLANT, rows, paths=200, steps=500)
    certificate = certified.certificate
    assert [figure.name for figure in certificate.figures] == [
        "solution",
        "refinement",
        "simulation",
    ]
    assert certified.gain == rows[1].optimum.gain
    assert certificate["solution"].value == optimum.gain
    assert certificate["refinement"].value == rows[1].optimum.gain
    # So short a simulation cannot certify.
    assert certificate.objection() is not None
