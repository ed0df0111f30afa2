"""The policy search in operation, from costs made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from controllers.factories import tuned
from learning.algorithm import load_algorithm
from tests.helpers.training import bare_transition

POPULATION, EPISODE = 4, 30


@pytest.fixture(scope="module")
def start(scenario):
    return tuned(scenario).parameters


@pytest.fixture
def searched(scenario, start):
    """Give θ after one generation whose samples cost `cost(candidate, sample)`."""

    def search(cost):
        cls = load_algorithm("policy-search")
        settings = {"population": POPULATION, "episode": EPISODE}
        controller = SimpleNamespace(parameters=start, theta=start.theta)
        rule = cls(
            controller,
            scenario,
            cls.Configuration.from_dict(settings),
            POPULATION * EPISODE,
            None,
            np.random.default_rng(0),
        )
        s, a = scenario.initial_state, scenario.reference_action
        for number in range(POPULATION * EPISODE):
            due = float(cost(*divmod(number, EPISODE)))
            rule.observe(bare_transition(number, s, a, due, s))
        return np.array(rule.theta)

    return search


def test_a_stretch_counts_once_it_has_settled(searched, start, scenario):
    """What the first samples cost, as many as the horizon has, is the candidate before's."""
    horizon = scenario.controller.horizon
    settled = searched(lambda candidate, sample: candidate)
    unsettled = searched(
        lambda candidate, sample: candidate if sample >= horizon else -1000.0 * candidate
    )
    assert np.array_equal(settled, unsettled)
    assert not np.array_equal(settled, start.theta)


def test_it_follows_the_candidate_that_costs_least(searched):
    ascending = searched(lambda candidate, sample: candidate)
    descending = searched(lambda candidate, sample: -candidate)
    assert not np.allclose(ascending, descending)
