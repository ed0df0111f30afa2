"""QPs: residuals, active sets, the KKT system, multipliers at a kink, and the solvers."""

from functools import lru_cache
from itertools import product

import numpy as np
import pytest

from controllers.errors import QpError
from controllers.qp import (
    ActiveSet,
    QpSolution,
    SoftQp,
    kkt_solve,
    make_backend,
    multipliers_at_kink,
    polish,
)
from tests.helpers.stored import prepared, qps, solve


def scalar_qp(f: float, *, w: float = 1.0, W: float = 1.0, limit: float = 1.0) -> SoftQp:
    """min ½v² + fv + wt + Wt², |v| ≤ 10, v ≤ limit + t."""
    return SoftQp(
        H=np.eye(1),
        f=np.array([f]),
        lower=np.array([-10.0]),
        upper=np.array([10.0]),
        rows=np.ones((1, 1)),
        row_lower=np.array([-100.0]),
        row_upper=np.array([limit]),
        w=np.array([w]),
        W=np.array([W]),
    )


def solution(v: float, nu: float, lam: float) -> QpSolution:
    return QpSolution(np.array([v]), np.array([nu]), np.array([lam]))


# (f, w, W) → (v, ν, λ), by hand from v + f + ν + λ = 0 and λ = w + 2W(v − 1) where violated.
CASES = {
    "free": ((-0.5, 1.0, 1.0), (0.5, 0.0, 0.0)),
    "at the limit": ((-1.5, 1.0, 1.0), (1.0, 0.0, 0.5)),
    "violated": ((-3.0, 1.0, 1.0), (4 / 3, 0.0, 5 / 3)),
    "violated, small weight": ((-3.1, 1.0, 0.1), (23 / 12, 0.0, 71 / 60)),
    "saturated": ((-50.0, 1.0, 1.0), (10.0, 21.0, 19.0)),
    "saturated below": ((50.0, 1.0, 1.0), (-10.0, -40.0, 0.0)),
}


def enforced(f, v):
    qp = scalar_qp(f)
    qp.lower[:] = qp.upper[:] = v
    return qp


def rows_qp(rows):
    rows = np.array(rows, dtype=float)
    count, size = rows.shape
    return SoftQp(
        H=np.eye(size),
        f=np.zeros(size),
        lower=np.full(size, -10.0),
        upper=np.full(size, 10.0),
        rows=rows,
        row_lower=np.full(count, -100.0),
        row_upper=np.zeros(count),
        w=np.ones(count),
        W=np.ones(count),
    )


# residuals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_residuals_vanish_at_the_solution_and_any_change_of_it_shows(case):
    (f, w, W), expected = CASES[case]
    qp, answer = scalar_qp(f, w=w, W=W), solution(*expected)
    assert answer.residual(qp) < 1e-14
    for name, step in product(answer._fields, (-1e-3, 1e-3)):
        changed = answer._replace(**{name: getattr(answer, name) + step})
        assert changed.residual(qp) > 1e-5


# activity -------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_active_names_the_branch(case):
    (f, w, W), expected = CASES[case]
    held, at_limit, violated = solution(*expected).active(scalar_qp(f, w=w, W=W))
    assert held[0] == case.startswith("saturated")
    assert at_limit[0] == (case == "at the limit")
    assert violated[0] == (case.startswith("violated") or case == "saturated")


@pytest.mark.parametrize(
    ("qp", "answer"),
    [
        (scalar_qp(-1.0), (1.0, 0.0, 0.0)),  # reaches the limit with λ = 0
        (scalar_qp(-2.0), (1.0, 0.0, 1.0)),  # about to leave the limit: λ = w
        (scalar_qp(-10.0, limit=50.0), (10.0, 0.0, 0.0)),  # reaches the bound with ν = 0
        (enforced(-1.5, 1.0), (1.0, 0.0, 0.5)),  # at the limit, and nothing moves it
    ],
)
def test_weak_activity_is_flagged(qp, answer):
    assert solution(*answer).residual(qp) == 0.0
    assert solution(*answer).weakly_active(qp)


# licq -----------------------------------------------------------------------------------------


def licq(rows, active):
    lam = np.where(active, 0.5, 0.0)
    size = len(rows[0])
    return QpSolution(np.zeros(size), np.zeros(size), lam).licq_margin(rows_qp(rows))


def test_the_margin_is_the_sine_of_half_the_angle_between_two_rows():
    angle = 0.3
    margin = licq([[1, 0], [np.cos(angle), np.sin(angle)]], [True, True])
    assert margin == pytest.approx(np.sqrt(2) * np.sin(angle / 2))


@pytest.mark.parametrize("rows", [[[1, 1], [2, 2]], [[0, 0], [1, 0]], [[1, 0], [0, 1], [1, 1]]])
def test_dependent_rows_have_no_margin(rows):
    assert licq(rows, [True] * len(rows)) == pytest.approx(0.0, abs=1e-15)


def test_polishing_mends_inaccurate_solutions_of_real_qps(rng):
    for answer in solve("daqp", range(0, 480, 17)):
        exact = answer.multipliers
        rough = QpSolution(*(part * (1 + 1e-7 * rng.normal(size=part.size)) for part in exact))
        assert polish(answer.qp, rough).residual(answer.qp) < 1e-9


def test_a_solution_on_the_wrong_active_set_is_left_alone():
    qp = scalar_qp(-3.0)
    wrong = solution(0.9, 0.0, 0.0)
    assert polish(qp, wrong).residual(qp) <= wrong.residual(qp)


def test_rows_of_the_inverse_solve_the_kkt_system(rng):
    for answer in solve("daqp", range(0, 480, 17)):
        qp, active = answer.qp, answer.multipliers.active(answer.qp)
        at_bound, at_limit, violated = active
        seeds = rng.normal(size=(2, qp.f.size))
        v, lam = kkt_solve(qp, active, seeds, np.zeros((2, qp.w.size)))
        W = np.where(violated, 2 * qp.W, 0)
        left = v @ qp.H + (v @ qp.rows.T * W) @ qp.rows + lam @ qp.rows
        np.testing.assert_allclose(left[:, ~at_bound], seeds[:, ~at_bound], atol=1e-8)
        assert not v[:, at_bound].any()
        assert not lam[:, ~at_limit].any()


def test_dependent_rows_get_the_least_multipliers():
    qp = scalar_qp(-1.5)
    qp.rows, qp.w, qp.W = np.ones((2, 1)), np.ones(2), np.ones(2)
    active = ActiveSet(np.array([False]), np.array([True, True]), np.array([False, False]))
    v, lam = kkt_solve(qp, active, np.array([[1.5]]), np.array([[1.0, 1.0]]))
    np.testing.assert_allclose(v, [[1.0]], atol=1e-12)
    np.testing.assert_allclose(lam, [[0.25, 0.25]], atol=1e-12)


FREE = np.array([-10.0]), np.array([10.0])


def test_away_from_the_kink_nothing_changes():
    qp = enforced(-3.0, 2.0)
    before = solution(2.0, -2.0, 3.0)
    assert multipliers_at_kink(qp, before, *FREE) is before


@pytest.mark.parametrize("lam", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(
    ("f", "expected"),
    [
        (-1.5, (1.0, 0.0, 0.5)),  # the policy is v = 1 itself: the multipliers are the value's
        (-3.0, (1.0, 1.0, 1.0)),  # the policy lies above: one more unit of a gains 1
        (0.5, (1.0, -1.5, 0.0)),  # the policy lies below
    ],
)
def test_of_all_multipliers_at_the_kink_those_nearest_to_the_policys_are_taken(f, expected, lam):
    settled = multipliers_at_kink(enforced(f, 1.0), solution(1.0, -f - 1.0 - lam, lam), *FREE)
    np.testing.assert_allclose(np.ravel(settled), expected, atol=1e-15)


def test_the_action_gradient_lies_between_the_one_sided_derivatives():
    checked = 0
    for nmpc, qp in prepared("daqp", range(0, 480, 8)):
        policy = nmpc.feedback(qp.s)
        at = nmpc.feedback(qp.s, policy.action)
        if at.licq:
            continue
        checked += 1
        for i in range(2):
            step = np.zeros(2)
            step[i] = 1e-5
            ahead = (nmpc.action_value(qp.s, policy.action + step) - at.value) / 1e-5
            behind = (at.value - nmpc.action_value(qp.s, policy.action - step)) / 1e-5
            slack = 1e-3 * max(1.0, abs(ahead), abs(behind))
            assert behind - slack <= at.action_gradient[i] <= ahead + slack
    assert checked > 5


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
    qp, solver = enforced(-3.0, 2.0), make_backend(backend)
    solver.load(qp)
    # v + f + ν + λ = 0 with λ = 1 + 2·1
    np.testing.assert_allclose(np.ravel(solver.solve(qp)), [2.0, -2.0, 3.0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("every", [11, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("backend", QPSOLVERS)
def test_qpsolvers_agrees_on_the_stored_set(backend, every):
    assert_agreement(backend, range(0, len(qps()), every))


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
@pytest.mark.parametrize(("part", "value"), [("lower", 20.0), ("H", -1.0)])
def test_a_qp_without_a_solution_raises_and_is_carried(backend, part, value):
    qp, solver = scalar_qp(-1.0), make_backend(backend)
    getattr(qp, part)[:] = value
    with pytest.raises(QpError) as caught:
        solver.load(qp)
        solver.solve(qp)
    assert (caught.value.status == "not convex") == (part == "H")
    assert caught.value.status and caught.value.is_solver_failure
    assert caught.value.qp is not qp
    np.testing.assert_array_equal(getattr(caught.value.qp, part), getattr(qp, part))


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
