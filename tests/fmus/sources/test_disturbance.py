"""The laws of the disturbances, and the switches that replace them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

NAMES = ("X1", "F1", "T1", "T200")
NOMINAL = np.array([5.0, 10.0, 40.0, 25.0])
RANGE = np.array([1.0, 2.0, 8.0, 5.0])


def draws(plant, samples: int, **values: float) -> np.ndarray:
    """Realised disturbances (samples, 4) at the start of each sample."""
    plant.initialise(P100=200.0, F200=200.0, **values)
    rows = []
    for k in range(samples):
        rows.append(plant.get(*NAMES))
        plant.step(60.0 * k, 60.0)
    return np.array(rows)


def test_uniform_law_fills_nominal_plus_minus_range(plant) -> None:
    z = (draws(plant, 2000, seed=1) - NOMINAL) / RANGE
    assert np.all(np.abs(z) <= 1.0)
    assert all(stats.kstest(column, "uniform", (-1, 2)).pvalue > 1e-3 for column in z.T)


def test_normal_law_has_the_range_as_standard_deviation(plant) -> None:
    z = (draws(plant, 2000, seed=2, law=2) - NOMINAL) / RANGE
    assert all(stats.kstest(column, "norm").pvalue > 1e-3 for column in z.T)


@pytest.mark.parametrize("law", [1, 2])
def test_disturbances_are_uncorrelated_among_each_other_and_in_time(plant, law: int) -> None:
    z = draws(plant, 2000, seed=3, law=law)
    pairs = np.hstack([z[1:], z[:-1]])
    off_diagonal = np.corrcoef(pairs.T) - np.eye(8)
    assert np.max(np.abs(off_diagonal)) < 4.5 / np.sqrt(1999)


def test_normal_draws_are_box_and_muller_of_the_uniform_ones(open_fmu, version: int) -> None:
    uniform = (draws(open_fmu(version), 20, seed=4) - NOMINAL) / RANGE
    normal = (draws(open_fmu(version), 20, seed=4, law=2) - NOMINAL) / RANGE
    u = (uniform + 1) / 2
    for first in (0, 2):
        radius = np.sqrt(-2 * np.log1p(-u[:, first]))
        angle = 2 * np.pi * u[:, first + 1]
        expected = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        np.testing.assert_allclose(normal[:, first : first + 2], expected, rtol=0, atol=1e-12)


def test_override_takes_the_given_disturbances_even_when_stochastic(plant) -> None:
    plant.initialise(override=True, X1_in=6.0, F1_in=9.0, T1_in=41.0, T200_in=22.0)
    assert plant.get(*NAMES) == [6.0, 9.0, 41.0, 22.0]
    plant.step(0.0, 60.0)
    plant.set(X1_in=4.0)
    assert plant.get("X1") == [4.0]


def test_override_of_the_recorded_disturbances_repeats_the_trajectory(open_fmu, version) -> None:
    recorded = open_fmu(version).initialise(seed=9)
    replayed = open_fmu(version).initialise(override=True, seed=1)
    for k in range(20):
        given = dict(zip((f"{n}_in" for n in NAMES), recorded.get(*NAMES), strict=True))
        replayed.set(**given)
        recorded.step(60.0 * k, 60.0)
        replayed.step(60.0 * k, 60.0)
        assert recorded.get("X2", "P2") == replayed.get("X2", "P2")


def test_draws_are_held_and_right_continuous(plant) -> None:
    plant.initialise(seed=6)
    first = plant.get("X1")
    plant.step(0.0, 59.0)
    assert plant.get("X1") == first
    plant.step(59.0, 1.0)
    assert plant.get("X1") != first


def test_the_laws_number_is_the_law_where_it_is_given(open_fmu) -> None:
    """FMI 2.0's tools that set no enumeration; 0 leaves it to the enumeration."""
    rows = [
        open_fmu(2).initialise(seed=3, **laws).run(5)
        for laws in ({"law": 2}, {"law_number": 2}, {"law": 1, "law_number": 2}, {"law": 1})
    ]
    assert rows[0] == rows[1] == rows[2] != rows[3]
