import numpy as np
import pytest

from controllers.parameters import Parameters
from learning.episodes import Block, Learn, Learned, Settle, Trial
from learning.validated_search import ValidatedSearch

SAMPLES = 20_000


def search(scenario, problem, samples=SAMPLES):
    start = Parameters.naive(problem, value_offset=6e5)
    return ValidatedSearch(
        scenario, start, np.array([10.0, 10.0]), samples, 7, phase=1000, block=100, blocks=8
    )


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
        if isinstance(request, Learn):
            self.samples += request.samples
            candidate = self.learner(request.theta, request.width)
            errors = self.rng.uniform(-1, 1, size=(500, 2)) * [2.0, 0.2]
            return Learned(candidate[None, :], errors, np.array([1.6, 1.5]), errors.std(axis=0))
        self.samples += 100
        if isinstance(request, Settle):
            self.rounds += 1
            self.draws = np.random.default_rng(self.rounds).normal(size=1000)
        elif request.begins:
            self.block = 0
        metric = None
        if isinstance(request, Trial):
            self.tried.append(request.theta)
            self.block += 1
            if request.sensitive:
                jacobian = np.zeros((2, request.theta.size))
                where = self.blocks.slices["b_l"]
                jacobian[0, where.stop - 2] = jacobian[1, where.stop - 1] = -0.05
                metric = jacobian.T @ jacobian
        draw = self.noise * self.draws[getattr(self, "block", 0)]
        far = np.full((100, 2), 60.0)
        return Block(self.cost(request.theta) + draw, 0.0, far, np.zeros((100, 2)), metric)


def run(search, plant):
    plan, results = search.plan(), []
    request = next(plan)
    while True:
        result = plant.answer(request)
        results.append(result)
        try:
            request = plan.send(result)
        except StopIteration:
            return results


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


def test_a_rule_that_knows_the_way_is_followed(scenario, problem):
    sought = search(scenario, problem, 4000)
    plant = Quadratic(scenario, sought._start)
    plant.learner = lambda theta, width: plant.best
    run(sought, plant)
    assert plant.cost(sought.incumbent.theta) == pytest.approx(6300.0, abs=0.1)


def test_the_same_results_lead_to_the_same_plan(scenario, problem):
    first, second = search(scenario, problem), search(scenario, problem)
    results = run(first, Quadratic(scenario, first._start))
    plan = second.plan()
    next(plan)
    for result in results[:-1]:
        plan.send(result)
    with pytest.raises(StopIteration):
        plan.send(results[-1])
    assert np.array_equal(first.incumbent.theta, second.incumbent.theta)


def test_only_admissible_theta_are_tried(scenario, problem):
    sought = search(scenario, problem)

    def wild(theta, width):
        theta = theta.copy()
        theta[sought._start.blocks.slices["B_l"]] = -5.0
        return theta

    plant = Quadratic(scenario, sought._start, learner=wild)
    run(sought, plant)
    for theta in plant.tried:
        matrix = sought._start.with_theta(theta)["B_l"]
        assert np.linalg.eigvalsh(matrix)[0] > 0
