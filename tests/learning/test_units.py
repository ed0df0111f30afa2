"""Starts and rules where all is counted in other units, from other zeros: the same policy."""

import dataclasses

import numpy as np
import pytest

from controllers import heater, reactor
from controllers.economic import tune
from controllers.errors import ModelError
from controllers.estimator import EXPECTED_DISTURBANCE
from controllers.factories import tuned
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from cosim import Scenario
from learning import ActorCritic, BatchQLearning, QLearning
from learning.backed_off import add_reserve, back_off
from learning.training_run import starting_parameters
from tests.helpers.other_zeros import COUNTINGS, NoisyModel
from tests.helpers.training import looped

GUESSES = {"unstable-reactor": 0.02}
"""Deviations of the guessed noise other than the default, as shares of the magnitudes.

At the default the loop of `unstable-reactor` runs away in the search. What is found then depends
on rounding, in its own units too.
"""
SAMPLES = 160
SETTINGS = {
    QLearning: {"prior_samples": 100, "step_every": 20},
    BatchQLearning: {"first_batch": 100, "batch_size": 50},
    ActorCritic: {"batch_size": 100},
}


def starts(scenario, counting, configuration):
    """θ in both countings, with the slack weights that each problem is given of itself.

    The naive B = I counts in the plant's units, as in the paper; here it is recounted.
    """
    own, other = (
        starting_parameters(problem, configuration) for problem in counting.problems(scenario)
    )
    recounting = counting.factors(own.blocks)
    for name in ("w_sigma", "W_sigma", "c_lambda"):
        where = own.blocks.slices[name]
        assert other.theta[where] == pytest.approx(recounting[where] * own.theta[where], rel=1e-12)
    flat = own.replace({"x_l": own["x_l"] + 0.5, "B_l": np.diag([1.0, 1.0, 3e-3, 3e-3])})
    return flat, counting.theta(flat, other.blocks)


def learned(scenario, cls, start, counting=None):
    """θ and actions of a run of the rule alone, and how many steps definiteness corrected."""
    configuration = cls.Configuration.from_dict(SETTINGS[cls])
    controller = RtiNmpc(Problem.from_scenario(scenario), start)
    plant = NoisyModel(scenario, counting)
    loop = looped(cls, plant, controller, configuration, SAMPLES, exploration=1, seed=3)
    rule = loop.algorithm
    actions, corrected = [], 0
    for _ in range(SAMPLES):
        sample, _ = loop.next()
        actions.append(sample.solution.action)
        if (update := rule.observe(sample)) is not None:
            corrected += update.corrected
            loop.renew()
    return controller.parameters, np.array(actions), corrected


@pytest.mark.parametrize("cls", SETTINGS)
def test_a_rule_learns_the_same_policy_in_other_units_from_other_zeros(scenario, cls):
    counting = COUNTINGS["paper"]
    own_start, other_start = starts(scenario, counting, cls.Configuration())
    own, actions, corrected = learned(scenario, cls, own_start)
    other, other_actions, other_corrected = learned(
        counting.scenario(scenario), cls, other_start, counting
    )
    assert np.abs(own.theta - own_start.theta).max() > 0, "the rule must have learned"
    assert counting.here("actions", other_actions) == pytest.approx(actions, rel=1e-6)
    way = (own.theta - own_start.theta) / own.blocks.scale
    other_way = (other.theta - other_start.theta) / other.blocks.scale
    assert other_way == pytest.approx(way, abs=1e-5 * np.abs(way).max())
    assert corrected == other_corrected


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("paper", marks=pytest.mark.slow),
        "reactor",
        pytest.param("tanks", marks=pytest.mark.slow),
        pytest.param("dead-time", marks=pytest.mark.slow),
        pytest.param("unstable-reactor", marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore::controllers.errors.TuningWarning")
def test_the_first_days_back_offs_do_not_depend_on_units_or_their_zeros(name):
    """No quantity is guessed from the zero of its unit: 10 % of 350 K is not 10 % of 77 °C."""
    counting = COUNTINGS[name]
    own = Scenario.load(name)
    other = counting.scenario(own)
    back_offs = []
    deviation = GUESSES.get(name, EXPECTED_DISTURBANCE)
    for counted in (own, other):
        start = tuned(counted).parameters
        found = back_off(start, counted, deviation, samples=700)
        found = add_reserve(found, counted, deviation, samples=200)
        both = [found["x_l"] - start["x_l"], start["x_u"] - found["x_u"]]
        back_offs.append(np.concatenate(both))
    assert (back_offs[0] > 0).any()
    units = np.tile(counting.states[0], 2)
    assert back_offs[1] / units == pytest.approx(back_offs[0], rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("name", COUNTINGS)
@pytest.mark.filterwarnings("ignore::controllers.errors.TuningWarning")
def test_the_tuned_cost_is_the_same_in_other_units_from_other_zeros(name):
    counting = COUNTINGS[name]
    preset, *_ = name.split(" ")
    own, other = (tune(problem) for problem in counting.problems(Scenario.load(preset)))
    assert (own.addition is None) == (other.addition is None)
    expected = counting.theta(own.parameters, other.parameters.blocks)
    for block in ("B_l", "b_l", "B_Vf", "b_Vf", "B_lambda", "b_lambda"):
        where = own.parameters.blocks.slices[block]
        # Over the units, so that each entry is compared with the largest of its block.
        factors = counting.factors(own.parameters.blocks)[where]
        mine = expected.theta[where] / factors
        theirs = other.parameters.theta[where] / factors
        # The conic solver stops at 1e-8 of the condition number, which leaves the Hessian this.
        assert theirs == pytest.approx(mine, abs=1e-4 * np.abs(mine).max()), block


@pytest.mark.filterwarnings("ignore::controllers.errors.TuningWarning")
def test_a_vertex_whose_curvature_decides_nothing_is_told():
    """α is zero there, and a cost divided by a solver's rounding would have no size."""
    problem = Problem.from_scenario(Scenario.load("dead-time"))
    addition = tune(problem).addition
    assert addition is not None
    assert addition.size == 0.0
    assert "vertex" in addition.reason


@pytest.mark.parametrize("deviation", [0.0, -1.0, np.nan])
def test_a_deviation_that_is_not_positive_is_refused(deviation):
    own = heater.model()
    content, temperature = own.states
    changed = dataclasses.replace(content, deviation=deviation)
    with pytest.raises(ModelError, match="the deviation of M must be a positive number"):
        dataclasses.replace(own, states=(changed, temperature))


def test_a_temperature_without_a_magnitude_is_refused():
    own = reactor.model()
    feed, temperature = own.disturbances
    unknown = dataclasses.replace(temperature, magnitude=None)
    model = dataclasses.replace(own, disturbances=(feed, unknown))
    with pytest.raises(ModelError, match="Tf is a temperature in K"):
        _ = model.disturbance_magnitudes
