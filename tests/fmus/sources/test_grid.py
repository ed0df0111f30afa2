"""The time grid: how a sample is split does not matter on it, and rounded clocks find it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

STATES = ("X2", "P2")


def run(plant, points: list[float], **values: float) -> list[float]:
    plant.initialise(start=points[0], seed=3, **values)
    for begin, end in itertools.pairwise(points):
        plant.step(begin, end - begin)
    return plant.get(*STATES, "X1", "economic_cost")


@pytest.mark.parametrize("step", [1.0, 2.0, 10.0, 30.0, 120.0, 300.0])
def test_splits_on_the_grid_are_bit_identical(open_fmu, version: int, step: float) -> None:
    whole = run(open_fmu(version), [60.0 * k for k in range(11)])
    split = run(open_fmu(version), [step * k for k in range(int(600 / step) + 1)])
    assert split == whole


def test_uneven_split_on_the_grid_is_bit_identical(open_fmu, version: int) -> None:
    whole = run(open_fmu(version), [0.0, 600.0])
    split = run(open_fmu(version), [0.0, 7.0, 59.0, 60.0, 61.0, 333.0, 599.0, 600.0])
    assert split == whole


@pytest.mark.parametrize("step", [0.3, 0.7, 7.3])
def test_splits_off_the_grid_agree_to_the_integration_error(open_fmu, version, step: float) -> None:
    whole = run(open_fmu(version), [0.0, 600.0])
    split = run(open_fmu(version), [*np.arange(0.0, 600.0, step), 600.0])
    np.testing.assert_allclose(split, whole, rtol=1e-9)


def test_accumulated_clock_draws_the_same_disturbances(open_fmu, version: int) -> None:
    """t += 0.1 is off by 1e-10 s after an hour, on either side of the sampling instants."""
    plant = open_fmu(version).initialise(seed=3)
    exact = open_fmu(version).initialise(seed=3)
    time = 0.0
    for k in range(36000):
        if k % 600 == 0:
            assert plant.get("X1") == exact.get("X1")
            exact.step(k / 10, 60.0)
        plant.step(time, 0.1)
        time += 0.1
    assert time != 3600.0
    np.testing.assert_allclose(plant.get(*STATES), exact.get(*STATES), rtol=1e-9)


def test_grid_starts_at_time_zero_whatever_the_start_time(open_fmu, version: int) -> None:
    from_zero = open_fmu(version).initialise(seed=3)
    from_zero.step(0.0, 120.0)
    from_thirty = open_fmu(version).initialise(start=90.0, seed=3)
    from_thirty.step(90.0, 30.0)
    assert from_zero.get("X1") == from_thirty.get("X1")


def test_sampling_time_that_no_second_divides(open_fmu, version: int) -> None:
    sampling_time = 100.0 / 7.0
    whole = run(open_fmu(version), [0.0, 700.0], sampling_time=sampling_time)
    split = run(
        open_fmu(version), [k * sampling_time for k in range(50)], sampling_time=sampling_time
    )
    assert split == whole
