import numpy as np

from controllers.qp import QpSolution, kkt_solve, polish
from tests.helpers.scalar import scalar_qp, solution
from tests.helpers.stored import solve


def test_polishing_mends_inaccurate_solutions_of_real_qps(rng):
    for answer in solve("daqp", range(0, 480, 17)):
        exact = answer.multipliers
        rough = QpSolution(*(part * (1 + 1e-7 * rng.normal(size=part.size)) for part in exact))
        assert polish(answer.qp, rough).residuals(answer.qp).largest < 1e-9


def test_a_solution_on_the_wrong_active_set_is_left_alone():
    qp = scalar_qp(-3.0)
    wrong = solution(0.9, 0.0, 0.0)
    assert polish(qp, wrong).residuals(qp).largest <= wrong.residuals(qp).largest


def test_rows_of_the_inverse_solve_the_kkt_system(rng):
    for answer in solve("daqp", range(0, 480, 17)):
        qp, active = answer.qp, answer.multipliers.active(answer.qp)
        held, at_limit, violated = active
        seeds = rng.normal(size=(2, qp.f.size))
        v, lam = kkt_solve(qp, active, seeds, np.zeros((2, qp.w.size)))
        W = np.where(violated, 2 * qp.W, 0)
        left = v @ qp.H + (v @ qp.rows.T * W) @ qp.rows + lam @ qp.rows
        np.testing.assert_allclose(left[:, ~held], seeds[:, ~held], atol=1e-8)
        assert not v[:, held].any()
        assert not lam[:, ~at_limit].any()


def test_dependent_rows_get_the_least_multipliers():
    qp = scalar_qp(-1.5)
    qp.rows, qp.w, qp.W = np.ones((2, 1)), np.ones(2), np.ones(2)
    active = (np.array([False]), np.array([True, True]), np.array([False, False]))
    v, lam = kkt_solve(qp, active, np.array([[1.5]]), np.array([[1.0, 1.0]]))
    np.testing.assert_allclose(v, [[1.0]], atol=1e-12)
    np.testing.assert_allclose(lam, [[0.25, 0.25]], atol=1e-12)
