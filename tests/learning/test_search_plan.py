"""The plan of the search on plants whose costs are known: no model, no controller, no rule."""

from itertools import pairwise

import numpy as np
import pytest

from controllers.theta import Parameters
from learning.search import SearchPlan

STRETCHES = 8


def drive(plan, answer):
    """What a generator of requests returns once each has been answered."""
    try:
        while True:
            request = next(plan)
            request.answer = answer(request)
    except StopIteration as end:
        return end.value


def told(cost, samples=0):
    """What a stretch of this mean cost tells, its predictions within the bounds and right."""
    predictions = np.full((samples, 2), 60.0)
    return {"cost": np.array([cost, 0.0]), "predictions": predictions, "errors": 0 * predictions}


class Plant:
    """Answers with the costs of each θ, known by the value of c_lambda; counts stretches."""

    def __init__(self, start, costs):
        self.where = start.blocks.slices["c_lambda"]
        self.costs, self.episodes, self.run, self.stretch = costs, [], {}, 0

    def drive(self, plan):
        return drive(plan, self.answer)

    def answer(self, request):
        name = float(request.theta[self.where][0])
        if request.mark:
            self.episodes.append(request.seed)
            cost = 0.0
        else:
            self.stretch = 0 if request.rewind else self.stretch + 1
            cost = self.costs[name][self.stretch]
            self.run[name] = self.run.get(name, 0) + 1
        return told(cost)


@pytest.fixture
def start(problem):
    return Parameters.naive(problem).replace({"c_lambda": 1.0})


@pytest.fixture
def rival(start):
    return start.replace({"c_lambda": 2.0}).theta


def comparison(scenario, start, samples=10_000):
    sizes = {"phase": 100, "stretch": 100, "stretches": STRETCHES}
    return SearchPlan(scenario, start, np.ones(2), samples, 0, **sizes)


def settled(scenario, start, costs):
    plant, made = Plant(start, costs), comparison(scenario, start)
    plant.drive(made.renew(STRETCHES))
    return plant, made


def test_a_winner_has_run_all_stretches(scenario, start, rival):
    noise = np.arange(STRETCHES) * 5.0
    plant, made = settled(scenario, start, {1.0: 100.0 + noise, 2.0: 99.0 + noise})
    assert plant.drive(made.compare(rival))
    assert np.array_equal(made.incumbent.theta, rival)
    assert plant.run[2.0] == STRETCHES
    assert made.spent == 100 * (1 + 2 * STRETCHES)


def test_a_loser_is_given_up_at_once(scenario, start, rival):
    plant, made = settled(scenario, start, {1.0: [100.0] * STRETCHES, 2.0: [101.0] + [0.0] * 7})
    assert not plant.drive(made.compare(rival))
    assert np.array_equal(made.incumbent.theta, start.theta)
    assert plant.run[2.0] == 1


def test_patience_lets_a_rival_mend_what_it_was_left_with(scenario, start, rival):
    """As a θ must that begins where another one let a slow state drift to."""
    drifting, mending = 100.0 + 10.0 * np.arange(STRETCHES), 110.0 - 5.0 * np.arange(STRETCHES)
    plant, made = settled(scenario, start, {1.0: drifting, 2.0: mending})
    assert not plant.drive(made.compare(rival))
    assert plant.drive(made.compare(rival, patient=True))


def test_the_final_leaves_the_cheapest_and_begins_anew(scenario, start, rival):
    third = start.replace({"c_lambda": 3.0}).theta
    costs = {1.0: 100.0 + np.arange(STRETCHES), 2.0: [1e6] * STRETCHES, 3.0: [99.0] * STRETCHES}
    plant, made = Plant(start, costs), comparison(scenario, start)
    plant.drive(made.final([rival, third], STRETCHES, 17))
    assert plant.episodes == [17]
    assert np.array_equal(made.incumbent.theta, third)
    assert plant.run[2.0] == 1, "given up where it cannot win any more"


@pytest.mark.parametrize(
    ("block", "value"), [("x_l", [101.0, 40.0]), ("x_u", [24.0, 80.0]), ("b_l", [np.nan, 0, 0, 0])]
)
def test_a_theta_that_no_controller_takes_is_not_tried(scenario, start, block, value):
    made = comparison(scenario, start)
    theta = start.theta.copy()
    theta[start.blocks.slices[block]] = value
    assert made.admissible(theta) is None


def test_the_final_leaves_the_start_only_for_what_is_cheaper_by_a_standard_error(
    scenario, start, rival
):
    lucky = np.where(np.arange(STRETCHES) == 0, -2.0, 0.25)
    for gain, leaves in ((lucky, False), (np.full(STRETCHES, -1.0), True)):
        plant, made = settled(scenario, start, {1.0: [100.0] * STRETCHES, 2.0: 100.0 + gain})
        plant.drive(made.final([rival], STRETCHES, 17))
        assert np.array_equal(made.incumbent.theta, rival if leaves else start.theta)


class Bowl(Plant):
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

    def answer(self, request):
        return told(0.0 if request.mark else self.cost(request.theta))


@pytest.fixture
def far(problem):
    naive = Parameters.naive(problem).replace({"c_lambda": 6e5})
    return naive.replace({"x_l": naive["x_l"] + [2.5, 0.0], "b_l": [1.0, -2.0, 30.0, 4.0]})


@pytest.fixture
def lines(scenario, far):
    sizes = {"phase": 800, "stretch": 100, "stretches": STRETCHES}
    return SearchPlan(scenario, far, np.array([10.0, 10.0]), 100_000, 0, **sizes)


def minimiser(parameters):
    return np.linalg.solve(parameters["B_l"], parameters["b_l"])


def test_the_inputs_weights_are_found_each_with_its_own_back_off(lines, far):
    """With the back-off of before, a tenth of the weight would cost more: 30 > 0."""
    plant = Bowl(far, 1e-2)
    same = lines._weighted(0.1)
    assert plant.cost(same) > plant.cost(far.theta)
    plant.drive(lines.renew(STRETCHES))
    assert plant.drive(lines._rescale(-1.0)) == -1.0
    found = far.with_theta(lines.incumbent.theta)
    assert np.diag(found["B_l"]) == pytest.approx([1.0, 1.0, 1e-2, 1e-2])
    assert found["x_l"][0] == pytest.approx(25.5, abs=0.5)
    assert minimiser(found) == pytest.approx(minimiser(far))
    assert 0 < lines.least < 1e-2, "smaller weights are admissible from now on"


SAMPLES = 20_000


def search(scenario, problem, samples=SAMPLES):
    start = Parameters.naive(problem).replace({"c_lambda": 6e5})
    sizes = {"phase": 1000, "stretch": 100, "stretches": 8}
    return SearchPlan(scenario, start, np.array([10.0, 10.0]), samples, 7, **sizes)


class Quadratic:
    """A plant whose mean cost is ‖(θ−θ*)/σ‖² on some entries, with noise common to a round."""

    def __init__(self, scenario, start, *, noise=5.0, learner=None, seed=0):
        self.scenario, self.blocks = scenario, start.blocks
        self.rng = np.random.default_rng(seed)
        self.best = start.replace({"x_l": start["x_l"] + [2.4, 0.0]}).theta.copy()
        self.best[start.blocks.slices["b_l"]] = [3.0, 0.0, -20.0, 10.0]
        self.noise, self.learner = noise, learner or (lambda theta, width: theta)
        self.samples, self.rounds, self.tried = 0, 0, []

    def cost(self, theta):
        slices = self.blocks.slices
        bound = theta[slices["x_l"]] - self.best[slices["x_l"]]
        slope = (theta[slices["b_l"]] - self.best[slices["b_l"]]) / 10.0
        return 6300.0 + 30.0 * float(bound @ bound) + 10.0 * float(slope @ slope)

    def answer(self, request):
        self.samples += request.length
        if request.learns:
            candidate = self.learner(request.theta, request.width or 1.0)
            errors = self.rng.uniform(-1, 1, size=(500, 2)) * [2.0, 0.2]
            deviations = np.array([[1.6, 1.5], errors.std(axis=0)])
            return {"candidates": candidate[None], "errors": errors, "deviations": deviations}
        if request.mark:
            self.rounds += 1
            self.draws = np.random.default_rng(self.rounds).normal(size=1000)
        elif request.rewind:
            self.stretch = 0
        if not request.mark:
            self.tried.append(request.theta)
            self.stretch += 1
        draw = self.noise * self.draws[getattr(self, "stretch", 0)]
        answer = told(self.cost(request.theta) + draw, 100)
        if request.measure is not None:
            jacobian = np.zeros((2, request.theta.size))
            where = self.blocks.slices["b_l"]
            jacobian[0, where.stop - 2] = jacobian[1, where.stop - 1] = -0.05
            answer["metric"] = jacobian.T @ jacobian
        return answer


def run(search, plant):
    drive(search.plan(), plant.answer)


def test_line_searches_alone_come_near_the_best(scenario, problem):
    sought = search(scenario, problem, 40_000)
    plant = Quadratic(scenario, sought._start)
    before = plant.cost(sought._start.theta)
    run(sought, plant)
    assert plant.cost(sought.incumbent.theta) - 6300.0 < 0.05 * (before - 6300.0)


def test_the_samples_are_counted_and_never_exceeded(scenario, problem):
    sought = search(scenario, problem)
    plant = Quadratic(scenario, sought._start)
    run(sought, plant)
    # The last race ends early where nothing comes near the incumbent.
    assert 0.9 * (1 - sought.FINAL) * SAMPLES < plant.samples <= SAMPLES
    assert plant.samples == sought.spent


@pytest.mark.parametrize("seed", range(3))
def test_a_rule_that_only_does_harm_loses_nothing(scenario, problem, seed):
    sought = search(scenario, problem)
    rng = np.random.default_rng(seed)

    def harm(theta, width):
        return theta + width * rng.normal(size=theta.size)

    plant = Quadratic(scenario, sought._start, learner=harm, seed=seed)
    sought.incumbent.theta = plant.best.copy()
    sought._start = sought._start.with_theta(plant.best)
    run(sought, plant)
    assert plant.cost(sought.incumbent.theta) < 6300.0 + 0.1


def test_what_is_reported_has_won(scenario, problem):
    sought = search(scenario, problem, 40_000)
    plant = Quadratic(scenario, sought._start, noise=0.0)
    incumbents = [sought.incumbent.theta]

    def answer(request):
        incumbents.append(sought.incumbent.theta)
        return plant.answer(request)

    drive(sought.plan(), answer)
    incumbents.append(sought.incumbent.theta)
    costs = [plant.cost(theta) for theta in incumbents]
    changes = sum(not np.array_equal(one, other) for one, other in pairwise(incumbents))
    assert changes > 3
    assert (np.diff(costs) <= 0).all(), "without noise no winner is dearer than what it beat"
