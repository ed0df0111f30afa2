"""Going back to the θ that has been shown to cost least."""

import numpy as np
import pytest

from learning.retreat import Retreat, ShownCost, exceeds

SHIFT = 480
START = np.array([0.0])
MOVED = np.array([1.0])


class Operation:
    """A plant whose mean cost depends on θ, and a loop that does as `Retreat` says."""

    def __init__(self, rng, costs, probability=3e-4):
        self.retreat = Retreat(START, SHIFT, probability)
        self.rng = rng
        self.costs = costs
        self.theta = START

    def run(self, shifts, predicted=float("nan")):
        """θ after each of some shifts."""
        thetas = []
        for _ in range(shifts):
            for _ in range(SHIFT):
                cost = self.costs(self.theta[0]) + self.rng.normal(0.0, 50.0)
                back = self.retreat.observe(cost, self.theta, predicted)
                if back is not None:
                    self.theta = back
            thetas.append(self.theta[0])
        return thetas


def test_a_theta_that_costs_more_than_the_start_is_left(rng):
    operation = Operation(rng, lambda theta: 100.0 + 130.0 * theta)
    operation.run(2)
    operation.theta = MOVED
    assert operation.run(2)[-1] == 0.0
    assert operation.retreat.count == 1


def test_a_theta_that_costs_less_becomes_the_best(rng):
    operation = Operation(rng, lambda theta: 100.0 - 50.0 * theta if theta < 2 else 200.0)
    operation.run(1)
    operation.theta = MOVED
    operation.run(2)
    operation.theta = np.array([2.0])
    assert operation.run(2)[-1] == 1.0
    assert operation.retreat.best_theta == MOVED


def test_each_retreat_makes_the_rule_wait_twice_as_long(rng):
    operation = Operation(rng, lambda theta: 100.0 + 130.0 * theta)
    operation.run(1)
    waits = []
    for _ in range(3):
        operation.theta = MOVED
        while operation.theta[0]:
            operation.run(1)
        waits.append(-(-operation.retreat.samples_to_wait // SHIFT))
        operation.run(waits[-1])
    assert waits == [1, 2, 4]


def test_a_retreat_is_taken_back_where_the_plant_has_changed(rng):
    changed = False

    def costs(theta):
        return (500.0 if theta == 0 else 300.0) if changed else 100.0

    operation = Operation(rng, costs)
    operation.run(1)
    operation.theta = MOVED
    operation.run(1)
    changed = True
    # Back to the start, which costs still more by now.
    assert operation.run(3)[-1] == 1.0
    assert operation.retreat.samples_to_wait == 0


def test_a_start_that_was_never_measured_is_tried_where_the_prediction_was_wrong(rng):
    operation = Operation(rng, lambda theta: 100.0 + 130.0 * theta)
    operation.retreat.observe(100.0, MOVED)
    operation.theta = MOVED
    assert operation.run(1, predicted=60.0) == [0.0]


def test_a_prediction_that_came_true_is_no_reason_to_go_back(rng):
    operation = Operation(rng, lambda theta: 100.0 + 130.0 * theta)
    operation.retreat.observe(100.0, MOVED)
    operation.theta = MOVED
    assert operation.run(1, predicted=230.0) == [1.0]


def test_one_rare_penalty_makes_no_retreat(rng):
    ordinary = ShownCost(START, rng.normal(100.0, 1.0, 8))
    batches = rng.normal(100.0, 1.0, 8)
    batches[3] += 500.0
    assert not exceeds(ShownCost(MOVED, batches), ordinary, 3e-4)
    assert exceeds(ShownCost(MOVED, ordinary.batches + 20.0), ordinary, 3e-4)


def test_costs_that_persist_make_few_false_retreats(rng):
    """Nominally .25 in ten weeks; the hours of a shift are not quite independent."""
    noise = rng.normal(0.0, 1.0, 210 * SHIFT)
    costs = np.zeros(noise.size)
    for k in range(1, costs.size):
        costs[k] = 0.9 * costs[k - 1] + noise[k]
    retreat = Retreat(START, SHIFT, 3e-4)
    theta = START
    for k, cost in enumerate(costs.tolist()):
        if k >= SHIFT and k % 50 == 0:
            theta = theta + 1.0
        retreat.observe(cost, theta)
    assert retreat.count <= 1


def test_a_restored_retreat_goes_on_as_it_was(rng):
    operation = Operation(rng, lambda theta: 100.0 + 130.0 * theta)
    operation.run(1)
    operation.theta = MOVED
    operation.run(2)
    restored = Retreat(START, SHIFT, 3e-4)
    restored.load_state_dict(operation.retreat.state_dict())
    for cost in rng.normal(100.0, 50.0, 3 * SHIFT).tolist():
        assert restored.observe(cost, START) == operation.retreat.observe(cost, START)
    state = restored.state_dict()
    assert state.keys() == operation.retreat.state_dict().keys()
    assert state["best.batches"] == pytest.approx(operation.retreat.state_dict()["best.batches"])
