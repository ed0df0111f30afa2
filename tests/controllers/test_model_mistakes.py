"""What people write as a model: accepted, or one line that says what is wrong when it is made."""

import math
import re

import casadi as ca
import numpy as np
import pytest

from controllers import Model, Quantity
from controllers.errors import ModelError
from controllers.problem import load_model
from tests.helpers.models import make_model, make_problem


def rates(x, u):
    return -x[0] + u, -x[1] + x[0]


SAME = {
    "list": lambda x, u, d, p: [-x[0] + u, -x[1] + x[0]],
    "tuple": lambda x, u, d, p: (-x[0] + u, -x[1] + x[0]),
    "array": lambda x, u, d, p: np.array([-x[0] + u, -x[1] + x[0]]),
}


@pytest.mark.parametrize("kind", SAME)
def test_a_sequence_of_rates_is_a_column(kind):
    column = make_model(lambda x, u, d, p: ca.vertcat(-x[0] + u, -x[1] + x[0]))
    symbols = column.symbols()
    difference = make_model(SAME[kind]).ode(*symbols) - column.ode(*symbols)
    assert ca.Function("d", list(symbols), [difference])([1, 2], 3, [], 1).full().tolist() == [
        [0.0],
        [0.0],
    ]


def test_what_a_function_writes_into_its_arguments_stays_its_own():
    def ode(x, u, d, p):
        x[0] = ca.fmax(x[0], 0)
        return ca.vertcat(-x[0] + u, x[1])

    x, u, d, p = make_model(ode).symbols()
    make_model(ode).ode(x, u, d, p)
    assert x[0].is_symbolic()


ODES = {
    "short": (lambda x, u, d, p: x[0], "returned 1 expression in place of 2"),
    "long": (lambda x, u, d, p: [x[0], x[1], u], "returned 3 expressions in place of 2"),
    "row": (lambda x, u, d, p: ca.horzcat(x[0], x[1]), "1 rows and 2 columns"),
    "square": (lambda x, u, d, p: x @ x.T, "2 rows and 2 columns"),
    "number": (lambda x, u, d, p: 0.0, "in place of 2"),
    "nothing": (lambda x, u, d, p: None, "returned None"),
    "dictionary": (lambda x, u, d, p: {"x0": x[0]}, "returned dict"),
    "if": (lambda x, u, d, p: [u if x[0] > 0 else x[0], x[1]], "if_else"),
    "max": (lambda x, u, d, p: [max(x[0], 0), x[1]], "fmax"),
    "MX": (lambda x, u, d, p: [x[0] + ca.MX.sym("q"), x[1]], "MX"),
    "MX alone": (lambda x, u, d, p: ca.MX.sym("q", 2), "MX"),
    "free": (lambda x, u, d, p: [x[0] + ca.SX.sym("q"), x[1]], "depends on q"),
    "beyond": (lambda x, u, d, p: [x[0], x[2]], "entry that x, u, d or p does not have"),
    "no parameter": (lambda x, u, d, p: [x[0] * p[1], x[1]], "does not have"),
    "NaN": (lambda x, u, d, p: [x[0] * float("nan"), x[1]], "constant nan"),
    "infinity": (lambda x, u, d, p: [x[0], x[1] - np.inf], "constant -?inf"),
    "math": (lambda x, u, d, p: [math.sin(x[0]), x[1]], "math"),
    "two arguments": (lambda x, u: x, "four arguments"),
    "own error": (lambda x, u, d, p: {}["k"], "KeyError"),
    "no function": (3, "must be a function"),
}


@pytest.mark.parametrize("mistake", ODES)
def test_a_wrong_ode_is_one_line_when_the_model_is_made(mistake):
    ode, words = ODES[mistake]
    with pytest.raises(ModelError) as caught:
        make_model(ode)
    line = str(caught.value)
    assert "\n" not in line and "'small'" in line and "ode" in line
    assert re.search(words, line), line


COSTS = {
    "vector": (lambda x, u, d, p: x, "returned 2 expressions in place of one"),
    "NaN": (lambda x, u, d, p: x[0] + float("nan"), "constant nan"),
    "free": (lambda x, u, d, p: ca.SX.sym("price") * u, "price"),
}


@pytest.mark.parametrize("mistake", COSTS)
def test_a_wrong_cost_is_one_line_when_the_model_is_made(mistake):
    cost, words = COSTS[mistake]
    with pytest.raises(ModelError, match=words) as caught:
        make_model(SAME["list"], cost)
    assert "economic_cost" in str(caught.value)


X, U = Quantity("x", "1"), Quantity("u", "1")
GOOD = {
    "name": "quantities",
    "states": (X,),
    "actions": (U,),
    "disturbances": (),
    "parameters": (),
    "ode": lambda x, u, d, p: u - x,
    "economic_cost": lambda x, u, d, p: x**2 + u**2,
}
QUANTITIES = {
    "twice": ({"parameters": (Quantity("x", "1"),)}, "more than one quantity"),
    "one alone": ({"states": X}, "one alone is written"),
    "text": ({"states": ("x",)}, "must hold controllers.Quantity"),
    "no action": ({"actions": ()}, "has no actions"),
    "no name": ({"states": (Quantity("", "1"),)}, "no name"),
    "nominal": ({"parameters": (Quantity("k", "1", float("nan")),)}, "nominal value of k"),
    "unit of time": ({"time_unit": 0.0}, "time_unit"),
    "uncertain": ({"uncertain": ("k",)}, "no parameter 'k'"),
}


@pytest.mark.parametrize("mistake", QUANTITIES)
def test_wrong_quantities_are_one_line_when_the_model_is_made(mistake):
    changes, words = QUANTITIES[mistake]
    with pytest.raises(ModelError, match=words):
        Model(**(GOOD | changes))


REFERENCE = {
    "value": (lambda x, u, d, p: [u, ca.log(x[0])], None, "d/dt x1 is -inf"),
    "slope": (lambda x, u, d, p: [u, ca.sqrt(x[0])], None, "derivative of d/dt x1 by x0 is inf"),
    "norm": (lambda x, u, d, p: [u, ca.norm_2(x)], None, "derivative of d/dt x1 by x0"),
    "cost": (SAME["list"], lambda x, u, d, p: 1 / x[0], "the cost is inf"),
}


@pytest.mark.parametrize("mistake", REFERENCE)
def test_a_reference_without_finite_derivatives_is_refused(mistake):
    ode, cost, words = REFERENCE[mistake]
    model = make_model(ode, cost)
    with pytest.raises(ModelError, match=words):
        make_problem(model)


def test_a_model_that_a_scenario_names_is_named_by_module_and_function(tmp_path, monkeypatch):
    (tmp_path / "wrongly_made.py").write_text(
        "from controllers import Model, Quantity\n"
        "def short():\n"
        "    x, u = Quantity('x', '1'), Quantity('u', '1')\n"
        "    return Model('m', (x,), (u,), (), (), lambda x, u, d, p: [x, u], lambda *a: a[0])\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModelError, match=r"^wrongly_made:short: model 'm', ode\(x, u, d, p\)"):
        load_model("wrongly_made:short")
