"""The search on a loop that can be computed: x_k = x_l + κσ + noise, stage cost rising with it.

And the rule that runs it on the plant.
"""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from controllers.economic import tune
from controllers.theta import Parameters
from learning.back_off import BackOffConfiguration, BackOffSearch
from learning.log import to_csv
from learning.prediction_errors import OneStepModel
from learning.training import run_training
from tests.helpers.training import killed_and_resumed, make_run


class Segment(NamedTuple):
    """A segment that the search asked for, and whether its round led beyond what was run."""

    theta: np.ndarray
    seed: int
    length: int
    led_beyond: bool


class Loop:
    """States ride their learned lower bound, or the upper one in the second, with known noise."""

    def __init__(self, problem, scenario, both=False):
        self.problem, self.scenario, self.both = problem, scenario, both
        self.model = OneStepModel(scenario)
        self.change = lambda sample, rng: None

    def run(self, start, budget=8000):
        settings = BackOffConfiguration.from_dict({})
        search = BackOffSearch(start, self.scenario, budget, np.random.default_rng(1), settings)
        self.segments = []
        while not search.has_ended:
            candidate, seed = search.trial, search.seed
            rng, length, ended = np.random.default_rng(seed), 0, False
            while not ended:
                sample = self.transition(candidate, rng)
                self.change(sample, rng)
                ended = search.observe(sample)
                length += 1
            self.segments.append(Segment(candidate.theta, seed, length, search.led_beyond))
        return search

    def transition(self, candidate, rng):
        reference = self.problem.reference_state
        noise = rng.uniform(-1.0, 1.0, 2) * [1.0, 0.2]
        low, high = candidate["x_l"], candidate["x_u"]
        s = np.array([low[0] + noise[0], high[1] + noise[1] if self.both else reference[1]])
        gradient = np.zeros(candidate.blocks.size)
        gradient[candidate.blocks.slices["x_l"].start] = 1.0
        if self.both and len(self.segments) > 0:
            gradient[candidate.blocks.slices["x_u"].start + 1] = -1.0
        a = self.problem.reference_action
        predicted = self.model.predict(s, a, self.model.parameters(candidate))[0]
        return SimpleNamespace(
            s=s,
            a=a,
            next_s=predicted + rng.uniform(-1.0, 1.0, 2) * [1.0, 0.2],
            stage_cost=6000.0 + 50.0 * (s[0] - 25.0) - 10.0 * (s[1] - 80.0),
            next_penalty=0.0,
            solution=SimpleNamespace(value_gradient=gradient),
        )


@pytest.fixture
def start(problem):
    return Parameters.naive(problem)


def test_the_least_cost_of_a_known_loop_is_found(problem, scenario, start):
    loop = Loop(problem, scenario)
    search = loop.run(start)
    assert not any(segment.led_beyond for segment in loop.segments)
    # 50 = 1e5·P(noise < −δ) at the optimum, so δ = 1 − 1e-3.
    assert search.theta["x_l"] == pytest.approx([25.999, 40.0], abs=0.01)
    assert np.array_equal(search.theta["x_u"], start["x_u"])
    assert sum(segment.length for segment in loop.segments) <= 8000


def test_a_bound_that_binds_once_another_is_backed_off_is_searched(problem, scenario, start):
    loop = Loop(problem, scenario, both=True)
    search = loop.run(start, 10000)
    assert search.theta["x_l"][0] == pytest.approx(25.999, abs=0.02)
    assert search.theta["x_u"][1] == pytest.approx(79.8, abs=0.01)


def test_a_start_that_is_backed_off_too_far_is_taken_back(problem, scenario, start):
    cautious = start.replace({"x_l": [28.0, 40.0]})
    search = Loop(problem, scenario).run(cautious)
    assert search.theta["x_l"][0] == pytest.approx(25.999, abs=0.03)


def test_without_an_active_bound_the_start_stands(problem, scenario, start):
    loop = Loop(problem, scenario)
    loop.change = lambda sample, rng: sample.solution.value_gradient.fill(0.0)
    assert np.array_equal(loop.run(start).theta.theta, start.theta)


def test_the_candidates_of_a_round_meet_the_same_noise(problem, scenario, start):
    loop = Loop(problem, scenario)
    loop.run(start, 800)
    seeds = [segment.seed for segment in loop.segments]
    assert len(set(seeds)) == 3
    assert seeds == sorted(seeds, key=seeds.index), "a round's candidates follow each other"
    assert [seeds.count(seed) for seed in dict.fromkeys(seeds)] == [3, 3, 2]


def test_no_true_bound_is_loosened_and_on_a_plateau_nothing_moves(problem, scenario, start):
    """The upper bound of P2 is active here, and what is kept of it changes no cost."""
    loop = Loop(problem, scenario, both=True)

    def indifferent(sample, rng):
        sample.s = np.array([30.0, 60.0]) + rng.uniform(-1.0, 1.0, 2)
        sample.stage_cost = 6000.0 * (1 + 1e-12 * rng.standard_normal())

    loop.change = indifferent
    search = loop.run(start, 4000)
    for segment in loop.segments:
        tried = start.with_theta(segment.theta)
        assert (tried["x_l"] >= scenario.state_lower).all()
        assert (tried["x_u"] <= scenario.state_upper).all()
    assert not search.kappa.any(), search.kappa
    assert np.array_equal(search.theta["x_l"], start["x_l"])
    assert np.array_equal(search.theta["x_u"], start["x_u"])


def test_the_end_of_what_was_seen_is_not_taken_for_the_best(problem, scenario, start):
    """A cost that falls with κ without end leaves, round by round, a back-off that was run."""
    loop = Loop(problem, scenario)

    def falling(sample, rng):
        sample.stage_cost = 6000.0 - 10.0 * sample.s[0]

    loop.change = falling
    search = loop.run(start, 4000)
    run = {segment.theta[start.blocks.slices["x_l"]][0] for segment in loop.segments}
    assert search.theta["x_l"][0] in run and search.kappa[0] >= 4.0
    led_beyond = [segment.led_beyond for segment in loop.segments]
    assert sum(led_beyond) == 3 and led_beyond[-1]


def short_run(scenario="paper", **changes):
    every = {"log_every": 50, "evaluate_every": 450, "checkpoint_every": 50}
    values = {"samples": 450, "seed": 3, "start": "tuned", "evaluation_steps": 20}
    return make_run("backoff", scenario, **{**values, **every, **changes})


@pytest.mark.slow
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(tmp_path):
    run = short_run()
    whole = run_training(run)
    resumed = killed_and_resumed(run, tmp_path, 250)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert (whole.plant_samples, whole.status) == (450, "finished")


@pytest.mark.slow
def test_the_last_digits_of_the_start_choose_nothing(problem, tmp_path):
    """As those of the tuned θ, which a conic solver gives to 1e-10."""
    J, tuned, rng = [], tune(problem).parameters, np.random.default_rng(0)
    for size in (0.0, 1e-10):
        theta = tuned.theta * (1 + size * rng.uniform(-1, 1, tuned.theta.size))
        start = tuned.with_theta(theta).save(tmp_path / "start.toml")
        J.append(run_training(short_run("fouled", samples=2000, start=str(start))).J)
    assert J[1] == pytest.approx(J[0], rel=1e-6)
