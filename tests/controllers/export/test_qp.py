"""The C solver on random and degenerate QPs: by its residual, and against DAQP and ProxQP."""

from collections import Counter

import numpy as np
import pytest

from controllers.errors import QpError
from controllers.qp import SoftQp, make_backend, polish
from tests.helpers.compiled import FAMILIES, CompiledQpSolver, random_qps

RESIDUAL = 1e-9
# A peer whose residual is above this is no reference: with multipliers of 1e4 a residual of 4e-10
# was seen to go with an error of 2e-4, and the higher objective.
REFERENCE = 1e-12
AGREEMENT = 1e-6
NOT_CONVEX, NOT_FINITE = 1, 3
PEERS = ("daqp", "proxqp")


@pytest.fixture(scope="module")
def solver(tmp_path_factory: pytest.TempPathFactory) -> CompiledQpSolver:
    return CompiledQpSolver(tmp_path_factory.mktemp("qp"), 20, 20)


def _guesses(last: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Working sets to begin with, most of them wrong: of the QP before, and at random."""
    wild = rng.choice([-2.0, -1.0, 0.0, 1.0, 2.0], size=last.size)
    wild[:20] = np.sign(wild[:20])  # a bound is never beyond its limit
    return {"none": np.zeros(last.size), "last": last.copy(), "wild": wild}


def _check(solver: CompiledQpSolver, count: int, peers: tuple[str, ...], seed: int) -> Counter:
    """Solve `count` QPs; the residual is that of `QpSolution`, written independently."""
    solved: Counter = Counter()
    rng, last = np.random.default_rng(seed), np.zeros(40)
    for k, (family, qp) in enumerate(random_qps(count, seed)):
        found = {}
        for name, guess in _guesses(last, rng).items():
            status, solution, own, _ = solver.solve(qp, guess)
            assert status == 0, (k, family, name)
            residual = solution.residual(qp)
            assert residual < RESIDUAL, (k, family, name)
            assert own == pytest.approx(residual, abs=RESIDUAL / 10)
            found[name], last = solution, guess
        solution = found["none"]
        for name, other in found.items():
            difference = np.abs(solution.v - other.v) / (1 + np.abs(solution.v))
            assert difference.max() < RESIDUAL, (k, family, name)
        for peer in peers:
            try:
                backend = make_backend(peer)
                backend.load(qp)
                with np.errstate(invalid="ignore"):  # of rows without a limit
                    other = polish(qp, backend.solve(qp), 1e-13)
            except QpError:
                continue
            if not other.residual(qp) < REFERENCE:
                continue
            solved[peer, family] += 1
            difference = np.abs(solution.v - other.v) / (1 + np.abs(other.v))
            assert difference.max() < AGREEMENT, (k, family, peer)
    return solved


@pytest.mark.slow
def test_the_optimality_conditions_hold_on_every_family(solver: CompiledQpSolver) -> None:
    _check(solver, 1000, (), seed=1)


def test_daqp_and_proxqp_find_the_same_solution(solver: CompiledQpSolver) -> None:
    solved = _check(solver, 100, PEERS, seed=2)
    for family in FAMILIES:
        assert solved["daqp", family] + solved["proxqp", family] > 0


@pytest.mark.campaign
@pytest.mark.parametrize("part", range(10))
def test_a_hundred_thousand_qps_against_daqp_and_proxqp(solver: CompiledQpSolver, part) -> None:
    solved = _check(solver, 10_000, PEERS, seed=100 + part)
    print(f"solved by peers: {dict(solved)}")


def test_a_solution_is_found_again_from_its_working_set_without_a_step(solver) -> None:
    for family, qp in random_qps(200, seed=6):
        if family == "integers":  # of ties, of which any may be taken
            continue
        guess = np.zeros(40)
        cold = solver.solve(qp, guess)
        warm = solver.solve(qp, guess)
        assert warm[3] == 0
        np.testing.assert_allclose(warm[1].v, cold[1].v, rtol=1e-9, atol=1e-9)


def test_the_solution_does_not_depend_on_what_was_solved_before(solver) -> None:
    qps = [qp for _, qp in random_qps(20, seed=4)]
    first = [solver.solve(qp)[1].v for qp in qps]
    again = [solver.solve(qp)[1].v for qp in reversed(qps)]
    for one, other in zip(first, reversed(again), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize(
    ("change", "status"),
    [({"H": -np.eye(20)}, NOT_CONVEX), ({"H": np.full((20, 20), np.nan)}, NOT_FINITE)],
)
def test_a_qp_without_a_solution_is_named(solver, change: dict, status: int) -> None:
    _, qp = next(random_qps(1, seed=5))
    assert solver.solve(SoftQp(**{**vars(qp), **change}))[0] == status
