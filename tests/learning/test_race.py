import numpy as np
import pytest

from controllers.parameters import Parameters
from learning.episodes import Block, Settle
from learning.race import Races, Spent

BLOCKS = 8


class Plant:
    """Answers with the block costs of each θ, known by the value of c_lambda; counts blocks."""

    def __init__(self, start, costs):
        self.where = start.blocks.slices["c_lambda"]
        self.costs, self.episodes, self.run, self.block = costs, [], {}, 0

    def drive(self, plan):
        """What a generator of requests returns once each has been answered."""
        try:
            request = next(plan)
            while True:
                request = plan.send(self.answer(request))
        except StopIteration as end:
            return end.value

    def answer(self, request):
        name = float(request.theta[self.where][0])
        if isinstance(request, Settle):
            self.episodes.append(request.episode)
            cost = 0.0
        else:
            self.block = 0 if request.begins else self.block + 1
            cost = self.costs[name][self.block]
            self.run[name] = self.run.get(name, 0) + 1
        return Block(cost, 0.0, np.zeros((0, 2)), np.zeros((0, 2)), None)


@pytest.fixture
def start(problem):
    return Parameters.naive(problem, value_offset=1.0)


@pytest.fixture
def rival(start):
    return start.replace({"c_lambda": 2.0}).theta


def races(scenario, start, samples=10_000):
    return Races(scenario, start, samples, block=100, blocks=BLOCKS)


def settled(scenario, start, costs):
    plant, made = Plant(start, costs), races(scenario, start)
    plant.drive(made.renew(BLOCKS))
    return plant, made


def test_a_winner_has_run_all_blocks(scenario, start, rival):
    noise = np.arange(BLOCKS) * 5.0
    plant, made = settled(scenario, start, {1.0: 100.0 + noise, 2.0: 99.0 + noise})
    assert plant.drive(made.race(rival))
    assert np.array_equal(made.incumbent.theta, rival)
    assert plant.run[2.0] == BLOCKS
    assert made.spent == 100 * (1 + 2 * BLOCKS)


def test_a_loser_is_given_up_at_once(scenario, start, rival):
    plant, made = settled(scenario, start, {1.0: [100.0] * BLOCKS, 2.0: [101.0] + [0.0] * 7})
    assert not plant.drive(made.race(rival))
    assert np.array_equal(made.incumbent.theta, start.theta)
    assert plant.run[2.0] == 1


def test_patience_lets_a_rival_mend_what_it_was_left_with(scenario, start, rival):
    """As a θ must that begins where another one let a slow state drift to."""
    drifting, mending = 100.0 + 10.0 * np.arange(BLOCKS), 110.0 - 5.0 * np.arange(BLOCKS)
    plant, made = settled(scenario, start, {1.0: drifting, 2.0: mending})
    assert not plant.drive(made.race(rival))
    assert plant.drive(made.race(rival, patient=True))


def test_patience_ends_where_the_blocks_spread_cannot_explain_the_loss(scenario, start, rival):
    plant, made = settled(scenario, start, {1.0: 100.0 + np.arange(BLOCKS), 2.0: [1e6] * BLOCKS})
    assert not plant.drive(made.race(rival, patient=True))
    assert plant.run[2.0] == 1


def test_the_last_digits_win_nothing(scenario, start, rival):
    costs = {1.0: [6000.0] * BLOCKS, 2.0: [6000.0 - 1e-10] * BLOCKS}
    plant, made = settled(scenario, start, costs)
    assert not plant.drive(made.race(rival))
    assert plant.drive(made.sprint(rival, made.incumbent.costs)) is None


def test_a_gain_within_its_standard_error_wins_nothing(scenario, start, rival):
    draws = np.array([-9.0, 8.0, -9.0, 8.0, -9.0, 8.0, -9.0, 8.0])
    plant, made = settled(scenario, start, {1.0: [100.0] * BLOCKS, 2.0: 100.0 + draws})
    assert not plant.drive(made.race(rival))
    assert plant.run[2.0] == BLOCKS


def test_a_sprint_gives_the_costs_of_what_wins_it(scenario, start, rival):
    plant, made = settled(scenario, start, {1.0: [100.0] * BLOCKS, 2.0: [90.0] * BLOCKS})
    costs = plant.drive(made.sprint(rival, made.incumbent.costs[:2]))
    assert costs == pytest.approx([90.0, 90.0])
    assert np.array_equal(made.incumbent.theta, start.theta), "a sprint is no race"


def test_the_final_leaves_the_cheapest_and_begins_anew(scenario, start, rival):
    third = start.replace({"c_lambda": 3.0}).theta
    costs = {1.0: 100.0 + np.arange(BLOCKS), 2.0: [1e6] * BLOCKS, 3.0: [99.0] * BLOCKS}
    plant, made = Plant(start, costs), races(scenario, start)
    plant.drive(made.final([rival, third], BLOCKS, 17))
    assert plant.episodes == [17]
    assert np.array_equal(made.incumbent.theta, third)
    assert plant.run[2.0] == 1, "given up where it cannot win any more"


def test_the_budget_is_kept(scenario, start, rival):
    made = races(scenario, start, samples=100 * (1 + BLOCKS) + 250)
    plant = Plant(start, {1.0: [100.0] * BLOCKS, 2.0: [90.0] * BLOCKS})
    plant.drive(made.renew(BLOCKS))
    with pytest.raises(Spent):
        plant.drive(made.race(rival))
    assert made.spent == made.limit - 50
    assert np.array_equal(made.incumbent.theta, start.theta)


@pytest.mark.parametrize(
    ("block", "value"), [("x_l", [101.0, 40.0]), ("x_u", [24.0, 80.0]), ("b_l", [np.nan, 0, 0, 0])]
)
def test_a_theta_that_no_controller_takes_is_not_tried(scenario, start, block, value):
    made = races(scenario, start)
    theta = start.theta.copy()
    theta[start.blocks.slices[block]] = value
    assert made.admissible(theta) is None


def test_the_final_leaves_the_start_only_for_what_is_cheaper_by_a_standard_error(
    scenario, start, rival
):
    lucky = np.where(np.arange(BLOCKS) == 0, -2.0, 0.25)
    for gain, leaves in ((lucky, False), (np.full(BLOCKS, -1.0), True)):
        plant, made = settled(scenario, start, {1.0: [100.0] * BLOCKS, 2.0: 100.0 + gain})
        plant.drive(made.final([rival], BLOCKS, 17))
        assert np.array_equal(made.incumbent.theta, rival if leaves else start.theta)
