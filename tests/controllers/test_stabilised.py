"""The QP in stabilised controls: as the condensed one, and where that one loses its digits."""

from dataclasses import replace

import numpy as np
import pytest

from controllers import LinearisationPoint, Parameters, Problem, QpError, RtiNmpc
from controllers.rti import nmpc
from cosim import Scenario

HOT = np.array([0.62, 341.0, 304.0])
"""A state between the reactor's steady states, where it is less stable than at its reference."""


@pytest.fixture(scope="module")
def problem():
    return Problem.from_scenario(Scenario.load("unstable-reactor"))


@pytest.fixture
def controller(problem):
    return RtiNmpc(problem, Parameters.naive(problem))


def samples(problem, spread, count):
    """States and points of linearisation about HOT.

    The actions vary by `spread` of their range from stage to stage.
    """
    rng = np.random.default_rng(0)
    horizon = problem.horizon
    size = problem.action_upper - problem.action_lower
    for _ in range(count):
        x = HOT + rng.normal(size=(horizon, 3)) * [0.01, 0.5, 1.0]
        u = problem.reference_action + spread * size * rng.normal(size=(horizon, 2))
        u = u.clip(problem.action_lower, problem.action_upper)
        s = HOT + rng.normal(size=3) * [0.03, 2.0, 4.0]
        yield s, LinearisationPoint(x, u, np.zeros((horizon, 3)))


def refuse(*_):
    raise QpError("not tried", status="not tried")


def solved(controller, s, point, a=None):
    """The solution, None where the QP is not solved."""
    controller.prepare_at(point)
    try:
        return controller.feedback(s, a)
    except QpError:
        return None


def test_it_gives_what_the_condensed_qp_gives(controller, problem, monkeypatch):
    a = np.add(problem.reference_action, [1.0, 2.0])
    for s, point in samples(problem, 0.02, 10):
        for enforced in (None, a):
            expected = solved(controller, s, point, enforced)
            with monkeypatch.context() as patch:
                patch.setattr(nmpc, "ACCURATE_RESIDUAL", 0.0)
                patch.setattr(nmpc, "polish", refuse)
                answer = solved(controller, s, point, enforced)
            np.testing.assert_allclose(answer.action, expected.action, atol=1e-7)
            assert answer.value == pytest.approx(expected.value, rel=1e-9)
            scale = np.abs(expected.value_gradient).max()
            difference = answer.value_gradient - expected.value_gradient
            assert np.abs(difference).max() < 1e-6 * scale


def test_what_the_condensed_qp_loses_is_solved(controller, problem, monkeypatch):
    given = list(samples(problem, 0.1, 40))
    assert all(solved(controller, s, point) for s, point in given)
    monkeypatch.setattr(nmpc, "solve_stabilised", refuse)
    assert not all(solved(controller, s, point) for s, point in given)


def test_a_solver_that_was_chosen_is_not_replaced(problem, monkeypatch):
    monkeypatch.setattr(nmpc, "solve_stabilised", lambda *_: pytest.fail("it was"))
    chosen = RtiNmpc(problem, Parameters.naive(problem), backend="qpsolvers:daqp")
    assert not all(solved(chosen, s, point) for s, point in samples(problem, 0.3, 20))


def test_growth_over_the_horizon_is_a_power(problem):
    growth = nmpc.growth_over_horizon(problem)
    assert growth > nmpc.GROWTH_LIMIT
    twice = nmpc.growth_over_horizon(replace(problem, horizon=2 * problem.horizon))
    assert twice == pytest.approx(growth**2)
    stable = Problem.from_scenario(Scenario.load("paper"))
    assert nmpc.growth_over_horizon(stable) < 1
