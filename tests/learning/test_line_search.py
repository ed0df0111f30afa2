import numpy as np
import pytest

from controllers.parameters import Parameters
from learning.episodes import Block, Settle
from learning.line_search import LineSearch
from learning.race import Races

BLOCKS = 8


class Bowl:
    """A plant whose cost wants a back-off of X2 that depends on the inputs' weights.

    6300 + 40 (x_l − 25 − 2.5 − log₁₀ r)² + 10 (log₁₀ r − log₁₀ r*)², r the weight of P100.
    """

    def __init__(self, start, best):
        self.start, self.best = start, best

    def cost(self, theta):
        parameters = self.start.with_theta(theta)
        decades = np.log10(parameters["B_l"][2, 2])
        back_off = parameters["x_l"][0] - 27.5 - decades
        return 6300.0 + 40.0 * back_off**2 + 10.0 * (decades - np.log10(self.best)) ** 2

    def drive(self, plan):
        try:
            request = next(plan)
            while True:
                cost = 0.0 if isinstance(request, Settle) else self.cost(request.theta)
                request = plan.send(Block(cost, 0.0, np.zeros((0, 2)), np.zeros((0, 2)), None))
        except StopIteration as end:
            return end.value


@pytest.fixture
def start(problem):
    naive = Parameters.naive(problem, value_offset=6e5)
    return naive.replace({"x_l": naive["x_l"] + [2.5, 0.0], "b_l": [1.0, -2.0, 30.0, 4.0]})


@pytest.fixture
def search(scenario, start):
    races = Races(scenario, start, 100_000, block=100, blocks=BLOCKS)
    lines = LineSearch(races, start, 2, np.random.default_rng(0))
    return races, lines


def minimiser(parameters):
    return np.linalg.solve(parameters["B_l"], parameters["b_l"])


def test_the_inputs_weights_are_found_each_with_its_own_back_off(search, start):
    """With the back-off of before, a tenth of the weight would cost more: 30 > 0."""
    races, lines = search
    plant = Bowl(start, 1e-2)
    same = lines._weighted(0.1)
    assert plant.cost(same) > plant.cost(start.theta)
    plant.drive(races.renew(BLOCKS))
    assert plant.drive(lines.rescale(-1.0)) == -1.0
    found = start.with_theta(races.incumbent.theta)
    assert np.diag(found["B_l"]) == pytest.approx([1.0, 1.0, 1e-2, 1e-2])
    assert found["x_l"][0] == pytest.approx(25.5, abs=0.5)
    assert minimiser(found) == pytest.approx(minimiser(start))
    assert 0 < races.least < 1e-2, "smaller weights are admissible from now on"


def test_weights_that_do_not_pay_leave_all_as_it_was(search, start):
    races, lines = search
    plant, least = Bowl(start, 1.0), races.least
    plant.drive(races.renew(BLOCKS))
    assert plant.drive(lines.rescale(-1.0)) == pytest.approx(0.7), "shorter, the other way"
    assert np.array_equal(races.incumbent.theta, start.theta)
    assert races.least == least


def test_a_line_is_searched_both_ways_in_steps_that_double(search, start):
    races, lines = search
    plant = Bowl(start.replace({}), 1.0)
    # From 2.5 too high: the first way is the wrong one.
    high = start.replace({"x_l": start["x_l"] + [2.5, 0.0]})
    races.incumbent.theta = high.theta
    plant.drive(races.renew(BLOCKS))
    reach = plant.drive(lines.along(lines.tightening(), 1.0))
    assert reach > 1.0
    assert plant.cost(races.incumbent.theta) < 0.4 * (plant.cost(high.theta) - 6300.0) + 6300.0


def test_one_state_is_backed_off_alone(search, start):
    _, lines = search
    moved = {start.blocks.labels[i] for i in np.flatnonzero(lines.tightening(1))}
    assert moved == {"x_l[1]", "x_u[1]"}
    assert np.count_nonzero(lines.tightening()) == 4
