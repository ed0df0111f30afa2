import itertools

import numpy as np
import pytest

from controllers.dynamic_programming.axes import graded_axis, support
from controllers.dynamic_programming.grid import Grid
from controllers.errors import OptimumError

GRID = Grid((np.array([0.0, 0.5, 2.0]), np.array([-1.0, 1.0, 1.5, 4.0]), np.array([0.0, 1.0])))


def states(count=500, seed=0):
    low = [axis[0] for axis in GRID.axes]
    high = [axis[-1] for axis in GRID.axes]
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def test_multilinear_functions_are_interpolated_exactly():
    generator = np.random.default_rng(3)
    powers = np.array(list(itertools.product((0, 1), repeat=3)))
    coefficients = generator.normal(size=len(powers))

    def function(x):
        return np.prod(x[:, None, :] ** powers, axis=2) @ coefficients

    x = states()
    np.testing.assert_allclose(
        GRID.interpolate(function(GRID.points), list(x.T)), function(x), rtol=1e-12, atol=1e-12
    )


def test_weights_are_a_row_of_a_stochastic_matrix_inside_and_outside():
    x = 3.0 * states() - 1.0
    corners = GRID.corners(list(x.T))
    weights = np.stack([weight for _, weight in corners])
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=1e-14)
    indices = np.stack([index for index, _ in corners])
    assert indices.min() >= 0
    assert indices.max() < GRID.size


def test_states_outside_are_served_by_the_nearest_state_of_the_box():
    values = np.random.default_rng(1).normal(size=GRID.size)
    inside, outside = np.array([[2.0, -1.0, 0.3]]), np.array([[7.0, -3.0, 0.3]])
    assert GRID.interpolate(values, list(outside.T)) == GRID.interpolate(values, list(inside.T))


def test_resampling_on_the_same_grid_changes_nothing():
    values = np.random.default_rng(1).normal(size=(GRID.size, 2))
    np.testing.assert_allclose(GRID.resample(values, GRID), values, rtol=1e-14)


def test_nearest_and_boundary():
    assert GRID.points[GRID.nearest([0.6, 1.2, 0.9])].tolist() == [0.5, 1.0, 1.0]
    assert GRID.boundary.all()
    middle = Grid((np.arange(3.0), np.arange(4.0)))
    assert middle.points[~middle.boundary].tolist() == [[1, 1], [1, 2]]


@pytest.mark.parametrize("axis", [[0.0], [0.0, 0.0], [1.0, 0.0], [0.0, np.nan]])
def test_bad_axis_is_refused(axis):
    with pytest.raises(OptimumError, match="at least two increasing points"):
        Grid((np.array(axis),))


def test_graded_axis_is_dense_inside_grows_outside_and_meets_its_ends():
    axis = graded_axis(-10.0, 100.0, 0.0, 2.0, 0.1, 1.3)
    cells = np.diff(axis)
    inside = (axis[:-1] >= -1e-12) & (axis[1:] <= 2 + 1e-12)
    assert axis[0] == pytest.approx(-10.0)
    assert axis[-1] == pytest.approx(100.0)
    np.testing.assert_allclose(cells[inside], 0.1, rtol=1e-9)
    assert (cells[1:] / cells[:-1] < 1.31).all()
    assert len(axis) < 60


def test_graded_axis_without_room_outside_is_equidistant():
    np.testing.assert_allclose(graded_axis(0.0, 1.0, -1.0, 2.0, 0.25, 1.3), np.arange(5) / 4)


def test_support_leaves_out_the_tails_only():
    axis = np.arange(8.0)
    mass = np.array([0.0, 1e-9, 0.2, 0.3, 0.5, 1e-9, 0.0, 0.0])
    assert support(axis, mass, 1e-6) == (1.0, 5.0)
