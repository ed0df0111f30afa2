import numpy as np
import pytest

from controllers import Parameters, RtiNmpc, sensitivities
from controllers.qp.problem import StageMatrices, kkt_solve, kkt_solve_by_stages
from tests.helpers.sampling import evaporator_problem


def visited(horizon, hessian, rng, count=12):
    """Solutions along a walk that meets rows at their limit, violated rows and held controls."""
    problem = evaporator_problem(horizon=horizon)
    controller = RtiNmpc(problem, Parameters.naive(problem), hessian=hessian)
    for k in range(count):
        s = problem.reference_state + rng.normal(size=2) * (0.5, 3.0)
        s = np.array([18.0, 70.0]) if k % 4 == 3 else s
        controller.prepare()
        yield controller.feedback(s)


@pytest.mark.parametrize("horizon", [1, 2, 12])
@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
def test_it_agrees_with_the_condensed_system(horizon, hessian, rng):
    kinds = np.zeros(3)
    for solution in visited(horizon, hessian, rng):
        qp = solution.qp
        active = solution.multipliers.active(qp)
        kinds += [mask.any() for mask in active]
        seeds = rng.normal(size=(2, qp.f.size))
        dense = kkt_solve(qp, active, seeds, np.zeros((2, qp.w.size)))
        banded = kkt_solve_by_stages(solution._stages(), qp.W, active, seeds)
        for ours, theirs in zip(banded, dense, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11 * np.abs(theirs).max())
    if horizon == 12:
        assert kinds.all(), "the walk must meet every kind of activity"


def test_the_policys_jacobian_is_the_same_by_either(rng, monkeypatch):
    jacobians = {}
    for least in (1, 10_000):
        monkeypatch.setattr(sensitivities, "LEAST_CONTROLS", least)
        walk = visited(8, "exact", np.random.default_rng(1))
        jacobians[least] = [solution.policy_jacobian for solution in walk]
    for banded, dense in zip(jacobians[1], jacobians[10_000], strict=True):
        np.testing.assert_allclose(banded, dense, rtol=0, atol=1e-10 * np.abs(dense).max())


def test_a_singular_system_is_left_to_least_squares():
    stages = StageMatrices(
        A=np.zeros((2, 1, 1)), B=np.zeros((2, 1, 1)), L=np.tile(np.eye(2), (2, 1, 1)), L_N=np.eye(1)
    )
    none, all_ = np.zeros(2, bool), np.ones(2, bool)
    assert kkt_solve_by_stages(stages, np.ones(2), (none, all_, none), np.eye(1, 2)) is None
