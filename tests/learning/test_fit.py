"""Each closed form against the quadratic programme that it claims to solve."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from qpsolvers import solve_qp

from learning.step import line_search, policy_gradient_fit, td_fit, td_step

SIZE = 6


def programme(fit):
    """Minimiser of dᵀMd − 2bᵀd by a QP solver that knows nothing of closed forms."""
    return solve_qp(2 * fit.metric(), -2 * fit.gradient, solver="daqp")


def check(fit):
    assert fit.minimiser == pytest.approx(programme(fit), rel=1e-6, abs=1e-9)


@given(seed=st.integers(0, 10**6), step_size=st.floats(1e-4, 10.0), td_error=st.floats(-1e3, 1e3))
def test_td_fit_equals_its_quadratic_programme(seed, step_size, td_error):
    gradient = np.random.default_rng(seed).normal(size=SIZE)
    check(td_fit(td_error, gradient, step_size))


def test_td_fit_is_the_papers_fitting_problem(rng):
    gradient, td_error, step_size = rng.normal(size=SIZE), 3.7, 0.4
    fit = td_fit(td_error, gradient, step_size)

    def cost(d):
        return (td_error - gradient @ d) ** 2 + d @ d / step_size

    best = cost(fit.minimiser)
    for _ in range(50):
        assert cost(fit.minimiser + 1e-3 * rng.normal(size=SIZE)) > best


def test_td_fit_is_normalised_and_the_td_step_is_not(rng):
    gradient = rng.normal(size=SIZE)
    norm = gradient @ gradient
    assert td_fit(2.0, gradient, 1e6).minimiser == pytest.approx(2.0 * gradient / norm, rel=1e-5)
    assert td_step(2.0, gradient, 0.3).minimiser == pytest.approx(0.6 * gradient)
    check(td_step(2.0, gradient, 0.3))


@pytest.mark.parametrize("natural", [False, True])
def test_policy_gradient_fit_descends_and_equals_its_programme(rng, natural):
    root = rng.normal(size=(SIZE, SIZE))
    metric = root @ root.T + np.eye(SIZE) if natural else None
    gradient = rng.normal(size=SIZE)
    fit = policy_gradient_fit(gradient, 0.7, metric)
    check(fit)
    assert fit.minimiser @ gradient < 0


@pytest.mark.parametrize(
    ("error", "step"),
    [
        (lambda t: 1.0 - t, 1.0),
        (lambda t: 1.0 - 3.0 * t, 0.5),
        (lambda t: 1.0 + t, 0.0),
        (lambda t: 1.0 if t == 0 else float("nan"), 0.0),
    ],
)
def test_line_search_takes_the_largest_step_that_does_not_raise_the_error(error, step):
    assert line_search(error) == step
