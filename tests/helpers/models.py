"""Small models for tests: a problem from functions of (x, u, d, p), and tables that they call."""

import casadi as ca
import numpy as np

from controllers import Model, Problem, Quantity

GRID = np.linspace(-3, 3, 13)
LINEAR = ca.interpolant("linear", "linear", [GRID], np.sin(GRID))
BSPLINE = ca.interpolant("bspline", "bspline", [GRID], np.sin(GRID))
PLANE = np.sin(GRID[:, None] + 0.5 * GRID[None]).ravel("F")
LINEAR_2D = ca.interpolant("linear_2d", "linear", [GRID, GRID], PLANE)
BSPLINE_2D = ca.interpolant("bspline_2d", "bspline", [GRID, GRID], PLANE)


def _mapped():
    x = ca.MX.sym("x")
    return ca.Function("sine", [x], [ca.sin(x)]).map(2)


def _switch():
    x = ca.MX.sym("x")
    return ca.Function("switch", [x], [ca.if_else(x > 0, LINEAR(x), BSPLINE(x), True)])


MAPPED, SWITCH = _mapped(), _switch()


def root_finder():
    """z with z³ + z = q, by CasADi's Newton method, which cannot be C."""
    z, q = ca.SX.sym("z"), ca.SX.sym("q")
    return ca.rootfinder("root", "newton", {"x": z, "p": q, "g": z**3 + z - q})


CALLS = {
    "linear table": lambda x: LINEAR(x[0]),
    "spline table": lambda x: BSPLINE(x[0]),
    "linear table of two": LINEAR_2D,
    "spline table of two": BSPLINE_2D,
    "two tables": lambda x: LINEAR(x[0]) * BSPLINE(x[1]),
    "map": lambda x: ca.sum2(MAPPED(x.T)),
    "switch": lambda x: SWITCH(x[0]),
    "if_else": lambda x: ca.if_else(x[0] > 0.1, x[0] ** 2, ca.sin(x[0])),
    "large graph": lambda x: sum(ca.sin(x[0] * k) * ca.exp(-(x[1] ** 2)) for k in range(40)) / 40,
}
"""What a model's rate may hold, by what makes CasADi's C need work arrays."""


def make_model(ode, cost=None, *, n=2, m=1, disturbances=0, parameters=1, **more):
    """Model with states x0…, actions u0…, disturbances d0… (nominal 0), parameters p0… (1)."""

    def quantities(letter, count, nominal=0.0):
        return tuple(Quantity(f"{letter}{i}", "1", nominal) for i in range(count))

    return Model(
        name="small",
        states=quantities("x", n),
        actions=quantities("u", m),
        disturbances=quantities("d", disturbances),
        parameters=quantities("p", parameters, 1.0),
        ode=ode,
        economic_cost=cost or (lambda x, u, d, p: ca.sumsqr(x) + 0.1 * ca.sumsqr(u) + x[0]),
        **more,
    )


def make_problem(model, *, sampling_time=0.5, horizon=6, substeps=2, width=1.0, **more):
    """A problem about the origin, states and actions between ∓1."""
    n, m = len(model.states), len(model.actions)
    given = {
        "model": model,
        "sampling_time": sampling_time,
        "horizon": horizon,
        "discount": 0.95,
        "state_lower": np.full(n, -width),
        "state_upper": np.full(n, width),
        "action_lower": -np.ones(m),
        "action_upper": np.ones(m),
        "penalty_linear": np.full(n, 10.0),
        "penalty_quadratic": np.full(n, 100.0),
        "reference_state": np.zeros(n),
        "reference_action": np.zeros(m),
        "reference_cost": 1.0,
        "substeps": substeps,
    }
    return Problem(**(given | more))


def calling(call, **more):
    """A problem of two states whose second rate holds a call."""
    ode = lambda x, u, d, p: ca.vertcat(-x[0] + u, -p[0] * x[1] + call(x))  # noqa: E731
    return make_problem(make_model(ode), **more)
