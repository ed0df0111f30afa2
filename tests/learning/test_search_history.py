"""An equal search, given what is kept, comes to where the first one is, whatever was left out."""

import numpy as np
import pytest

from learning.episodes import Block, Learn, Learned
from learning.q_learning import QLearning
from learning.race import Races
from learning.search_history import SearchHistory, results
from learning.starting_point import starting_parameters
from learning.validated_search import ValidatedSearch

MEMORY = 300


@pytest.fixture
def begin(scenario, problem, monkeypatch):
    """A function that makes one and the same search anew, with short-lived pools."""
    monkeypatch.setattr(Races, "MEMORY", MEMORY)
    start = starting_parameters(problem, QLearning.Configuration())

    def make(samples=60_000):
        deviation = np.array([5.0, 5.0])
        return ValidatedSearch(
            scenario, start, deviation, samples, 0, phase=2000, block=50, blocks=4
        )

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
            history.add(request, result, search.expected)
            return
        history.add(request, result, search.expected)
        request = following


def same(first, second):
    return type(first) is type(second) and all(
        np.array_equal(a, b) for a, b in zip(first, second, strict=True)
    )


def test_what_is_kept_leads_an_equal_search_on_the_same_way(begin):
    history, states, asked = SearchHistory(MEMORY), [], []
    search = begin()
    for number, request in enumerate(requests(search, history, np.random.default_rng(1))):
        asked.append(request)
        if number % 97 == 0:
            states.append((number, history.state()))
    assert len(states) > 5
    for number, state in states:
        other, rng = begin(), np.random.default_rng(1)
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
        assert np.array_equal(other.incumbent.theta, search.incumbent.theta)
        assert other.incumbent.costs.tolist() == search.incumbent.costs.tolist()


def test_what_is_kept_does_not_grow_with_the_rounds(begin):
    history, rows = SearchHistory(MEMORY), []
    asked = requests(begin(200_000), history, np.random.default_rng(1))
    for number, _ in enumerate(asked):
        if number % 50 == 0:
            state = history.state()
            rows.append(sum(len(v) for name, v in state.items() if name.endswith("errors")))
    assert number > 2000
    assert max(rows) <= 2 * (MEMORY + 50)
    assert not any(name.endswith("predictions") for name in history.state())
