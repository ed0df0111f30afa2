import numpy as np
import pytest

from benchmarks.ipopt import IpoptNmpc
from controllers import ThetaBlocks
from controllers.converged import merit
from controllers.model import discretise
from tests.helpers.sampling import evaporator_problem, random_parameters, random_point, random_state


@pytest.fixture(scope="module")
def blocks():
    return ThetaBlocks.of(evaporator_problem(), slack_weights=True)


@pytest.fixture(scope="module")
def function(blocks):
    return merit(evaporator_problem(), blocks)


@pytest.fixture
def case(problem, blocks, rng):
    point = random_point(problem, rng)
    return random_parameters(problem, blocks, rng), random_state(problem, rng), point.x, point.u


def measured(function, theta, s, x, u):
    for name, value in {"s": s, "x": x, "u": u, "theta": theta.theta}.items():
        function.inputs[name][:] = np.ravel(value)
    function()
    cost, penalty, infeasibility = function.stack[-3:]
    return cost, penalty, infeasibility, function.part("gradient").copy()


def test_cost_penalty_and_defects_are_the_papers(function, case, problem):
    theta, s, x, u = case
    cost, penalty, infeasibility, _ = measured(function, theta, s, x, u)
    states, v = np.vstack([s, x]), u - problem.reference_action
    xi = states - problem.reference_state
    expected = problem.penalty(s) + theta["c_lambda"]
    expected += xi[0] @ theta["B_lambda"] @ xi[0] + theta["b_lambda"] @ xi[0]
    slack = np.maximum(np.maximum(theta["x_l"] - x, x - theta["x_u"]), 0)
    f = discretise(problem.model, problem.sampling_time, problem.substeps)
    charged = defects = 0.0
    for k in range(problem.horizon):
        w = np.concatenate([xi[k], v[k]])
        expected += 0.99**k * (w @ theta["B_l"] @ w + theta["b_l"] @ w)
        charge = theta["w_sigma"] @ slack[k] + theta["W_sigma"] @ slack[k] ** 2
        charged += 0.99 ** (k + 1) * charge
        x_next = f(
            states[k], u[k], problem.model.nominal_disturbance, problem.model.nominal_parameters
        )
        defects += np.abs(np.array(x_next).ravel() + theta["c_f"] - states[k + 1]).sum()
    end = xi[-1]
    expected += 0.99**problem.horizon * (end @ theta["B_Vf"] @ end + theta["b_Vf"] @ end)
    assert cost == pytest.approx(expected, rel=1e-12)
    assert penalty == pytest.approx(charged, rel=1e-12)
    assert infeasibility == pytest.approx(defects, rel=1e-12)


def test_the_gradient_is_that_of_the_cost(function, case):
    theta, s, x, u = case
    gradient = measured(function, theta, s, x, u)[3]
    z, count = np.concatenate([x.ravel(), u.ravel()]), x.size
    for i in range(z.size):
        ends = []
        for h in (0.1, -0.1):  # the cost is quadratic: a central difference is exact
            moved = z.copy()
            moved[i] += h
            ends.append(measured(function, theta, s, moved[:count], moved[count:])[0])
        assert gradient[i] == pytest.approx((ends[0] - ends[1]) / 0.2, rel=1e-6, abs=1e-6)


def test_ipopts_value_is_the_merit_of_its_own_trajectory(function, blocks, problem, case):
    theta, s, _, _ = case
    answer = IpoptNmpc(problem, blocks).solve(theta, s)
    cost, penalty, infeasibility, _ = measured(
        function, theta, s, answer.states[1:], answer.controls
    )
    assert answer.success
    assert infeasibility < 1e-8
    assert cost + penalty == pytest.approx(answer.value, rel=1e-8)
    np.testing.assert_array_equal(answer.action, answer.controls[0])
