from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from controllers.dynamic_programming import (
    GainEstimate,
    Grid,
    Settings,
    certify,
    evaluate_policy,
    objection,
    simulate_policy,
    solve,
)
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
    optimum = solve(SCALAR.plant, settings, progress=lambda *told: rounds.append(told))
    final = [found for level, _, found in rounds if level == 2]
    assert len(final) >= 3
    # Two quadratures are at work, the draft's and the last one's.
    slack = 1e-5 * optimum.gain
    for found in final:
        assert found.lower <= optimum.gain + slack
        assert found.upper >= optimum.gain - slack
    gains = [found.gain for found in final]
    assert (np.diff(gains) <= slack).all()
    assert optimum.upper - optimum.lower <= 1e-7 * optimum.gain


@pytest.mark.slow
def test_number_of_workers_changes_no_bit():
    one, three = (solve(SCALAR.plant, Settings(level=4), workers=workers) for workers in (1, 3))
    assert one.grid.size > 128
    np.testing.assert_array_equal(one.actions, three.actions)
    assert one.gain == three.gain


def test_refining_a_solution_equals_solving_finely(scalar_levels):
    coarse, fine = scalar_levels
    refined = certify(SCALAR.plant, Settings(), coarse, paths=2, steps=1)
    assert refined.grid.size > 1.4 * coarse.grid.size
    assert refined.gain == pytest.approx(fine.gain, rel=1e-5)


@pytest.mark.slow
def test_unstable_plant_that_leaves_its_box_is_refused():
    plant = LinearPlant(
        F=[[1.5]], G=[[0.01]], E=[[1.0]], Q=[[1.0]], R=[[1.0]], sigma=[0.5], bound=1.0
    )
    with pytest.raises(OptimumError):
        solved(plant, 1)


PLANT = SCALAR.plant


@pytest.fixture(scope="module")
def optimum():
    return solve(PLANT, Settings())


def test_the_simulated_mean_cost_is_the_linear_regulators(optimum):
    mean, half_width = simulate_policy(PLANT, optimum, paths=400, steps=1000)
    exact = SCALAR.mean_cost(SCALAR.riccati()[1])
    assert half_width < 0.01 * exact
    assert abs(mean - exact) < 2 * half_width


def test_a_solution_is_certified_by_its_refinements(optimum):
    certified = certify(PLANT, Settings(), optimum, paths=200, steps=500)
    figures = {figure.name: figure for figure in certified.certificate}
    assert list(figures) == ["solution", "refinement", "simulation"]
    assert certified.gain == figures["refinement"].value
    assert figures["solution"].value == optimum.gain
    # So short a simulation cannot certify.
    assert objection(certified.certificate) is not None


def against(search=None, **values):
    given = {"solution": 1000.0, "refinement": 1000.2, "simulation": 999.9} | values
    figures = [
        GainEstimate(name, x, x - 0.1, x + 0.1) for name, x in given.items() if x is not None
    ]
    if search is not None:
        figures.append(GainEstimate("policy search", search, search - 0.1, search + 0.1))
    return objection(figures)


@pytest.mark.parametrize(
    ("figures", "words"),
    [
        ({}, None),
        ({"search": 1003.0}, None),
        ({"search": 999.8}, None),
        ({"search": 999.0}, "a policy search found 999.00"),
        ({"refinement": None}, "not made: refinement"),
        ({"solution": 1000.8}, "apart, more than 0.05 %"),
        ({"simulation": 1000.8}, "apart, more than 0.05 %"),
    ],
)
def test_what_is_called_the_optimum_agrees_and_no_search_is_below_it(figures, words):
    found = against(**figures)
    assert found is None if words is None else words in found


STATES = 12


class RandomChain:
    """Stands in for the Bellman operator: a fixed stochastic matrix and cost."""

    def __init__(self):
        generator = np.random.default_rng(8)
        self.matrix = generator.uniform(size=(STATES, STATES)) ** 6
        self.matrix /= self.matrix.sum(axis=1, keepdims=True)
        self.cost = generator.normal(size=STATES)
        self.problem = SimpleNamespace()

    def chain(self, actions, grid):
        return sparse.csr_array(self.matrix), self.cost


GRID = Grid((np.arange(float(STATES)),))


def test_gain_and_distribution_are_those_of_the_chains_powers():
    chain = RandomChain()
    W, gain, distribution = evaluate_policy(chain, GRID, np.zeros((STATES, 1)), 3)
    limit = np.linalg.matrix_power(chain.matrix, 4096)[0]
    np.testing.assert_allclose(distribution, limit, atol=1e-7)
    assert gain == pytest.approx(limit @ chain.cost, abs=1e-7)
    assert W[3] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(W + gain, chain.cost + chain.matrix @ W, atol=1e-7)


def test_a_chain_that_rests_in_two_places_has_the_gain_of_the_anchor():
    chain = RandomChain()
    chain.matrix = np.eye(STATES)
    _, gain, distribution = evaluate_policy(chain, GRID, np.zeros((STATES, 1)), 5)
    assert gain == pytest.approx(chain.cost[5], abs=1e-6)
    assert distribution[5] == pytest.approx(1.0, abs=1e-6)
