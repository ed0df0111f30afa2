from math import exp

import casadi as ca
import numpy as np
import pytest

from controllers.errors import ModelError
from controllers.evaporator import model as evaporator
from controllers.model import Model, Quantity, discretise, economic_cost


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


def test_the_input_is_held_over_the_sample():
    model = scalar_model(lambda x, u, d, p: u)
    assert advance(model, 3.0, 2, [1.0], [0.5])[0] == 2.5


@pytest.mark.parametrize(
    ("sampling_time", "substeps"), [(0.0, 1), (-1.0, 1), (np.nan, 1), (1.0, 0)]
)
def test_discretise_refuses_no_time_and_no_steps(sampling_time, substeps):
    with pytest.raises(ModelError, match="must both be positive"):
        discretise(evaporator(), sampling_time, substeps)


def test_parameters_are_found_by_name():
    model = evaporator()
    indices = model.parameter_indices(("UA2", "h"))
    assert model.nominal_parameters[indices].tolist() == [6.84, 0.16]


def test_an_unknown_parameter_is_named_with_those_there_are():
    with pytest.raises(ModelError, match=r"no parameter 'UA3'; it has a, b, .*UA2"):
        evaporator().parameter_indices(("h", "UA3"))


def test_a_doubled_parameter_is_refused():
    with pytest.raises(ModelError, match="once each: h, h"):
        evaporator().parameter_indices(("h", "h"))


def test_economic_cost_is_a_function_of_all_arguments():
    model = scalar_model(lambda x, u, d, p: u)
    value = economic_cost(model)(3.0, 0.5, ca.DM.zeros(0), [0.0])
    assert float(value) == 9.5
