import numpy as np
import pytest

from cosim.core.statistics import Estimate
from learning.verdict import cost_difference, verdict


@pytest.mark.parametrize(
    ("difference", "expected"),
    [
        (Estimate(-2.0, (-3.0, -1.0)), "better"),
        (Estimate(-2.0, (-5.0, 1.0)), "no difference shown"),
        (Estimate(0.0, (0.0, 0.0)), "no difference shown"),
        (Estimate(2.0, (1.0, 3.0)), "worse: the start was kept"),
        (Estimate(-2.0, None), "no difference shown"),
        (Estimate(np.inf, None), "worse: the start was kept"),
        (Estimate(np.nan, None), "worse: the start was kept"),
    ],
)
def test_the_whole_interval_must_lie_on_one_side(difference, expected):
    assert verdict(difference) == expected


def test_the_difference_is_paired_over_the_seeds():
    start = np.array([10.0, 500.0, 90.0])
    difference = cost_difference(start - [1.0, 2.0, 3.0], start)
    # Student's quantile for two degrees of freedom, and a standard error of 1/√3.
    assert difference.value == pytest.approx(-2.0)
    assert difference.interval == pytest.approx((-2 - 4.3027 / 3**0.5, -2 + 4.3027 / 3**0.5), 1e-4)
