import numpy as np
import pytest

from learning.q_learning import AverageCost
from learning.step import Fit


def fit():
    metric = np.array([[2.0, 0.5], [0.5, 1.0]])
    minimiser = np.array([0.3, -0.4])
    return Fit(metric @ minimiser, minimiser, lambda: metric)


def test_discounted_target_and_untouched_fit():
    average_cost = AverageCost(0.9, 1, 10.0, 6000.0)
    assert average_cost.target(5.0, 100.0) == 95.0
    same = fit()
    assert average_cost.take(same) is same


def test_mean_cost_takes_the_step_of_c_lambda():
    average_cost = AverageCost(1.0, 1, 10.0, 6000.0)
    assert average_cost.target(6001.0, 100.0) == 101.0
    rest = average_cost.take(fit())
    assert average_cost.mean_cost == pytest.approx(6000.0 - 4.0)
    assert rest.minimiser.tolist() == [0.3, 0.0]
    assert rest.gradient == pytest.approx(rest.metric() @ rest.minimiser)
