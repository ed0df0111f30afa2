import numpy as np
import pytest
import scipy.optimize

from controllers.dynamic_programming import nelder_mead, scan

LOWER, UPPER = np.array([-4.0, -4.0]), np.array([4.0, 4.0])


def minimise(function, start, size=0.5, iterations=200, precision=1e-12):
    start = np.array(start, dtype=float)
    return nelder_mead(
        function,
        start,
        np.full(start.shape, size),
        LOWER,
        UPPER,
        iterations=iterations,
        precision=precision,
    )


def test_each_of_many_quadratics_is_minimised():
    generator = np.random.default_rng(0)
    roots = generator.normal(size=(50, 2, 2)) + 1.5 * np.eye(2)
    centres = generator.uniform(-3, 3, (50, 2))

    def function(rows, points):
        return np.square(np.einsum("bij,bj->bi", roots[rows], points - centres[rows])).sum(axis=1)

    points, values = minimise(function, np.zeros((50, 2)))
    np.testing.assert_allclose(points, centres, atol=1e-4)
    assert values.max() < 1e-10


def test_box_constrained_quadratic_agrees_with_scipy():
    matrix, centre = np.array([[2.0, 0.8], [0.8, 1.0]]), np.array([6.0, 1.0])

    def function(rows, points):
        return np.einsum("bi,ij,bj->b", points - centre, matrix, points - centre)

    point, value = minimise(function, [[0.0, 0.0]])
    expected = scipy.optimize.minimize(
        lambda x: (x - centre) @ matrix @ (x - centre),
        np.zeros(2),
        bounds=list(zip(LOWER, UPPER, strict=True)),
        method="L-BFGS-B",
    )
    np.testing.assert_allclose(point[0], expected.x, atol=1e-4)
    assert value[0] == pytest.approx(expected.fun, rel=1e-6)


def test_search_follows_a_steep_kinked_valley():
    # As the penalty makes it: slope 1e5 across, gentle along, not aligned with the axes.
    def function(rows, points):
        x, y = points.T
        return 1e5 * np.maximum(x - 0.3 * y, 0.0) - 60 * (x - 0.3 * y) + 0.05 * (y - 2.0) ** 2

    point, value = minimise(function, [[-1.0, -2.0]], iterations=400)
    assert value[0] == pytest.approx(0.0, abs=2e-3)
    np.testing.assert_allclose(point[0], [0.6, 2.0], atol=0.2)


def test_result_is_never_worse_than_the_start_nor_outside_the_box():
    def function(rows, points):
        return np.sin(9 * points[:, 0]) * np.cos(7 * points[:, 1]) + 0.1 * points.sum(axis=1)

    start = np.random.default_rng(1).uniform(-4, 4, (200, 2))
    points, values = minimise(function, start, iterations=7)
    rows = np.arange(200)
    assert (values <= function(rows, start)).all()
    np.testing.assert_array_equal(values, function(rows, points))
    assert ((points >= LOWER) & (points <= UPPER)).all()


def test_scan_finds_the_better_basin_and_keeps_a_good_start():
    def function(rows, points):
        return np.minimum(
            np.square(points - 3.0).sum(axis=1) - 1.0, np.square(points + 2.0).sum(axis=1)
        )

    start = np.array([[-2.0, -2.0], [3.0, 3.0]])
    points, values = scan(function, start, LOWER, UPPER, 9)
    np.testing.assert_array_equal(points, [[3.0, 3.0], [3.0, 3.0]])
    np.testing.assert_array_equal(values, [-1.0, -1.0])
