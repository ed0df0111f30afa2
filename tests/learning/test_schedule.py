import numpy as np
import pytest

from learning.schedule import Geometric, linear


def test_a_linear_schedule_is_linear_and_then_constant():
    values = linear((10.0,), (2.0,), 100)
    assert values(0) == 10.0 and values(50) == 6.0 and values(100) == 2.0 and values(500) == 2.0


def test_without_an_end_it_is_constant():
    values = linear((10.0, 3.0), None, 100)
    assert values(0).tolist() == values(70).tolist() == [10.0, 3.0]


def test_values_at_many_samples_are_those_of_each():
    for end in (None, [9.0, -2.0]):
        for length in (0, 7):
            schedule = linear([1.0, 0.3], end, length)
            each = [schedule(k) for k in range(12)]
            assert schedule.at(np.arange(12)).tobytes() == np.array(each).tobytes()


def test_a_geometric_schedule_has_equal_ratios_and_then_stays():
    values = Geometric(0.5, 0.05, 100)
    found = [values(k) for k in range(0, 101, 10)]
    assert found[0] == 0.5 and found[-1] == pytest.approx(0.05, rel=1e-12)
    assert np.ptp(np.divide(found[1:], found[:-1])) < 1e-12
    assert values(500) == values(100)
