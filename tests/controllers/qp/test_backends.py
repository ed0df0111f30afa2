"""All backends against closed-form solutions, and against each other on QPs of real runs."""

from functools import lru_cache

import numpy as np
import pytest

from controllers.errors import QpError
from controllers.qp import make_backend
from tests.helpers.scalar import CASES, scalar_qp
from tests.helpers.stored import qps, solve

QPSOLVERS = ["proxqp", *(f"qpsolvers:{name}" for name in ("clarabel", "daqp", "quadprog"))]
EVERY = ["daqp", *QPSOLVERS]


def read_out(answer):
    """z = (x, u, slack) and all multipliers of one solution."""
    return {
        "states": answer.predicted_states,
        "controls": answer.predicted_actions,
        "slack": answer.slack,
        "multipliers of bounds": answer.multipliers.nu,
        "multipliers of rows": answer.multipliers.lam,
        "costates": answer.costates,
    }


@lru_cache(maxsize=1)
def reference():
    return [read_out(answer) for answer in solve("daqp")]


def assert_agreement(backend, picked):
    """To 1e-6 relative to max(1, |·|): multipliers reach 1e5, the slack's linear weight."""
    for k, answer in zip(picked, solve(backend, picked), strict=True):
        assert answer.residual < 2e-9
        for name, value in read_out(answer).items():
            expected = reference()[k][name]
            error = np.abs(value - expected) / np.maximum(1, np.abs(expected))
            assert error.max() <= 1e-6, f"QP {k}: {name} of {backend} differ by {error.max():.1e}"


@pytest.mark.parametrize("backend", EVERY)
@pytest.mark.parametrize("case", CASES)
def test_a_closed_form_solution_is_found(backend, case):
    (f, w, W), expected = CASES[case]
    qp = scalar_qp(f, w=w, W=W)
    solver = make_backend(backend)
    solver.load(qp)
    np.testing.assert_allclose(np.ravel(solver.solve(qp)), expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("backend", EVERY)
def test_a_fixed_variable_stays_and_has_its_multiplier(backend):
    qp = scalar_qp(-3.0)
    qp.lower[:] = qp.upper[:] = 2.0
    solver = make_backend(backend)
    solver.load(qp)
    # v + f + ν + λ = 0 with λ = 1 + 2·1
    np.testing.assert_allclose(np.ravel(solver.solve(qp)), [2.0, -2.0, 3.0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("backend", QPSOLVERS)
def test_qpsolvers_agrees_on_a_part_of_the_stored_set(backend):
    assert_agreement(backend, range(0, len(qps()), 11))


@pytest.mark.slow
@pytest.mark.parametrize("backend", QPSOLVERS)
def test_qpsolvers_agrees_on_the_whole_stored_set(backend):
    assert_agreement(backend, range(len(qps())))


def test_daqp_gives_the_same_bits_whatever_it_solved_before():
    picked = range(0, len(qps()), 5)
    first = dict(zip(picked, solve("daqp", picked), strict=True))
    shuffled = list(reversed(first))
    for k, again in zip(shuffled, solve("daqp", shuffled), strict=True):
        for before, after in zip(first[k].multipliers, again.multipliers, strict=True):
            assert before.tobytes() == after.tobytes()


# failures -------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("backend", EVERY)
def test_an_infeasible_qp_raises_and_is_carried(backend):
    qp = scalar_qp(-1.0)
    qp.lower[:], qp.upper[:] = 2.0, 1.0
    solver = make_backend(backend)
    with pytest.raises(QpError) as caught:
        solver.load(qp)
        solver.solve(qp)
    assert caught.value.status
    assert caught.value.is_solver_failure
    assert caught.value.qp is not qp
    np.testing.assert_array_equal(caught.value.qp.lower, qp.lower)


@pytest.mark.parametrize("backend", EVERY)
def test_a_qp_that_is_not_convex_raises_and_is_carried(backend):
    qp = scalar_qp(-1.0)
    qp.H[:] = -1.0
    solver = make_backend(backend)
    with pytest.raises(QpError) as caught:
        solver.load(qp)
        solver.solve(qp)
    assert caught.value.status == "not convex"
    np.testing.assert_array_equal(caught.value.qp.H, qp.H)


@pytest.mark.parametrize("backend", ["daqp", "proxqp"])
def test_a_backend_recovers_from_a_failure(backend):
    solver = make_backend(backend)
    bad, good = scalar_qp(-1.5), scalar_qp(-1.5)
    bad.lower[:], bad.upper[:] = 2.0, 1.0
    for qp in (good, bad):
        try:
            solver.load(qp)
            solver.solve(qp)
        except QpError:
            assert qp is bad
    solver.load(good)
    _, expected = CASES["at the limit"]
    np.testing.assert_allclose(np.ravel(solver.solve(good)), expected, rtol=0, atol=1e-8)
