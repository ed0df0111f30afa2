from math import exp

import numpy as np
import pytest

from controllers.model import Model, Quantity, discretise


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


def test_the_error_falls_with_the_fourth_power_of_the_step():
    # x' = -x²/2 from 1 has x(t) = 2/(2 + t).
    model = scalar_model(lambda x, u, d, p: -(x**2) / 2)
    errors = [abs(advance(model, 4.0, n, [1.0], [0.0])[0] - 1 / 3) for n in (8, 16, 32, 64)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(orders, 4, atol=0.25)


def test_the_time_unit_scales_the_rate():
    model = scalar_model(lambda x, u, d, p: p[0] * x, time_unit=60.0)
    assert advance(model, 60.0, 20, [1.0], [0.0])[0] == pytest.approx(exp(-0.7), rel=1e-7)
