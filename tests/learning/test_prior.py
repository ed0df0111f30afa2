import numpy as np
import pytest

from controllers.theta import Parameters, ThetaBlocks
from learning.step import prior_deviation
from tests.helpers.other_units import factors


def parameters(problem, rng):
    blocks = ThetaBlocks.of(problem, slack_weights=True)
    root = rng.normal(size=(4, 4))
    naive = Parameters.naive(problem, blocks, value_offset=6e5)
    return naive.replace(
        {
            "B_l": (root @ root.T + (root @ root.T).T) / 2,
            "B_Vf": np.diag(rng.uniform(1.0, 2.0, 2)),
            "b_l": rng.normal(size=4),
            "b_lambda": rng.normal(size=2),
        }
    )


def test_other_units_of_states_inputs_and_cost_give_the_same_prior(problem, rng):
    start = parameters(problem, rng)
    state, action, cost = np.array([10.0, 0.1]), np.array([1e-3, 7.0]), 50.0
    factor = factors(start.blocks, state, action, cost)
    moved, erred, explored = np.array([1.5, 2.0]), np.array([1.0, 0.1]), np.array([10.0, 10.0])
    width = prior_deviation(start, moved, erred, explored, 6e5, 0.3)
    other = prior_deviation(
        start.with_theta(factor * start.theta),
        state * moved,
        state * erred,
        action * explored,
        cost * 6e5,
        0.3,
    )
    assert other == pytest.approx(factor * width)


def test_the_naive_start_of_the_evaporator_has_the_widths_that_were_found_by_hand(problem):
    blocks = ThetaBlocks.of(problem)
    start = Parameters.naive(problem, blocks, value_offset=621_038.0)
    explored = np.array([10.0, 10.0])
    width = start.with_theta(
        prior_deviation(start, np.array([1.6, 1.4]), np.array([1.0, 0.1]), explored, 621_038.0, 0.3)
    )
    assert width["B_l"] == pytest.approx(np.full((4, 4), 0.3))
    assert width["b_l"] == pytest.approx(np.full(4, 3.0))
    assert width["x_l"][0] == pytest.approx(2.0)
    assert width["c_lambda"] == pytest.approx(1e5, rel=0.01)


def test_a_start_without_movement_or_cost_has_widths_above_zero(problem):
    blocks = ThetaBlocks.of(problem)
    start = Parameters(blocks, np.zeros(blocks.size))
    nothing = np.zeros(2)
    assert (prior_deviation(start, nothing, nothing, nothing, 0.0, 0.3) > 0).all()
