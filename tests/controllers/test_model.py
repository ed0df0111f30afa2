"""The control model against the paper's equations, solved here by SciPy and plain Python."""

from math import exp

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from controllers.evaporator import model as evaporator
from controllers.model import Model, Quantity, discretise, economic_cost
from tests.helpers import paper


def scalar_model(ode, time_unit=1.0):
    return Model(
        name="scalar",
        states=(Quantity("x", "1"),),
        actions=(Quantity("u", "1"),),
        disturbances=(),
        parameters=(Quantity("a", "1/s", -0.7),),
        ode=ode,
        economic_cost=lambda x, u, d, p: x[0] ** 2 + u[0],
        time_unit=time_unit,
    )


def advance(model, sampling_time, substeps, x, u):
    f = discretise(model, sampling_time, substeps)
    return np.array(f(x, u, model.nominal_disturbance, model.nominal_parameters)).reshape(-1)


def test_one_step_on_a_linear_ode_is_the_taylor_polynomial_of_degree_four():
    z = -0.7 * 1.5
    expected = 2.0 * (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)
    model = scalar_model(lambda x, u, d, p: p[0] * x)
    assert advance(model, 1.5, 1, [2.0], [0.0])[0] == pytest.approx(expected, rel=1e-15)


def test_the_time_unit_scales_the_rate():
    model = scalar_model(lambda x, u, d, p: p[0] * x, time_unit=60.0)
    assert advance(model, 60.0, 20, [1.0], [0.0])[0] == pytest.approx(exp(-0.7), rel=1e-7)


NOMINAL = (5.0, 10.0, 40.0, 25.0)


def rate_and_cost(x, u, d=NOMINAL, **changes):
    found = paper.evaporator(x, u, d, **changes)
    return found["rates"], found["economic_cost"]


@pytest.fixture(scope="module")
def samples():
    rng = np.random.default_rng(5)
    size = (50, 2)
    disturbances = [5, 10, 40, 25] + rng.uniform(-1, 1, (50, 4)) * [1, 2, 8, 5]
    return list(
        zip(rng.uniform(20, 80, size), rng.uniform(100, 400, size), disturbances, strict=True)
    )


def test_rate_and_cost_are_those_of_the_paper(samples):
    model = evaporator()
    x, u, d, p = model.symbols()
    f = ca.Function("f", [x, u, d, p], [model.ode(x, u, d, p)])
    cost = economic_cost(model)
    for x, u, d in samples:
        rate, expected = rate_and_cost(x, u, d)
        arguments = (x, u, d, model.nominal_parameters)
        np.testing.assert_allclose(np.array(f(*arguments)).ravel(), rate, rtol=1e-12, atol=1e-12)
        assert float(cost(*arguments)) == pytest.approx(expected, rel=1e-13)


def test_a_sample_follows_an_accurate_integration_to_fourth_order(samples):
    model = evaporator()
    errors = []
    for substeps in (2, 4, 8):
        f = discretise(model, 60.0, substeps)
        worst = 0.0
        for x, u, d in samples:
            exact = solve_ivp(
                lambda _, x, u=u, d=d: rate_and_cost(x, u, d)[0], (0, 1), x, rtol=1e-13, atol=1e-13
            ).y[:, -1]
            found = np.array(f(x, u, d, model.nominal_parameters)).ravel()
            worst = max(worst, np.abs(found - exact).max())
        errors.append(worst)
    # The scenario takes two steps; the disturbances move X2 by some 0.5 % in a sample.
    assert errors[0] < 3e-3
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 4, atol=0.3)
