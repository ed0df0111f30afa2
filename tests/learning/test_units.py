"""The rules in other units of states, inputs and cost: the same policy, sample by sample."""

import numpy as np
import pytest

from controllers.problem import Problem
from controllers.rti import RtiNmpc
from learning import ActorCritic, BatchQLearning, QLearning
from learning.training_run import starting_parameters
from tests.helpers.other_units import ACTION, COST, STATE, NoisyModel, factors, problems, recounted
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
