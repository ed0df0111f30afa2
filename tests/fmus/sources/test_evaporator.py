"""The equations, against an independent implementation and the known steady state."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fmus.evaporator import EVAPORATOR
from tests.helpers.paper import ALGEBRAIC, NUMBERS, evaporator

DISTURBANCES = ("X1", "F1", "T1", "T200")


def random_points(count: int, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(seed)
    low, high = np.array([5.0, 30.0]), np.array([100.0, 90.0])
    return [
        (
            rng.uniform(low, high),
            rng.uniform(100, 400, 2),
            np.array([5, 10, 40, 25]) + rng.uniform(-1, 1, 4) * [1, 2, 8, 5],
        )
        for _ in range(count)
    ]


def start(plant, x, u, d, p):
    given = {f"{name}_in": value for name, value in zip(DISTURBANCES, d, strict=True)}
    return plant.initialise(
        override=True, X2_start=x[0], P2_start=x[1], P100=u[0], F200=u[1], **given, **p
    )


def test_the_papers_numbers_are_the_defaults() -> None:
    assert {name: EVAPORATOR.by_name[name].start for name in NUMBERS} == NUMBERS


def test_outputs_and_derivatives_at_random_points(open_fmu, version: int) -> None:
    rng = np.random.default_rng(1)
    for x, u, d in random_points(30):
        p = {name: value * rng.uniform(0.9, 1.1) for name, value in NUMBERS.items()}
        plant = start(open_fmu(version), x, u, d, p)
        expected = evaporator(x, u, d, **p)
        np.testing.assert_allclose(
            plant.get(*ALGEBRAIC), [expected[n] for n in ALGEBRAIC], rtol=1e-12, atol=1e-11
        )
        np.testing.assert_allclose(
            plant.get("der(X2)", "der(P2)"), expected["rates"] / 60, rtol=1e-11, atol=1e-13
        )


WORST_CORNER = (
    np.array([100.0, 90.0]),
    np.array([100.0, 100.0]),
    np.array([4.0, 12.0, 32.0, 30.0]),
)


def test_step_is_within_the_documented_5e_10_of_a_tight_integration(open_fmu, version: int) -> None:
    p = NUMBERS
    for x, u, d in [*random_points(40, seed=2), WORST_CORNER]:
        plant = start(open_fmu(version), x, u, d, p)
        plant.step(0.0, 60.0)
        exact = solve_ivp(
            lambda t, y, u=u, d=d: evaporator(y, u, d, **p)["rates"],
            (0.0, 1.0), x, method="DOP853", rtol=1e-13, atol=1e-13,
        ).y[:, -1]  # fmt: skip
        np.testing.assert_allclose(plant.get("X2", "P2"), exact, rtol=5e-10, atol=0)


FAST = [
    {"M": 1.0},
    {"C": 0.1, "F3": 100.0},
    {"M": 1.0, "C": 0.1, "h": 1.0, "F3": 200.0},
]
"""In the ranges of the parameters, with time constants far below an integration step of 1 s."""


@pytest.mark.parametrize("fast", FAST)
@pytest.mark.parametrize("size", [60.0, 2.7])
def test_a_fast_evaporator_is_integrated_in_shorter_steps(plant, fast, size) -> None:
    p = NUMBERS | fast
    x, u, d = np.array([25.0, 50.0]), np.array([200.0, 200.0]), np.array([5.0, 10.0, 40.0, 25.0])
    start(plant, x, u, d, p)
    plant.step(0.0, size)
    exact = solve_ivp(
        lambda t, y: evaporator(y, u, d, **p)["rates"], (0.0, size / 60.0), x,
        method="Radau", rtol=1e-11, atol=1e-11,
    ).y[:, -1]  # fmt: skip
    np.testing.assert_allclose(plant.get("X2", "P2"), exact, rtol=1e-5, atol=0)


def test_integration_is_of_fourth_order(open_fmu, version: int) -> None:
    """Halving the step of a non-stiff problem divides the error by about 2⁴."""
    p = NUMBERS | {"M": 10.0}
    x, u, d = np.array([25.0, 50.0]), np.array([200.0, 200.0]), np.array([5.0, 10.0, 40.0, 25.0])
    exact = solve_ivp(
        lambda t, y: evaporator(y, u, d, **p)["rates"], (0.0, 0.2), x,
        method="DOP853", rtol=1e-13, atol=1e-13,
    ).y[0, -1]  # fmt: skip
    errors = []
    for step in (1.0, 0.5):
        plant = start(open_fmu(version), x, u, d, p | {"sampling_time": step})
        plant.step(0.0, 12.0)
        errors.append(abs(plant.get("X2")[0] - exact))
    assert 14.0 < errors[0] / errors[1] < 18.0
