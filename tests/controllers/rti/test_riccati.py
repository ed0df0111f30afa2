"""The change of variables against the condensed QP that it stands for."""

import numpy as np
import pytest

from controllers import Parameters, QpError, RtiNmpc, ThetaBlocks
from controllers.qp.backends import DaqpBackend
from controllers.rti.preparation import LEAST_CONTROLS, limits_of, preparation, riccati
from tests.helpers.sampling import evaporator_problem, random_parameters, random_point, random_state

N, n, m = 7, 2, 2
LONG = LEAST_CONTROLS // m


@pytest.fixture(scope="module")
def functions():
    problem = evaporator_problem(horizon=N)
    prepared = preparation(problem, ThetaBlocks.of(problem))
    return prepared, riccati(problem, prepared)


def prepare(prepared, rng, L, L_N):
    """H and Γ of these stage costs at a random point."""
    problem = evaporator_problem(horizon=N)
    point = random_point(problem, rng)
    for name, value in {
        "x": point.x, "u": point.u, "L": L, "q": np.zeros((N, n + m)), "L_N": L_N,
        "q_N": np.zeros(n), "theta": Parameters.naive(problem).theta,
    }.items():  # fmt: skip
        prepared.inputs[name][:] = value.reshape(-1)
    prepared()
    return prepared.part("H"), prepared.part("Gamma")


@pytest.mark.parametrize("states", [0.0, -0.2])
def test_the_hessian_becomes_the_identity_and_the_rows_theirs(functions, rng, states):
    prepared, function = functions
    for _ in range(20):
        root = rng.normal(size=(N, n + m, n + m))
        L = root @ root.transpose(0, 2, 1) + 3 * np.eye(n + m)
        # The blocks of the states may be indefinite where H is not.
        L[:, :n, :n] = L[:, :n, :n] if states == 0.0 else states * np.eye(n)
        L[:, :n, n:] *= 0.1
        L[:, n:, :n] *= 0.1
        H, rows = prepare(prepared, rng, L, (1 + states) * np.eye(n))
        assert np.linalg.eigvalsh(H)[0] > 0.1
        T, moved = np.split(limits_of(function), [N * m])
        np.testing.assert_allclose(T.T @ H @ T, np.eye(N * m), atol=1e-11)
        np.testing.assert_allclose(moved, rows @ T, atol=1e-11)


@pytest.mark.parametrize("stage", [0, 3, N - 1])
@pytest.mark.parametrize("curvature", [-5.0, 0.0])
def test_a_hessian_that_is_not_definite_shows_in_the_first_row(functions, rng, stage, curvature):
    prepared, function = functions
    L = np.zeros((N, n + m, n + m))
    L[:, n:, n:] = np.eye(m)
    L[stage, -1, -1] = curvature
    H, _ = prepare(prepared, rng, L, np.zeros((n, n)))
    assert np.linalg.eigvalsh(H)[0] == curvature
    assert not np.isfinite(limits_of(function)[0]).all()


class Plain(DaqpBackend):
    """DAQP that is not told of the factor."""

    def load(self, qp):
        qp.factor = None
        super().load(qp)


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
def test_a_long_horizons_solutions_are_those_of_the_dense_factorisation(rng, hessian):
    problem = evaporator_problem(horizon=LONG)
    parameters = random_parameters(problem, ThetaBlocks.of(problem), rng)
    ours = RtiNmpc(problem, parameters, hessian=hessian)
    plain = RtiNmpc(problem, parameters, hessian=hessian, backend=Plain)
    for _ in range(5):
        point = random_point(problem, rng)
        s, a = random_state(problem, rng), rng.uniform(110, 390, size=m)
        found = []
        for controller in (ours, plain):
            controller.prepare_at(point)
            V, Q = controller.feedback(s), controller.feedback(s, a)
            found.append((*V.multipliers, *Q.multipliers, V.value_gradient, V.policy_jacobian))
        for one, other in zip(*found, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-7)
        assert V.residual < 1e-8


def test_a_long_horizon_that_is_not_convex_is_reported_and_the_next_one_solved(rng):
    problem = evaporator_problem(horizon=LONG)
    naive = Parameters.naive(problem)
    controller = RtiNmpc(problem, naive)
    s = problem.reference_state + 1.0
    expected = controller.feedback(s).action
    controller.reset()
    controller.parameters = naive.replace({"B_l": -np.eye(n + m)})
    with pytest.raises(QpError) as caught:
        controller.feedback(s)
    assert caught.value.qp is not None and caught.value.qp.factor is None
    controller.reset()
    controller.parameters = naive
    np.testing.assert_array_equal(controller.feedback(s).action, expected)
