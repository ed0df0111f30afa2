import numpy as np
import pytest

from learning.batch_q_learning import RULES, gauss_newton, projected_bellman, steepest_descent


@pytest.fixture
def data(rng):
    gradient = rng.normal(size=(200, 5))
    jacobian = gradient - 0.9 * rng.normal(size=(200, 5))
    return gradient, jacobian, rng.normal(size=200)


def test_gauss_newton_solves_the_normal_equations(data):
    gradient, jacobian, errors = data
    step = gauss_newton(gradient, jacobian, errors, 0.0).minimiser
    assert step == pytest.approx(np.linalg.lstsq(gradient, errors)[0], rel=1e-5)


def test_lstdq_step_zeroes_the_projected_bellman_error(data):
    gradient, jacobian, errors = data
    step = projected_bellman(gradient, jacobian, errors, 0.0).minimiser
    left = gradient.T @ (errors - jacobian @ step)
    assert np.abs(left).max() < 1e-4 * np.abs(gradient.T @ errors).max()


def test_steepest_descent_goes_to_the_minimum_on_its_line(data):
    gradient, jacobian, errors = data
    step = steepest_descent(gradient, jacobian, errors, 0.0).minimiser

    def cost(t):
        return ((errors - t * (gradient @ step)) ** 2).sum()

    assert cost(1.0) < min(cost(0.9), cost(1.1))
    assert step @ (gradient.T @ errors) > 0


@pytest.mark.parametrize("name", RULES)
def test_every_rule_is_a_consistent_fit(data, name):
    fit = RULES[name](*data, 1e-2)
    assert fit.metric() @ fit.minimiser == pytest.approx(fit.gradient, rel=1e-6, abs=1e-9)
