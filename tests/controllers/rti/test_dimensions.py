"""One state, one action, one stage, no disturbance, no parameter: every shape has its place."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from controllers import ConvergedNmpc, Parameters, RtiNmpc, ThetaBlocks
from controllers.economic import tune
from controllers.export import core
from controllers.linear import Lqr, PiLoops
from learning.empirical_model import Features
from tests.helpers.compiled import CompiledController
from tests.helpers.compiler import needs_compiler
from tests.helpers.models import make_model, make_problem

BACKENDS = ("daqp", "proxqp", "qpsolvers:clarabel")
sizes = st.integers(1, 2)
more_or_none = st.integers(0, 1)


def random_problem(n, m, horizon, disturbances, parameters, seed=3):
    """A stable plant with a quadratic term, whose upper bounds are active at `state`."""
    rng = np.random.default_rng(seed)
    A, B = 0.3 * rng.normal(size=(n, n)) - np.eye(n), rng.normal(size=(n, m))

    def ode(x, u, d, p):
        rate = (ca.DM(A) @ x) * (p[0] if parameters else 1) + ca.DM(B) @ u + 0.1 * x**2
        return rate + ca.sum1(d) if disturbances else rate

    def cost(x, u, d, p):
        return ca.sumsqr(x - 0.1) + 0.3 * ca.sumsqr(u) + 0.01 * x[0] ** 3

    model = make_model(ode, cost, n=n, m=m, disturbances=disturbances, parameters=parameters)
    return make_problem(model, horizon=horizon, width=0.5)


def controllers_of(problem, parameters):
    for hessian in ("gauss-newton", "exact"):
        for backend in BACKENDS:
            yield hessian, RtiNmpc(problem, parameters, hessian=hessian, backend=backend)
    yield "iterated", RtiNmpc(problem, parameters, iterations=2)
    yield "converged", ConvergedNmpc(problem, parameters)


@pytest.mark.parametrize(("n", "m", "horizon", "n_d", "n_p"), [(1, 1, 1, 0, 0), (2, 1, 1, 0, 1)])
def test_every_hessian_and_backend_has_its_shapes_and_agrees(n, m, horizon, n_d, n_p):
    compare_all(n, m, horizon, n_d, n_p)


@pytest.mark.slow
@settings(max_examples=15)
@given(sizes, sizes, sizes, more_or_none, more_or_none)
def test_all_dimensions_have_their_shapes_and_agree(n, m, horizon, n_d, n_p):
    compare_all(n, m, horizon, n_d, n_p)


def compare_all(n, m, horizon, n_d, n_p):
    """Shapes of all read-outs of each Hessian and backend, and the same value by each backend."""
    problem = random_problem(n, m, horizon, n_d, n_p)
    names = ("p0",) if n_p else ()
    blocks = ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=names)
    parameters = Parameters.naive(problem, blocks)
    s, a = np.full(n, 0.45), np.full(m, 0.2)
    values = {}
    for kind, controller in controllers_of(problem, parameters):
        controller.prepare()
        solution, enforced = controller.feedback(s), controller.feedback(s, a)
        values.setdefault(kind, []).append((solution.value, enforced.value))
        assert solution.predicted_states.shape == solution.costates.shape == (horizon + 1, n)
        assert solution.predicted_actions.shape == (horizon, m)
        assert solution.slack.shape == (horizon, n)
        assert solution.qp.H.shape == (horizon * m, horizon * m)
        assert solution.value_gradient.shape == (blocks.size,)
        assert solution.policy_jacobian.shape == (m, blocks.size)
        assert solution.policy_state_jacobian.shape == (m, n)
        assert solution.residual < 1e-6 and enforced.action_gradient.shape == (m,)
        controller.reset()
        batch = controller.feedback_batch(np.stack([s, s]), derivatives=True)
        assert batch.action.shape == (2, m)
        assert batch.policy_jacobian.shape == (2, m, blocks.size)
        if kind in ("gauss-newton", "exact"):
            np.testing.assert_allclose(batch.value, solution.value, rtol=1e-9)
            np.testing.assert_allclose(
                batch.policy_state_jacobian[0], solution.policy_state_jacobian, atol=1e-9
            )
    for found in values.values():
        np.testing.assert_allclose(found, np.broadcast_to(found[0], (len(found), 2)), rtol=1e-8)


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_stage_is_the_minimum_over_one_action(backend):
    """SciPy minimises over the action, with Runge-Kutta steps written out here."""
    model = make_model(
        lambda x, u, d, p: ca.vertcat(-x[0] + u, -x[1] + x[0]),
        lambda x, u, d, p: ca.sumsqr(x) + u**2,
        parameters=0,
    )
    problem = make_problem(model, horizon=1)
    s = np.array([0.3, 0.3])
    A, B, h = np.array([[-1.0, 0.0], [1.0, -1.0]]), np.array([1.0, 0.0]), 0.25

    def following(action):
        x = s
        for _ in range(2):
            k1 = A @ x + B * action
            k2 = A @ (x + h / 2 * k1) + B * action
            k3 = A @ (x + h / 2 * k2) + B * action
            k4 = A @ (x + h * k3) + B * action
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    best = minimize_scalar(
        lambda action: s @ s + action**2 + 0.95 * following(action) @ following(action) + 1.0,
        bounds=(-1, 1),
        method="bounded",
        options={"xatol": 1e-12},
    )
    solution = RtiNmpc(problem, Parameters.naive(problem), backend=backend).feedback(s)
    assert solution.value == pytest.approx(best.fun, rel=1e-10)
    assert solution.action[0] == pytest.approx(best.x, abs=1e-6)


@needs_compiler
@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
def test_the_exported_c_of_one_of_everything_gives_the_same_value(hessian, tmp_path):
    problem = random_problem(1, 1, 1, 0, 0)
    parameters = Parameters.naive(problem)
    s = np.array([0.45])
    exported = CompiledController(tmp_path, core(problem, parameters, hessian)).sample(s)
    expected = RtiNmpc(problem, parameters, hessian=hessian).feedback(s)
    assert exported["status"][0] == 0
    assert exported["value"][0] == pytest.approx(expected.value, rel=1e-10)
    np.testing.assert_allclose(exported["action"], expected.action, atol=1e-9)


def test_tuning_and_linear_baselines_have_one_of_everything():
    problem = random_problem(1, 1, 1, 0, 0)
    tuning = tune(problem)
    assert tuning.gain_error < 1e-6
    for controller in (Lqr(problem), PiLoops(problem)):
        assert controller.feedback(np.array([0.1])).action.shape == (1,)


def test_the_features_of_a_model_without_parameters_and_disturbances_are_its_prediction():
    problem = random_problem(1, 1, 1, 0, 0)
    y, G, h = Features(problem)(np.array([[0.2, 0.1], [0.0, 0.0]]), np.zeros(0))
    assert y.shape == (2, 2) and G.shape == (2, 2, 0) and h.shape == (2, 2)
    rate = lambda x: problem.model.ode(x, 0.1, ca.DM(0, 1), ca.DM(0, 1))  # noqa: E731
    x = ca.DM(0.2)
    for _ in range(2000):
        x = x + 0.5 / 2000 * rate(x + 0.25 / 2000 * rate(x))
    assert y[0, 0] == pytest.approx(float(x), abs=1e-6)
