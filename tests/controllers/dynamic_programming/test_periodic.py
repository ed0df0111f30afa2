"""The optimum of a plant whose prices are periodic."""

from dataclasses import replace

import numpy as np
import pytest

from controllers import Quantity
from controllers.dynamic_programming import Settings, solve
from controllers.dynamic_programming.periodic import (
    PeriodicPlant,
    certify_periodic,
    chebyshev_nodes,
    minimise_polynomials,
    simulate_periodic,
    solve_periodic,
)
from controllers.errors import ModelError, OptimumError, QpError
from controllers.periodic_optimum import (
    PeriodicPolicy,
    keep_periodic,
    periodic_key,
    periodic_plant,
    read_periodic,
)
from controllers.problem import PlantProblem
from cosim import Scenario
from tests.helpers.linear_plant import SCALAR

PRICES = np.array([0.2, -0.15, 0.0, 0.1, -0.05])


def _cost(x, u, d, p):
    return SCALAR.problem.model.economic_cost(x, u, d, p) + p[1] * u[0]


def priced(prices):
    """The scalar linear plant, and a price of its action at each phase."""
    model = SCALAR.problem.model
    parameters = (*model.parameters, Quantity("price", "1", 0.0))
    problem = replace(
        SCALAR.problem, model=replace(model, parameters=parameters, economic_cost=_cost)
    )
    plant = PlantProblem(problem, SCALAR.plant.law, np.array([1.0, 0.0]))
    return PeriodicPlant(plant, np.column_stack([np.ones(len(prices)), prices]))


def riccati_gain(prices):
    """Mean cost of the optimal u = Kx + k_t of the linear plant, by the recursion of b_t.

    V_t = Px² + 2 b_t x + c_t, and u minimises Ru² + p_t u + V_{t+1}.
    """
    (((P,),), ((K,),)) = SCALAR.riccati()
    A, B, R = SCALAR.A[0, 0], SCALAR.B[0, 0], SCALAR.R[0, 0]
    S = R + B * P * B
    b = 0.0
    # Backwards, until the start is forgotten.
    for _ in range(50):
        gains = []
        for price in prices[::-1]:
            gains.append(P * SCALAR.covariance[0, 0] - (B * b + price / 2) ** 2 / S)
            b = (A + B * K) * b + K * price / 2
    return np.mean(gains)


@pytest.fixture(scope="module")
def solution():
    return solve_periodic(priced(PRICES))


def test_the_gain_is_that_of_the_riccati_equation(solution):
    exact = riccati_gain(PRICES)
    # The prices are worth a good part of the cost.
    assert exact < 0.9 * riccati_gain(0 * PRICES)
    assert solution.gain == pytest.approx(exact, rel=1e-3)
    assert solution.lower <= solution.gain <= solution.upper
    assert solution.upper - solution.lower <= 1e-3 * solution.gain


@pytest.mark.slow
def test_prices_that_stay_give_the_still_optimum():
    assert solve_periodic(priced([0.0, 0.0])).gain == pytest.approx(
        solve(SCALAR.plant, Settings()).gain, rel=1e-3
    )


@pytest.mark.slow
def test_its_policy_costs_what_was_solved(solution):
    mean, half_width = simulate_periodic(priced(PRICES), solution, paths=400, periods=100)
    assert abs(mean - solution.gain) < 2 * half_width + 1e-3 * solution.gain
    # That of another phase costs more.
    shifted = replace(solution, actions=np.roll(solution.actions, 1, axis=0))
    worse, _ = simulate_periodic(priced(PRICES), shifted, paths=400, periods=100)
    assert worse > mean + 4 * half_width


@pytest.mark.slow
def test_its_certificate_has_three_estimates(solution):
    certified = certify_periodic(priced(PRICES), Settings(), solution, paths=400, periods=100)
    names = [estimate.name for estimate in certified.certificate]
    assert names == ["solution", "refinement", "simulation"]
    for estimate in certified.certificate:
        assert estimate.value == pytest.approx(riccati_gain(PRICES), rel=5e-2)
    refinement = certified.certificate[1]
    assert refinement.value == pytest.approx(riccati_gain(PRICES), rel=1e-3)


def test_polynomials_are_minimised_within_the_box(rng):
    nodes = chebyshev_nodes(5)
    centres = rng.uniform(-1.5, 1.5, (30, 2))
    values = []
    for a in nodes:
        for b in nodes:
            values.append((a - centres[:, 0]) ** 2 + 2 * (b - centres[:, 1]) ** 2)
    minimisers, least = minimise_polynomials(np.array(values), 2)
    inside = np.clip(centres, -1.0, 1.0)
    np.testing.assert_allclose(minimisers, inside, atol=1e-9)
    expected = (inside[:, 0] - centres[:, 0]) ** 2 + 2 * (inside[:, 1] - centres[:, 1]) ** 2
    np.testing.assert_allclose(least, expected, atol=1e-9)


def test_a_policy_that_is_stored_is_that_of_the_phase(solution, monkeypatch, tmp_path):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    periodic = priced(PRICES)
    key = periodic_key(periodic, Settings())
    assert key != periodic_key(priced(-PRICES), Settings())
    stored = read_periodic(keep_periodic(key, periodic, solution), key)
    policy = PeriodicPolicy(periodic, stored)
    near = solution.grid.nearest([0.05])
    (x,) = solution.grid.points[near].tolist()
    # The first preparation is of phase 0; after a period it comes again.
    for k in [0, 1, 2, 3, 4, 0, 1]:
        policy.prepare()
        decision = policy.feedback([x])
        # Rounded to a 4096th of the actuator's range, and a thousandth of the gain.
        assert decision.action == pytest.approx(solution.actions[k, near], abs=6.0 / 8192)
        assert decision.value == pytest.approx(solution.W[k, near], abs=1e-3 * solution.gain)
    policy.reset()
    policy.prepare()
    expected = solution.actions[0, near]
    assert policy.feedback([x]).action == pytest.approx(expected, abs=6.0 / 8192)
    assert policy.feedback([99.0]).status == "clamped"
    with pytest.raises(QpError):
        policy.feedback([np.nan])
    with pytest.raises(OptimumError, match="delete it"):
        read_periodic(tmp_path / "none.npz", key)


def test_the_plant_of_a_scenario_has_its_prices():
    periodic = periodic_plant(Scenario.load("prices"))
    assert periodic.parameters.shape == (1440, 16)
    assert periodic.parameters[[0, 59, 60, 1439], -1].tolist() == [450.0, 450.0, 420.0, 600.0]


def _price(**changes):
    (table,) = Scenario.load("prices").to_dict()["signal"]
    return Scenario.load("prices").replace({"signal": [{**table, **changes}]})


@pytest.mark.parametrize(
    ("scenario", "error", "words"),
    [
        (lambda: Scenario.load("set-point"), OptimumError, "is no price"),
        (lambda: Scenario.load("forecast"), OptimumError, "measured disturbance"),
        (lambda: _price(included=500.0), OptimumError, "must be equal"),
        (lambda: _price(model="UA2"), OptimumError, "is in the dynamics"),
        (lambda: _price(model="steam"), ModelError, "has no parameter 'steam'"),
        (lambda: _price(period=86401.0), OptimumError, "whole samples"),
        (lambda: _price(period=86400.0 * 30), OptimumError, "43200 samples"),
    ],
)
def test_what_has_no_periodic_optimum_is_refused(scenario, error, words):
    with pytest.raises(error, match=words):
        periodic_plant(scenario())
