import numpy as np
import pytest

from controllers.qp import QpSolution, SoftQp
from tests.helpers.scalar import CASES, scalar_qp, solution
from tests.helpers.stored import qps, solve


@pytest.fixture(scope="module")
def solved():
    """Every ninth stored QP with its solution."""
    return list(solve("daqp", range(0, len(qps()), 9)))


def moved(answer, name, index, step):
    parts = {part: value.copy() for part, value in answer._asdict().items()}
    parts[name][index] += step
    return QpSolution(**parts)


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


# objective and slack --------------------------------------------------------------------------


# residuals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_residuals_vanish_at_the_solution(case):
    (f, w, W), expected = CASES[case]
    residuals = solution(*expected).residuals(scalar_qp(f, w=w, W=W))
    assert max(residuals) < 1e-14


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["v", "nu", "lam"])
@pytest.mark.parametrize("step", [-1e-3, 1e-3])
def test_any_change_of_the_solution_shows(case, name, step):
    (f, w, W), expected = CASES[case]
    changed = moved(solution(*expected), name, 0, step)
    assert changed.residuals(scalar_qp(f, w=w, W=W)).largest > 1e-5


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
    ],
)
def test_weak_activity_is_flagged(qp, answer):
    assert solution(*answer).residuals(qp).largest == 0.0
    assert solution(*answer).weakly_active(qp)


def test_a_row_at_its_limit_that_nothing_moves_is_flagged():
    qp = scalar_qp(-1.5)
    qp.lower[:] = qp.upper[:] = 1.0
    assert solution(1.0, 0.0, 0.5).weakly_active(qp)


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


def test_the_stored_set_holds_what_it_is_for():
    answers = list(solve("daqp"))
    assert len(answers) == len(qps()) >= 300
    assert sum(answer.enforced for answer in answers) >= 150
    assert sum(bool((answer.slack > 1e-6).any()) for answer in answers) >= 80
    free = [answer.multipliers.nu[2 if answer.enforced else 0 :] for answer in answers]
    assert sum(bool((np.abs(nu) > 1e-6).any()) for nu in free) >= 80
    assert max(float(np.abs(answer.multipliers.lam).max()) for answer in answers) > 9e4
    assert {qp.hessian for qp in qps()} == {"gauss-newton", "exact"}
