import casadi as ca
import numpy as np
import pytest

from controllers.dynamic_programming import Elementwise
from controllers.evaporator import model
from controllers.model import discretise

UNARY = {
    "neg": lambda a: -a,
    "square": lambda a: a * a,
    "twice": lambda a: 2 * a,
    "inverse": lambda a: 1 / a,
    "exp": ca.exp,
    "log": ca.log,
    "log1p": ca.log1p,
    "expm1": ca.expm1,
    "sqrt": ca.sqrt,
    "power": lambda a: a**2.5,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "abs": ca.fabs,
    "sign": lambda a: ca.sign(a - 0.5),
    "floor": lambda a: ca.floor(3 * a),
    "ceil": lambda a: ca.ceil(3 * a),
    "not": lambda a: ca.logic_not(a > 0.5),
}
BINARY = {
    "pow": lambda a, b: a**b,
    "atan2": ca.atan2,
    "hypot": ca.hypot,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "less": lambda a, b: a < b,
    "less or equal": lambda a, b: a <= b,
    "equal": lambda a, b: ca.floor(2 * a) == ca.floor(2 * b),
    "unequal": lambda a, b: ca.floor(2 * a) != ca.floor(2 * b),
    "and": lambda a, b: ca.logic_and(a > 0.5, b > 0.5),
    "or": lambda a, b: ca.logic_or(a > 0.5, b > 0.5),
    "if else": lambda a, b: ca.if_else(a > b, ca.exp(a), b),
}


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_every_operation_agrees_with_casadi(name):
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    result = UNARY[name](a) if name in UNARY else BINARY[name](a, b)
    function = ca.Function("f", [ca.vertcat(a, b)], [result])
    points = np.random.default_rng(2).uniform(0.05, 0.95, (2, 200))
    (values,) = Elementwise(function)(points)
    np.testing.assert_allclose(
        np.broadcast_to(values, 200), function.map(200)(points).full()[0], rtol=1e-14
    )


def test_sampled_evaporator_agrees_with_casadi_to_rounding():
    evaporator = model()
    function = discretise(evaporator, 60.0, 4)
    generator = np.random.default_rng(5)
    x, u = generator.uniform(25, 60, (2, 300)), generator.uniform(100, 400, (2, 300))
    d = evaporator.nominal_disturbance[:, None] * generator.uniform(0.8, 1.2, (4, 300))
    p = evaporator.nominal_parameters
    expected = function.map(300)(x, u, d, np.tile(p[:, None], (1, 300))).full()
    np.testing.assert_allclose(Elementwise(function)(x, u, d, p), expected, rtol=1e-13)
