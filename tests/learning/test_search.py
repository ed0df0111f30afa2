"""The search as an algorithm on the evaporator, and what a checkpoint keeps of it."""

import numpy as np
import pytest

from controllers.parameters import Parameters
from cosim import FmuPlant
from learning.errors import ConfigurationError
from learning.loop import begin
from learning.search import Search, SearchHistory, results
from learning.search_plan import Block, Learn, Learned, PairedComparison, SearchPlan
from learning.training_run import TrainingRun

SETTINGS = {
    "none": {},
    "q-learning": {"rule_settings": {"prior_samples": 40, "step_every": 20}},
    "batch-q-learning": {"rule_settings": {"batch_size": 40}},
    "actor-critic": {"rule_settings": {"batch_size": 60}, "q_learning_first": True},
}


def learner(plant, rule, samples=1500):
    configuration = Search.Configuration.from_dict({"rule": rule, **SETTINGS[rule]})
    run = TrainingRun("search", plant.scenario, samples, 3, configuration)
    return begin(run, Search, plant)


@pytest.fixture(scope="module")
def plant(scenario):
    with FmuPlant(scenario) as plant:
        yield plant


@pytest.mark.parametrize("rule", SETTINGS)
def test_what_is_handed_over_is_the_incumbent_and_its_trials_are_greedy(plant, rule):
    made = learner(plant, rule)
    start = made.start_parameters.theta.copy()
    explored_in_trials, thetas = 0, []
    for _ in range(1500):
        explores, before = made.algorithm.explores, made.counts.explored
        made.advance()
        explored_in_trials += not explores and made.counts.explored > before
        thetas.append(made.parameters.theta)
    assert explored_in_trials == 0
    assert (made.counts.explored > 0) == (rule != "none")
    assert np.array_equal(thetas[0], start)
    assert not np.array_equal(thetas[-1], start), "the naive start is easily beaten"


def test_a_search_explores_as_its_rule_does_and_takes_its_settings():
    make = Search.Configuration.from_dict
    for rule, probability in (("none", 0.3), ("q-learning", 0.3), ("actor-critic", 1.0)):
        assert make({"rule": rule}).exploration_probability == probability
    assert (
        make({"rule": "actor-critic", "exploration_probability": 0.5}).exploration_probability
        == 0.5
    )
    chosen = make({"rule": "q-learning", "rule_settings": {"prior_width": 0.1}})
    assert chosen.rule_configuration("q-learning").prior_width == 0.1
    for settings in ({"prior_with": 1}, {"exploration_share": 1}):
        with pytest.raises(ConfigurationError):
            make({"rule": "q-learning", "rule_settings": settings})


@pytest.mark.parametrize("rule", SETTINGS)
@pytest.mark.parametrize("at", [90, 400])
def test_a_restored_search_goes_on_as_the_first_one(scenario, rule, at):
    """At 90 samples a phase of learning is open, at 400 a comparison."""
    with FmuPlant(scenario) as first, FmuPlant(scenario) as second:
        whole, resumed = learner(first, rule), learner(second, rule)
        for _ in range(at):
            whole.advance()
        whole.restart()
        second.restore(second.deserialise(first.serialise(first.snapshot())))
        resumed.restore(*whole.state())
        for _ in range(500):
            whole.advance()
            resumed.advance()
            assert np.array_equal(whole.s, resumed.s)
        assert np.array_equal(whole.controller.theta, resumed.controller.theta)
        assert np.array_equal(whole.parameters.theta, resumed.parameters.theta)


def test_the_last_comparison_begins_a_new_episode(plant):
    made, seeds = learner(plant, "none"), []
    begin_episode = made.start

    def start(s):
        seeds.append(made.counts.number)
        begin_episode(s)
        assert np.array_equal(made.s, plant.scenario.initial_state)

    made.start = start
    for _ in range(1500):
        made.advance()
    assert len(seeds) == 1
    assert 0.6 * 1500 < seeds[0] < 0.8 * 1500


MEMORY = 300


@pytest.fixture
def new_plan(scenario, problem, monkeypatch):
    """A function that makes one and the same search anew, with short-lived pools."""
    monkeypatch.setattr(PairedComparison, "MEMORY", MEMORY)
    start = Parameters.naive(problem, value_offset=6e5)

    def make(samples=60_000):
        deviation = np.array([5.0, 5.0])
        return SearchPlan(scenario, start, deviation, samples, 0, phase=2000, block=50, blocks=4)

    return make


def answer(request, rng):
    """What a plant near the lower bound, whose noise is all that differs, would give."""
    errors = rng.normal(size=(50, 2)) * [2.0, 0.5]
    if isinstance(request, Learn):
        candidate = request.theta + 0.01 * rng.normal(size=request.theta.size)
        return Learned(candidate[None, :], errors, np.array([1.6, 1.5]), errors.std(axis=0))
    sensitive = getattr(request, "sensitive", False)
    metric = None
    if sensitive:
        jacobian = rng.normal(size=(2, request.theta.size))
        metric = jacobian.T @ jacobian
    predictions = rng.normal(size=(50, 2)) + np.array([26.0, 50.0])
    return Block(6300.0 + rng.normal(), 0.0, predictions, errors, metric)


def requests(search, history, rng):
    """The plan's requests, answered as a plant would, each answer kept."""
    plan = search.plan()
    request = next(plan)
    while True:
        yield request
        result = answer(request, rng)
        try:
            following = plan.send(result)
        except StopIteration:
            history.add(request, result, search.comparison.expected)
            return
        history.add(request, result, search.comparison.expected)
        request = following


def same(first, second):
    return type(first) is type(second) and all(
        np.array_equal(a, b) for a, b in zip(first, second, strict=True)
    )


def test_what_is_kept_leads_an_equal_search_on_the_same_way(new_plan):
    history, states, asked = SearchHistory(MEMORY), [], []
    search = new_plan()
    for number, request in enumerate(requests(search, history, np.random.default_rng(1))):
        asked.append(request)
        if number % 97 == 0:
            states.append((number, history.state()))
    assert len(states) > 5
    for number, state in states:
        other, rng = new_plan(), np.random.default_rng(1)
        plan = other.plan()
        request = next(plan)
        for result in results(state):
            answer(request, rng)  # the plant's noise goes on as it went
            request = plan.send(result)
        for expected in asked[number:]:
            assert same(request, expected)
            try:
                request = plan.send(answer(request, rng))
            except StopIteration:
                break
        assert np.array_equal(other.comparison.incumbent.theta, search.comparison.incumbent.theta)
        assert (
            other.comparison.incumbent.costs.tolist() == search.comparison.incumbent.costs.tolist()
        )


def test_what_is_kept_does_not_grow_with_the_rounds(new_plan):
    history, rows = SearchHistory(MEMORY), []
    asked = requests(new_plan(200_000), history, np.random.default_rng(1))
    for number, _ in enumerate(asked):
        if number % 50 == 0:
            state = history.state()
            rows.append(sum(len(v) for name, v in state.items() if name.endswith("errors")))
    assert number > 2000
    assert max(rows) <= 2 * (MEMORY + 50)
    assert not any(name.endswith("predictions") for name in history.state())
