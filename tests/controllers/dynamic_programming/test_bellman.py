from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from controllers.dynamic_programming import Accuracy, BellmanOperator, Grid, accurate_substeps
from controllers.errors import OptimumError
from controllers.model import discretise, economic_cost
from controllers.problem import DisturbanceLaw, PlantProblem
from tests.helpers.sampling import evaporator_problem

PROBLEM = evaporator_problem()
P = PROBLEM.model.nominal_parameters
LAW = DisturbanceLaw("uniform", PROBLEM.model.nominal_disturbance, np.array([1.0, 2.0, 8.0, 5.0]))
PLANT = PlantProblem(PROBLEM, LAW, P)
GRID = Grid((np.linspace(20, 32, 13), np.linspace(40, 60, 5)))
STATE, ACTION = np.array([[25.8, 50.0]]), np.array([[226.0, 217.0]])


def operator(penalty_nodes=(20, 20, 4, 2), plant=PLANT):
    return BellmanOperator(plant, Accuracy(8, (7, 7, 2, 2), penalty_nodes))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("linear", "quadratic", "state"),
    [(1e5, 1.0, STATE), (1.0, 1e6, STATE - [[0.6, 0.0]])],
    ids=["linear", "quadratic"],
)
def test_expected_cost_and_penalty_agree_with_monte_carlo(linear, quadratic, state):
    problem = replace(
        PROBLEM,
        penalty_linear=np.full(2, linear),
        penalty_quadratic=np.full(2, quadratic),
    )
    plant = PlantProblem(problem, LAW, P)
    count = 50_000
    d = LAW.draw(np.random.default_rng(11), count)
    x, u = np.tile(state.T, (1, count)), np.tile(ACTION.T, (1, count))
    p = np.tile(P[:, None], (1, count))
    x_next = discretise(PROBLEM.model, 60.0, 8).map(count)(x, u, d.T, p).full()
    cost = economic_cost(PROBLEM.model).map(count)(x, u, d.T, p).full()[0]
    violation = np.maximum(25.0 - x_next[0], 0.0)
    penalty = linear * violation + quadratic * violation**2
    sampled = cost + penalty
    uncertain = 4 * sampled.std() / np.sqrt(count)
    assert 2e-4 < (violation > 0).mean() < 0.2
    assert penalty.mean() > 2 * uncertain, "without the penalty the test would not fail"
    value = operator(plant=plant).values(state, ACTION, GRID, np.zeros(GRID.size))[0]
    assert value == pytest.approx(sampled.mean(), abs=uncertain)


@pytest.mark.parametrize(("linear", "quadratic"), [(3.0, 0.5), (0.5, 300.0)])
def test_without_noise_the_penalty_is_that_of_the_next_state(linear, quadratic):
    problem = replace(
        PROBLEM,
        penalty_linear=np.full(2, linear),
        penalty_quadratic=np.full(2, quadratic),
    )
    nominal = PROBLEM.model.nominal_disturbance
    still = DisturbanceLaw("uniform", nominal, np.zeros(4))
    state = STATE - [[3.0, 0.0]]
    x_next = discretise(PROBLEM.model, 60.0, 8)(state[0], ACTION[0], nominal, P).full()[:, 0]
    violation = max(25.0 - x_next[0], 0.0)
    assert violation > 0.4
    cost = float(economic_cost(PROBLEM.model)(state[0], ACTION[0], nominal, P))
    expected = cost + linear * violation + quadratic * violation**2
    plant = PlantProblem(problem, still, P)
    value = operator(plant=plant).values(state, ACTION, GRID, np.zeros(GRID.size))[0]
    assert value == pytest.approx(expected, rel=1e-9)


def test_penalty_needs_and_has_more_nodes_than_the_smooth_part():
    def value(nodes):
        return operator(penalty_nodes=nodes).values(STATE, ACTION, GRID, np.zeros(GRID.size))[0]

    dense = value((64, 64, 16, 6))
    assert value((20, 20, 4, 2)) == pytest.approx(dense, abs=0.2)
    assert abs(value((7, 7, 2, 2)) - dense) > 1.0


def test_next_state_is_scipys_integration_of_the_model():
    symbols = PROBLEM.model.symbols()
    import casadi as ca

    ode = ca.Function("ode", list(symbols), [PROBLEM.model.ode(*symbols)])
    nominal = DisturbanceLaw("none", PROBLEM.model.nominal_disturbance, np.zeros(4))
    exact = solve_ivp(
        lambda t, x: ode(x, ACTION[0], nominal.nominal, P).full()[:, 0],
        (0.0, 1.0),
        STATE[0],
        rtol=1e-12,
        atol=1e-12,
    ).y[:, -1]
    substeps = accurate_substeps(PLANT, 1e-7)
    plant = BellmanOperator(
        PlantProblem(PROBLEM, nominal, P), Accuracy(substeps, (1,) * 4, (1,) * 4)
    )
    fine = Grid(tuple(np.array([x - 1e-3, x + 1e-3]) for x in exact))
    for i in range(2):
        cost = plant.values(STATE, ACTION, fine, np.zeros(fine.size))
        found = plant.values(STATE, ACTION, fine, fine.points[:, i]) - cost
        assert found == pytest.approx(exact[i], abs=2e-7)


def test_chain_is_stochastic_and_agrees_with_values():
    generator = np.random.default_rng(4)
    actions = generator.uniform(150, 300, (GRID.size, 2))
    W = generator.normal(size=GRID.size)
    bellman = operator()
    matrix, cost = bellman.chain(actions, GRID)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, rtol=1e-12)
    assert matrix.min() >= 0
    np.testing.assert_allclose(
        cost + matrix @ W, bellman.values(GRID.points, actions, GRID, W), rtol=1e-12
    )


@pytest.mark.slow
def test_model_that_no_step_integrates_is_refused():
    with pytest.raises(OptimumError):
        accurate_substeps(PlantProblem(evaporator_problem(sampling_time=1e5), LAW, P), 1e-7)
