import itertools

import numpy as np

from controllers.dynamic_programming import Grid, graded_axis

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
        GRID.interpolant(function(GRID.points))(list(x.T)), function(x), rtol=1e-12, atol=1e-12
    )


def test_weights_are_a_row_of_a_stochastic_matrix_inside_and_outside():
    x = 3.0 * states() - 1.0
    corners = GRID.weights(list(x.T))
    weights = np.stack([weight for _, weight in corners])
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=1e-14)
    indices = np.stack([index for index, _ in corners])
    assert indices.min() >= 0
    assert indices.max() < GRID.size


def test_states_outside_are_served_by_the_nearest_state_of_the_box():
    values = np.random.default_rng(1).normal(size=GRID.size)
    inside, outside = np.array([[2.0, -1.0, 0.3]]), np.array([[7.0, -3.0, 0.3]])
    assert GRID.interpolant(values)(list(outside.T)) == GRID.interpolant(values)(list(inside.T))


SMOOTH = Grid(
    (np.array([0.0, 0.5, 1.1, 1.4, 2.0, 3.0]), np.linspace(-1.0, 4.0, 8) ** 3),
    ((0.0, 2.0), (-1.0, 30.0)),
)


def test_cubics_are_interpolated_exactly_within_the_smooth_intervals():
    generator = np.random.default_rng(5)
    coefficients = generator.normal(size=(4, 4))
    upper = SMOOTH.axes[1][SMOOTH.axes[1] <= 30.0][-1]
    x = generator.uniform([0.0, -1.0], [2.0, upper], (300, 2))

    def function(x):
        return np.polynomial.polynomial.polyval2d(*x.T, coefficients)

    np.testing.assert_allclose(
        SMOOTH.interpolant(function(SMOOTH.points))(list(x.T)), function(x), rtol=1e-10, atol=1e-8
    )


def test_cubic_weights_are_what_interpolation_multiplies_with_and_sum_to_one():
    generator = np.random.default_rng(7)
    values = generator.normal(size=SMOOTH.size)
    x = list(generator.uniform([-1.0, -5.0], [4.0, 70.0], (400, 2)).T)
    weights = SMOOTH.weights(x)
    np.testing.assert_allclose(sum(weight for _, weight in weights), 1.0, rtol=1e-10)
    np.testing.assert_allclose(
        sum(weight * values[index] for index, weight in weights),
        SMOOTH.interpolant(values)(x),
        rtol=1e-9,
        atol=1e-9,
    )


def test_graded_axis_is_dense_at_features_grows_outside_and_meets_its_marks():
    features = [(0.0, 2.0, 0.1), (50.0, 50.0, 0.02)]
    axis = graded_axis([-10.0, 50.0, 100.0], features, 1.3)
    cells = np.diff(axis)
    assert axis[[0, -1]].tolist() == [-10.0, 100.0]
    assert 50.0 in axis
    inside = (axis[:-1] >= 0.0) & (axis[1:] <= 2.0)
    assert inside.sum() >= 18
    assert (cells[inside] <= 0.1 + 1e-9).all()
    beside = np.searchsorted(axis, 50.0)
    assert cells[beside - 1 : beside + 1].max() < 0.03
    # Growth is that of a continuous width, so that a cell may be a little wider than 1.3 times.
    assert (cells[1:] / cells[:-1] < 1.5).all()
    assert len(axis) < 100
