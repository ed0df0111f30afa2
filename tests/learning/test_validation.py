import numpy as np

from controllers.rti import RtiNmpc
from cosim import FmuPlant, simulate
from learning.validation import Validation


def test_a_candidate_replaces_the_incumbent_only_if_it_is_better(scenario, problem, parameters):
    def at(bound):
        return parameters.replace({"x_l": [bound, 40.0]}).theta

    def controller(theta):
        return RtiNmpc(problem, parameters.with_theta(theta))

    with FmuPlant(scenario) as plant:
        validation = Validation(plant, controller, 7, 80)
        costs = {b: simulate(plant, controller(at(b)), 80, 7).summary()["J"] for b in (25, 27, 26)}
        assert costs[27] < costs[26] < costs[25]
        assert validation.consider(at(25)) == (True, costs[25])
        assert validation.consider(at(27)) == (True, costs[27])
        assert validation.consider(at(26)) == (False, costs[26])
        assert validation.consider(at(27)) == (False, costs[27])
    assert np.array_equal(validation.theta, at(27))
    assert (validation.samples, validation.accepted) == (3 * 80, 1), "the incumbent is known"
