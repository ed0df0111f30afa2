"""The economic tuning of costs that no convex one equals: linear costs, vertices, saddles."""

import warnings
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import linprog

from controllers import Model, Problem, Quantity, RtiNmpc
from controllers.economic import least_addition, rotation, tune
from controllers.errors import TuningWarning
from controllers.model import discretise

pytestmark = pytest.mark.filterwarnings("ignore::controllers.errors.TuningWarning")

SAMPLING_TIME = 1.0


def linear_plant(seed, bilinear=0.0):
    """A random stable plant x' = Gx + Hu (+ bilinear terms), a linear cost and bounds about 0."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    rates = rng.normal(size=(n, n))
    fastest = np.linalg.eigvals(rates).real.max()
    rates -= (fastest + rng.uniform(0.1, 0.6)) * np.eye(n)
    inputs = rng.normal(size=(n, m))
    prices = rng.normal(size=n + m)
    # Units that differ by decades.
    sizes = 10.0 ** rng.integers(-2, 3, size=n + m)
    x_size, u_size = sizes[:n], sizes[n:]
    rates = rates * x_size[:, None] / x_size
    inputs = inputs * x_size[:, None] / u_size
    prices = prices / sizes

    bent = bilinear * rng.normal(size=(n, m)) / u_size

    def ode(x, u, d, p):
        products = ca.mtimes(ca.DM(bent), u) * x
        return ca.mtimes(ca.DM(rates), x) + ca.mtimes(ca.DM(inputs), u) + products

    def cost(x, u, d, p):
        return ca.dot(ca.DM(prices), ca.vertcat(x, u))

    model = Model(
        name=f"linear-{seed}",
        states=tuple(Quantity(f"x{i}", "m") for i in range(n)),
        actions=tuple(Quantity(f"u{i}", "m") for i in range(m)),
        disturbances=(),
        parameters=(),
        ode=ode,
        economic_cost=cost,
    )
    problem = Problem(
        model=model, sampling_time=SAMPLING_TIME, horizon=10, discount=0.99, substeps=8,
        state_lower=-x_size, state_upper=x_size, action_lower=-u_size, action_upper=u_size,
        penalty_linear=1e3 / x_size, penalty_quadratic=1e3 / x_size**2,
        reference_state=np.zeros(n), reference_action=np.zeros(m), reference_cost=0.0,
    )  # fmt: skip
    return problem, rates, inputs, prices


def closed_loop(problem, result, samples):
    """States and actions of the tuned controller on its own model, from near the steady state."""
    plant = discretise(problem.model, problem.sampling_time, problem.substeps)
    controller = RtiNmpc(problem, result.parameters)
    width = problem.state_upper - problem.state_lower
    x = result.steady_state.x + 0.05 * width * np.sign(-result.steady_state.x)
    states, actions = [], []
    for _ in range(samples):
        controller.prepare()
        u = controller.feedback(x).action
        states.append(x)
        actions.append(u)
        x = plant(x, u, [], []).full().reshape(-1)
    return np.array(states), np.array(actions)


def is_tuned(problem, result):
    """Whether the tuned controller is stable, comes to the optimum and stays within the bounds."""
    assert result.gain_error <= 1e-6 * (1 + np.abs(result.tuned).max())
    assert np.linalg.eigvalsh(result.convexification.hessian)[0] > 0
    closed = result.steady_state.A + result.steady_state.B @ result.tuned
    assert np.abs(np.linalg.eigvals(closed)).max() < 1
    states, actions = closed_loop(problem, result, 300)
    width = problem.state_upper - problem.state_lower
    away = np.abs(states - result.steady_state.x) / width
    assert away[-20:].max() < 1e-3
    assert (states[-20:] >= problem.state_lower - 1e-4 * width).all()
    assert (states[-20:] <= problem.state_upper + 1e-4 * width).all()
    reach = problem.action_upper - problem.action_lower
    assert (actions >= problem.action_lower - 1e-9 * reach).all()
    assert (actions <= problem.action_upper + 1e-9 * reach).all()


def with_one_fast(fast, *others):
    """Seeds, of which all but the first take too long for the fast suite."""
    return [fast, *(pytest.param(seed, marks=pytest.mark.slow) for seed in others)]


@pytest.mark.parametrize("seed", with_one_fast(16, 0, 3, 12, 14, 18, 20, 34, 52, 64))
def test_a_linear_cost_on_a_linear_plant_is_tuned(seed):
    # 16, 52 and 64 have an active bound on which no stable feedback stays.
    problem, rates, inputs, prices = linear_plant(seed)
    result = tune(problem)
    # The optimal steady state is a linear programme's: SciPy's own solver.
    bounds = list(zip(problem.lower, problem.upper, strict=True))
    equation = np.hstack([rates, inputs])
    rest = np.zeros(problem.n_states)
    expected = linprog(prices, A_eq=equation, b_eq=rest, bounds=bounds)
    assert result.steady_state.cost == pytest.approx(expected.fun, rel=1e-6)
    is_tuned(problem, result)
    assert bool(result.addition and result.addition.released) == (seed in {16, 52, 64})


@pytest.mark.parametrize("seed", with_one_fast(8, 1, 15, 34, 37))
def test_a_linear_cost_on_a_bilinear_plant_is_tuned(seed):
    problem, *_ = linear_plant(seed, bilinear=0.3)
    result = tune(problem)
    is_tuned(problem, result)
    assert result.addition is not None
    # Seed 8 has no active bound at all, and a saddle: something must be added.
    assert (result.addition.size > 0) == (seed == 8)


def test_the_stage_cost_of_theta_is_convex_where_units_differ_by_decades():
    """θ is rounded: entries of a variable in large units are small, and no rounding's."""
    problem, *_ = linear_plant(0)
    width = problem.upper - problem.lower
    stage_cost = tune(problem).parameters["B_l"] * np.outer(width, width)
    assert np.linalg.eigvalsh(stage_cost)[0] > 0


def test_what_was_added_is_in_the_certificate():
    problem, *_ = linear_plant(8, bilinear=0.3)
    result = tune(problem)
    steady, convex, addition = result.steady_state, result.convexification, result.addition
    rebuilt = steady.hessian + addition.hessian + rotation(steady.A, steady.B, convex.delta_P)
    size = np.abs(convex.hessian).max()
    np.testing.assert_allclose(convex.hessian, rebuilt, atol=1e-9 * size)


def test_a_warning_says_once_what_was_added():
    problem, *_ = linear_plant(8, bilinear=0.3)
    renamed = replace(problem, model=replace(problem.model, name="warned"))
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("default")
        tune(renamed)
        tune(renamed)
    (warning,) = shown
    assert warning.category is TuningWarning
    assert "a quadratic was added" in str(warning.message)


def test_other_units_change_nothing():
    """States in units a thousand times smaller: the same addition, and the same feedback."""
    additions = []
    for size in (1.0, 1e3):
        model = Model(
            name=f"units-{size:g}",
            states=(Quantity("x", "m"),),
            actions=(Quantity("u", "m"),),
            disturbances=(),
            parameters=(),
            ode=lambda x, u, d, p, size=size: size * u - x,
            economic_cost=lambda x, u, d, p, size=size: -((x / size) ** 2) + 0.5 * u**2,
        )
        problem = Problem(
            model=model, sampling_time=0.5, horizon=10, discount=0.99, substeps=8,
            state_lower=[-2 * size], state_upper=[2 * size], action_lower=[-2], action_upper=[2],
            penalty_linear=[100 / size], penalty_quadratic=[100 / size**2],
            reference_state=[0], reference_action=[0], reference_cost=0.0,
        )  # fmt: skip
        additions.append(tune(problem).addition)
    assert additions[0].size == pytest.approx(additions[1].size, rel=1e-5)


def least_by_frequencies(A, B, H, least):
    """Least σ by the lemma of Kalman, Yakubovich and Popov, on a grid of frequencies.

    H + σI + 𝓗(δP) ⪰ least I has a δP where M*(H + σI − least I)M ⪰ 0 on the unit circle, with
    M(z) = ((zI − A)⁻¹B, I), for a controllable pair.
    """
    lowest = np.inf
    for angle in np.linspace(0, np.pi, 4001):
        response = np.linalg.solve(np.exp(1j * angle) * np.eye(len(A)) - A, B)
        M = np.vstack([response, np.eye(B.shape[1])])
        form = M.conj().T @ H @ M
        lowest = min(lowest, eigh(form, M.conj().T @ M, eigvals_only=True)[0])
    return max(least - lowest, 0.0)


@pytest.mark.parametrize("seed", range(6))
def test_the_least_addition_is_that_of_the_frequency_response(seed):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.3, 0.9) / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(n, m))
    H = rng.normal(size=(n + m, n + m))
    H += H.T
    found = least_addition(A, B, H, np.zeros((0, n + m)), 0.01, 1e6)
    assert found == pytest.approx(least_by_frequencies(A, B, H, 0.01), rel=1e-5, abs=1e-6)


def test_the_least_addition_of_a_scalar_plant_by_hand():
    # x₊ = ½x + u with −x² + ½u², H = diag(−2, 1): worst at rest, where x = 2u. There
    # (σ − 2 − ε) 4 + (σ + 1 − ε) = 0, so that σ = 7/5 + ε.
    A, B, H = np.array([[0.5]]), np.array([[1.0]]), np.diag([-2.0, 1.0])
    found = least_addition(A, B, H, np.zeros((0, 2)), 0.01, 1e6)
    assert found == pytest.approx(1.41, rel=1e-6)


def test_a_cost_that_has_a_convex_equal_gets_nothing():
    # x₊ = ½x + u with −0.1x² + u², H = diag(−0.2, 2).
    A, B, H = np.array([[0.5]]), np.array([[1.0]]), np.diag([-0.2, 2.0])
    assert least_addition(A, B, H, np.zeros((0, 2)), 0.01, 1e6) == pytest.approx(0, abs=1e-7)
