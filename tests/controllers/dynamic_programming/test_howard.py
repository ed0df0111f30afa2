from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from controllers.dynamic_programming import Grid, evaluate

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
    W, gain, distribution = evaluate(chain, GRID, np.zeros((STATES, 1)), 3)
    limit = np.linalg.matrix_power(chain.matrix, 4096)[0]
    np.testing.assert_allclose(distribution, limit, atol=1e-7)
    assert gain == pytest.approx(limit @ chain.cost, abs=1e-7)
    assert W[3] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(W + gain, chain.cost + chain.matrix @ W, atol=1e-7)


def test_a_chain_that_rests_in_two_places_has_the_gain_of_the_anchor():
    chain = RandomChain()
    chain.matrix = np.eye(STATES)
    _, gain, distribution = evaluate(chain, GRID, np.zeros((STATES, 1)), 5)
    assert gain == pytest.approx(chain.cost[5], abs=1e-6)
    assert distribution[5] == pytest.approx(1.0, abs=1e-6)
