import numpy as np
import pytest

from cosim import FmuPlant, Scenario
from cosim.reproduction.readings import OPEN, Reading, readings


def test_the_first_reading_is_the_scenario_paper():
    paper = Scenario.load("paper")
    assert readings(factorial=False)[0].scenario(paper).hash == paper.hash


def test_quick_changes_one_open_point_at_a_time():
    base = Reading().to_dict()
    for reading in readings(factorial=False)[1:]:
        assert sum(base[name] != value for name, value in reading.to_dict().items()) == 1


def test_full_has_every_combination_once():
    every = readings(factorial=True)
    assert len({reading.name for reading in every}) == len(every)
    assert len(every) == np.prod([len(values) for values in OPEN.values()])


def test_the_normal_law_has_the_predecessor_s_variances():
    scenario = Reading(law="normal").scenario(Scenario.load("paper"))
    with FmuPlant(scenario) as plant:
        plant.reset(3)
        drawn = np.array([plant.step(scenario.reference_action).disturbance for _ in range(4000)])
    np.testing.assert_allclose(drawn.var(axis=0), [1.0, 2.0, 8.0, 5.0], rtol=0.1)


@pytest.mark.parametrize("weight", OPEN["penalty_weight"])
def test_the_penalty_weight_is_the_linear_one(weight):
    scenario = Reading(penalty_weight=weight).scenario(Scenario.load("paper"))
    np.testing.assert_array_equal(scenario.penalty_linear, [weight, weight])
    np.testing.assert_array_equal(scenario.penalty_quadratic, [1.0, 1.0])
