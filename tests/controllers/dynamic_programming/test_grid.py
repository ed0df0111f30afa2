import itertools

import casadi as ca
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from controllers.dynamic_programming import (
    Elementwise,
    Grid,
    Refinement,
    gauss_rule,
    graded_axis,
    nelder_mead,
    scan,
)
from controllers.problem import DisturbanceLaw

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


LAWS = {
    "uniform": lambda mean, spread: scipy.stats.uniform(mean - spread, 2 * spread),
    "normal": scipy.stats.norm,
}


@pytest.mark.parametrize("kind", LAWS)
def test_moments_up_to_twice_the_nodes_are_those_of_scipy(kind):
    law = DisturbanceLaw(kind, np.array([1.5]), np.array([0.7]))
    (nodes,), weights = gauss_rule(law, (5,))
    distribution = LAWS[kind](1.5, 0.7)
    for degree in range(1, 10):
        assert weights @ nodes**degree == pytest.approx(distribution.moment(degree), rel=1e-12)


def test_refinement_reproduces_polynomials_of_the_coarse_degree():
    law = DisturbanceLaw("uniform", np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.5, 2.0]))
    coarse, fine = (gauss_rule(law, counts)[0] for counts in ((4, 3, 2), (9, 8, 5)))

    def polynomial(nodes):
        x, y, z = (axis.reshape(-1) for axis in np.meshgrid(*nodes, indexing="ij"))
        return np.stack([x**3 * y**2 * z, 1 + x - y * z])

    carried = Refinement(coarse, fine)(polynomial(coarse))
    np.testing.assert_allclose(carried, polynomial(fine), rtol=1e-12, atol=1e-12)


NAMED = (
    "exp", "log", "log1p", "expm1", "sqrt", "fabs",
    "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh",
)  # fmt: skip
UNARY = {name: getattr(ca, name) for name in NAMED} | {
    "neg": lambda a: -a,
    "square": lambda a: a * a,
    "twice": lambda a: 2 * a,
    "inverse": lambda a: 1 / a,
    "power": lambda a: a**2.5,
    "sign": lambda a: ca.sign(a - 0.5),
    "floor": lambda a: ca.floor(3 * a),
    "ceil": lambda a: ca.ceil(3 * a),
    "not": lambda a: ca.logic_not(a > 0.5),
}
BINARY = {
    "pow": lambda a, b: a**b,
    "atan2": ca.atan2,
    "hypot": ca.hypot,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "less": lambda a, b: a < b,
    "less or equal": lambda a, b: a <= b,
    "equal": lambda a, b: ca.floor(2 * a) == ca.floor(2 * b),
    "unequal": lambda a, b: ca.floor(2 * a) != ca.floor(2 * b),
    "and": lambda a, b: ca.logic_and(a > 0.5, b > 0.5),
    "or": lambda a, b: ca.logic_or(a > 0.5, b > 0.5),
    "if else": lambda a, b: ca.if_else(a > b, ca.exp(a), b),
}


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_every_operation_agrees_with_casadi(name):
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    result = UNARY[name](a) if name in UNARY else BINARY[name](a, b)
    function = ca.Function("f", [ca.vertcat(a, b)], [result])
    points = np.random.default_rng(2).uniform(0.05, 0.95, (2, 200))
    (values,) = Elementwise(function)(points)
    np.testing.assert_allclose(
        np.broadcast_to(values, 200), function.map(200)(points).full()[0], rtol=1e-14
    )


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
