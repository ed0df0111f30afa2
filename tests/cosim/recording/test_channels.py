import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.recording.channels import Channel, run_channels, run_columns
from cosim.signals import signal_names

numbers = st.floats(-1e6, 1e6)


def channel(**options):
    return Channel("states", "x", "kPa", "#000000", **options)


@given(st.lists(numbers, min_size=1), numbers, st.floats(1e-3, 1e6))
def test_the_window_holds_all_values_seen(values, lower, width):
    low, high = channel(bounds=(lower, lower + width)).with_values(np.array(values)).window()
    assert low < min(values)
    assert max(values) < high


def test_the_window_shows_a_bound_that_is_near_and_not_one_that_is_far():
    low, high = channel(bounds=(25.0, 100.0)).with_values(np.array([24.0, 27.0, np.nan])).window()
    assert low < 24.0
    assert 27.0 < high < 30.0
    low, _ = channel(bounds=(25.0, 100.0)).with_values(np.array([26.0, 28.0])).window()
    assert low < 25.0
    low, _ = channel(bounds=(25.0, 100.0)).with_values(np.array([56.0, 58.0])).window()
    assert low > 50.0


def test_the_window_before_any_value_surrounds_the_operating_point():
    low, high = channel(bounds=(25.0, 100.0), reference=25.0).window()
    assert low < 25.0 < high < 40.0


@pytest.mark.parametrize("value", [0.0, 1e-15, 1e6])
def test_the_window_of_a_constant_has_a_width(value):
    low, high = channel().with_values(np.full(3, value)).window()
    assert low < value < high


def test_the_tail_leaves_outliers_out_of_view():
    values = np.r_[np.linspace(0.0, 1.0, 99), 1000.0]
    assert channel(tail=0.05).with_values(values).window()[1] < 2.0


def test_channels_and_columns_cover_the_trajectorys_signals(paper, units, rng):
    from tests.helpers.blocks import random_block

    channels = run_channels(paper, units)
    columns = run_columns(random_block(paper, rng))
    assert len(channels) == len(columns)
    names = [c.name for c in channels]
    assert set(signal_names(paper)) <= set(names)
    assert len(set(names)) == len(names)
