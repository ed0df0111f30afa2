"""The rules in other units of states, inputs and cost: the same policy, sample by sample."""

import dataclasses

import numpy as np
import pytest

from controllers import reactor
from controllers.errors import ModelError
from controllers.factories import tuned
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from cosim import Scenario
from learning import ActorCritic, BatchQLearning, QLearning
from learning.backed_off import add_reserve, back_off
from learning.training_run import starting_parameters
from tests.helpers.other_units import ACTION, COST, STATE, NoisyModel, factors, problems, recounted
from tests.helpers.other_zeros import COUNTINGS
from tests.helpers.training import looped

SAMPLES = 160
SETTINGS = {
    QLearning: {"prior_samples": 100, "step_every": 20},
    BatchQLearning: {"first_batch": 100, "batch_size": 50},
    ActorCritic: {"batch_size": 100},
}


def starts(scenario, configuration):
    """θ in both countings, with the slack weights that each problem is given of itself.

    The naive B = I counts in the plant's units, as in the paper; here it is recounted.
    """
    own, other = (starting_parameters(problem, configuration) for problem in problems(scenario))
    recounting = factors(own.blocks)
    for name in ("w_sigma", "W_sigma", "c_lambda"):
        where = own.blocks.slices[name]
        assert other.theta[where] == pytest.approx(recounting[where] * own.theta[where], rel=1e-12)
    flat = own.replace({"x_l": own["x_l"] + 0.5, "B_l": np.diag([1.0, 1.0, 3e-3, 3e-3])})
    return flat, other.with_theta(recounting * flat.theta)


def learnt(scenario, cls, start, units):
    """θ and actions of a run of the rule alone."""
    configuration = cls.Configuration.from_dict(SETTINGS[cls])
    controller = RtiNmpc(Problem.from_scenario(scenario), start)
    plant = NoisyModel(scenario, *units)
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
def test_a_rule_learns_the_same_policy_in_other_units(scenario, cls):
    own_start, other_start = starts(scenario, cls.Configuration())
    own, actions, corrected = learnt(scenario, cls, own_start, (1.0, 1.0, 1.0))
    other, recounted_actions, other_corrected = learnt(
        recounted(scenario), cls, other_start, (STATE, ACTION, COST)
    )
    assert np.abs(own.theta - own_start.theta).max() > 0, "the rule must have learnt"
    assert recounted_actions / ACTION == pytest.approx(actions, rel=1e-6)
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
    ],
)
def test_the_first_days_back_offs_do_not_depend_on_units_or_their_zeros(name):
    """No quantity is guessed from the zero of its unit: 10 % of 350 K is not 10 % of 77 °C."""
    counting = COUNTINGS[name]
    own = Scenario.load(name)
    other = counting.scenario(own, f"tests.helpers.other_zeros:{name}_model")
    back_offs = []
    for counted in (own, other):
        start = tuned(counted).parameters
        found = back_off(start, counted, samples=700)
        found = add_reserve(found, counted, samples=200)
        both = [found["x_l"] - start["x_l"], start["x_u"] - found["x_u"]]
        back_offs.append(np.concatenate(both))
    assert (back_offs[0] > 0).any()
    factors = np.tile(counting.states[0], 2)
    assert back_offs[1] / factors == pytest.approx(back_offs[0], rel=1e-4, abs=1e-7)


def test_a_temperature_without_a_magnitude_is_refused():
    own = reactor.model()
    feed, temperature = own.disturbances
    unknown = dataclasses.replace(temperature, magnitude=None)
    model = dataclasses.replace(own, disturbances=(feed, unknown))
    with pytest.raises(ModelError, match="Tf is a temperature in K"):
        _ = model.disturbance_magnitudes
