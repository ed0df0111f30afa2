"""Linearisation, condensing and embedding against plain stage-wise arithmetic."""

import casadi as ca
import numpy as np
import pytest

from controllers import ThetaBlocks
from controllers.model import discretise
from controllers.preparation import embedding, preparation, sampled_jacobian
from controllers.readout import readout
from tests.helpers.sampling import evaporator_problem, random_parameters, random_point, random_state

N, n, m = 10, 2, 2


@pytest.fixture(scope="module")
def blocks():
    return ThetaBlocks.from_problem(
        evaporator_problem(), slack_weights=True, model_parameters=("UA2", "h")
    )


@pytest.fixture(scope="module")
def functions(blocks):
    prepared = preparation(evaporator_problem(), blocks)
    read = readout(evaporator_problem(), blocks, prepared)
    return prepared, embedding(evaporator_problem(), blocks, prepared, read)


@pytest.fixture
def case(functions, blocks, problem, rng):
    """Prepared with random stage costs at a random point; returns all that went in."""
    prepared, _ = functions
    root = rng.normal(size=(N, n + m, n + m))
    L = root @ root.transpose(0, 2, 1) + np.eye(n + m)
    q = rng.normal(size=(N, n + m)) * 10
    L_N, q_N = np.eye(n) * 3 + 0.5, rng.normal(size=n) * 10
    parameters, point = random_parameters(problem, blocks, rng), random_point(problem, rng)
    for name, value in {
        "x": point.x, "u": point.u, "L": L, "q": q, "L_N": L_N, "q_N": q_N,
        "theta": parameters.theta,
    }.items():  # fmt: skip
        prepared.inputs[name][:] = value.reshape(-1)
    prepared()
    return parameters, point, L, q, L_N, q_N


def simulate(prepared, xi_0, v):
    """ξ_1 … ξ_N of the linearised model, stage by stage."""
    A, B = prepared.part("A").reshape(N, n, n), prepared.part("B").reshape(N, n, m)
    xi = [xi_0]
    for k in range(N):
        xi.append(A[k] @ xi[k] + B[k] @ v[k] + prepared.matrix("r")[k])
    return np.array(xi)


def stage_wise_cost(case, xi, v):
    _, _, L, q, L_N, q_N = case
    w = np.concatenate([xi[:-1], v], axis=1)
    cost = (0.5 * np.einsum("ki,kij,kj->k", w, L, w) + (q * w).sum(axis=1)).sum()
    return cost + 0.5 * xi[-1] @ L_N @ xi[-1] + q_N @ xi[-1]


def test_the_variational_steps_give_the_jacobian_of_the_discrete_map(problem, rng):
    model = problem.model
    x, u, d, p = model.symbols()
    f = discretise(model, problem.sampling_time, problem.substeps)
    exact = ca.Function("exact", [x, u, d, p], [ca.jacobian(f(x, u, d, p), ca.vertcat(x, u))])
    nominal = ca.SX(ca.DM(model.nominal_parameters))
    ours = ca.Function("ours", [x, u], list(sampled_jacobian(problem, x, u, nominal)))
    for _ in range(20):
        point = random_point(problem, rng)
        arguments = (point.x[0], point.u[0], model.nominal_disturbance, model.nominal_parameters)
        value, jacobian = ours(point.x[0], point.u[0])
        np.testing.assert_allclose(np.array(value), np.array(f(*arguments)), rtol=1e-14)
        np.testing.assert_allclose(np.array(jacobian), np.array(exact(*arguments)), atol=1e-13)


def test_the_linear_model_touches_the_nonlinear_one_at_its_point(functions, case, problem):
    prepared, _ = functions
    parameters, point = case[:2]
    p = problem.model.nominal_parameters
    p[problem.model.parameter_indices(("UA2", "h"))] = parameters["p"]
    f = discretise(problem.model, problem.sampling_time, problem.substeps)
    A, B = prepared.part("A").reshape(N, n, n), prepared.part("B").reshape(N, n, m)
    for k in range(N):
        scale = problem.scale
        xi = (point.x[k] - problem.reference_state) / scale.state
        v = (point.u[k] - problem.reference_action) / scale.action
        linear = (A[k] @ xi + B[k] @ v + prepared.matrix("r")[k]) * scale.state
        linear += problem.reference_state
        exact = f(point.x[k], point.u[k], problem.model.nominal_disturbance, p)
        np.testing.assert_allclose(linear, np.array(exact).ravel() + parameters["c_f"], rtol=1e-13)


def test_condensed_states_equal_a_stage_wise_simulation(functions, case, rng):
    prepared, _ = functions
    xi_0, v = rng.normal(size=n), rng.normal(size=(N, m)) * 20
    condensed = (
        prepared.matrix("Gamma") @ v.ravel() + prepared.matrix("Phi") @ xi_0 + prepared.part("g")
    )
    np.testing.assert_allclose(
        condensed.reshape(N, n), simulate(prepared, xi_0, v)[1:], rtol=0, atol=1e-11
    )


def test_condensed_cost_differs_from_the_stage_wise_one_by_a_constant(functions, case, rng):
    prepared, _ = functions
    xi_0, H = rng.normal(size=n), prepared.matrix("H")
    f = prepared.part("f") + prepared.matrix("F") @ xi_0
    offsets = []
    for _ in range(20):
        v = rng.normal(size=(N, m)) * 20
        total = stage_wise_cost(case, simulate(prepared, xi_0, v), v)
        offsets.append(total - 0.5 * v.ravel() @ H @ v.ravel() - f @ v.ravel())
    np.testing.assert_allclose(offsets, offsets[0], rtol=0, atol=1e-9 * abs(total))


def test_embedding_puts_the_state_into_gradient_and_limits(functions, case, problem, rng):
    prepared, embed = functions
    parameters, s = case[0], random_state(problem, rng)
    embed.inputs["s"][:], embed.inputs["theta"][:] = s, parameters.theta
    embed()
    xi_0, v = (s - problem.reference_state) / problem.scale.state, rng.normal(size=(N, m))
    np.testing.assert_allclose(
        embed.part("f"), prepared.part("f") + prepared.matrix("F") @ xi_0, rtol=1e-12, atol=1e-9
    )
    # The rows' distances to their limits are the states' distances to their bounds.
    y = prepared.matrix("Gamma") @ v.ravel()
    x = simulate(prepared, xi_0, v)[1:] * problem.scale.state + problem.reference_state
    for side, bound in (("lower", "x_l"), ("upper", "x_u")):
        np.testing.assert_allclose(
            (y - embed.part(side)).reshape(N, n) * problem.scale.state,
            x - parameters[bound],
            rtol=0,
            atol=1e-10,
        )
