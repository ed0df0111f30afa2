import numpy as np
import pytest

from controllers.dynamic_programming import Settings, refine, solve
from controllers.errors import OptimumError
from tests.helpers.linear_plant import PLANE, SCALAR, LinearPlant


def solved(plant, level, **settings):
    return solve(plant.plant, Settings(level=level, **settings))


@pytest.fixture(scope="module")
def scalar_levels():
    return [solved(SCALAR, level) for level in (1, 2)]


def test_mean_cost_is_riccatis_on_the_coarsest_grid_that_knows_the_support(scalar_levels):
    exact = np.trace(SCALAR.riccati()[0] @ SCALAR.covariance)
    for optimum in scalar_levels:
        # W is quadratic, which the cubic holds exactly.
        assert optimum.gain == pytest.approx(exact, rel=1e-5)
    assert scalar_levels[0].grid.size < 50


def test_policy_is_the_linear_quadratic_regulator(scalar_levels):
    P, K = SCALAR.riccati()
    optimum = scalar_levels[-1]
    x = optimum.grid.points
    near = np.abs(x[:, 0]) < 0.4
    assert near.sum() > 30
    np.testing.assert_allclose(optimum.actions[near], x[near] @ K.T, atol=4e-3)
    W = optimum.W - optimum.W[np.abs(x[:, 0]).argmin()]
    np.testing.assert_allclose(W[near], P[0, 0] * x[near, 0] ** 2, atol=1e-3)


@pytest.mark.slow
def test_two_states_and_two_disturbances_agree_with_riccati():
    P, K = PLANE.riccati()
    exact = np.trace(P @ PLANE.covariance)
    found = solved(PLANE, 1, nodes=(3, 3), tail=1e-3, growth=1.6, tolerance=1e-3)
    assert found.gain == pytest.approx(exact, rel=1e-3)
    x = found.grid.points
    near = np.abs(x).max(axis=1) < 0.2
    np.testing.assert_allclose(found.actions[near], x[near] @ K.T, atol=0.02)


def test_bounds_enclose_the_optimum_in_every_round_and_the_gain_falls():
    rounds = []
    settings = Settings(level=2, tolerance=1e-7)
    optimum = solve(SCALAR.plant, settings, progress=rounds.append)
    final = [progress for progress in rounds if progress.level == 2]
    assert len(final) >= 3
    # Two quadratures are at work, the draft's and the last one's.
    slack = 1e-5 * optimum.gain
    for progress in final:
        assert progress.lower <= optimum.gain + slack
        assert progress.upper >= optimum.gain - slack
    gains = [progress.gain for progress in final]
    assert (np.diff(gains) <= slack).all()
    assert optimum.upper - optimum.lower <= 1e-7 * optimum.gain


def test_number_of_workers_changes_no_bit():
    one, three = (solve(SCALAR.plant, Settings(level=4), workers=workers) for workers in (1, 3))
    assert one.grid.size > 128
    np.testing.assert_array_equal(one.actions, three.actions)
    assert one.gain == three.gain


def test_refining_a_solution_equals_solving_finely(scalar_levels):
    coarse, fine = scalar_levels
    refined = refine(SCALAR.plant, Settings(), coarse, level=2)
    assert refined.grid.size > 1.4 * coarse.grid.size
    assert refined.gain == pytest.approx(fine.gain, rel=1e-5)
    again = refine(SCALAR.plant, Settings(), coarse, accuracy=coarse.accuracy.finer())
    np.testing.assert_array_equal(again.grid.points, coarse.grid.points)
    assert again.gain == pytest.approx(coarse.gain, rel=1e-5)


def test_unstable_plant_that_leaves_its_box_is_refused():
    plant = LinearPlant(
        F=[[1.5]], G=[[0.01]], E=[[1.0]], Q=[[1.0]], R=[[1.0]], sigma=[0.5], bound=1.0
    )
    with pytest.raises(OptimumError):
        solved(plant, 1)
