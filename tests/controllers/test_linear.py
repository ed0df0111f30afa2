"""The linear state feedback, and the PI loops."""

import dataclasses

import numpy as np
import pytest

from controllers import ControllerError, Problem
from controllers.economic import tune
from controllers.linear import Lqr, PiLoops, pairing
from controllers.problem import linear_model
from cosim import Scenario


@pytest.fixture(scope="module", params=["paper", "reactor", "tanks"])
def problem(request):
    return Problem.from_scenario(Scenario.load(request.param))


@pytest.fixture(scope="module")
def paper():
    return Problem.from_scenario(Scenario.load("paper"))


def test_the_gain_is_the_fixed_point_of_the_riccati_recursion(problem):
    (A, B), n = linear_model(problem), problem.n_states
    H = tune(problem).convexification.hessian
    P, dynamics = np.zeros((n, n)), np.hstack([A, B])
    for _ in range(4000):  # value iteration: minimise ½wᵀHw + ½x₊ᵀPx₊ over u
        M = H + dynamics.T @ P @ dynamics
        gain = np.linalg.solve(M[n:, n:], M[n:, :n])
        P = M[:n, :n] - M[:n, n:] @ gain
    np.testing.assert_allclose(Lqr(problem).gain, gain, rtol=1e-6, atol=1e-8)


def test_the_feedback_is_linear_between_the_bounds(paper):
    lqr = Lqr(paper)
    moved = paper.reference_state + np.array([0.1, -0.2])
    expected = paper.reference_action - lqr.gain @ [0.1, -0.2]
    np.testing.assert_allclose(lqr.feedback(moved).action, expected)
    assert (lqr.feedback(np.array([90.0, 50.0])).action <= paper.action_lower)[0]
    assert lqr.feedback(moved, np.array([1.0, 2.0])).action.tolist() == [1.0, 2.0]


def run(problem, loops, disturbance, samples):
    """Errors (samples, n) of the loops on the linear model with an additive disturbance."""
    A, B = linear_model(problem)
    x, errors = np.zeros(problem.n_states), []
    loops.reset()
    for k in range(samples):
        loops.prepare()
        u = loops.feedback(problem.reference_state + x).action - problem.reference_action
        x = A @ x + B @ u + disturbance(k)
        errors.append(x)
    return np.array(errors)


@pytest.mark.parametrize("preset", ["paper", "fast-sampling", "reactor"])
def test_integral_action_removes_the_offset_of_a_constant_disturbance(preset):
    problem = Problem.from_scenario(Scenario.load(preset))
    push = linear_model(problem)[1] @ [2.0, -3.0]  # as if both actions were off
    loops = PiLoops(problem)
    errors = np.abs(run(problem, loops, lambda k: push, 1000))
    assert errors[-1].max() < 1e-9 < 1e-3 * errors.max()
    loops.reset_time = np.full(2, np.inf)
    assert np.abs(run(problem, loops, lambda k: push, 1000))[-1].max() > 0.05 * errors.max()


def test_an_action_at_its_bound_does_not_wind_up(paper):
    push = -2.0 * linear_model(paper)[1] @ (paper.action_upper - paper.action_lower)
    loops = PiLoops(paper)
    wide = {"action_lower": [-1e6, -1e6], "action_upper": [1e6, 1e6]}
    overshoot = []
    for loops.problem in (paper, dataclasses.replace(paper, **wide)):  # the wide one cannot wind up
        errors = run(paper, loops, lambda k: push * (k < 200), 400)
        overshoot.append(errors[200:].max(axis=0))
    assert (overshoot[0] <= overshoot[1]).all()


def test_the_loops_follow_the_simc_rules(paper):
    A, B = linear_model(paper)
    loops = PiLoops(paper)
    tau, k = -1 / np.log(np.diag(A)), np.diag(B) / (1 - np.diag(A))
    np.testing.assert_allclose(loops.gain, tau / k)
    assert loops.reset_time.tolist() == [4.0, 4.0]
    assert loops.feedback(paper.reference_state, np.array([1.0, 2.0])).action.tolist() == [1.0, 2.0]


def test_states_and_actions_are_paired_by_relative_gains():
    assert pairing(np.array([[0.1, 2.0, 0.0], [0.0, 0.1, -3.0], [4.0, 0.0, 0.1]])).tolist() == [
        2,
        0,
        1,
    ]
    with pytest.raises(ControllerError, match="2 states and 2 actions make no PI loops"):
        pairing(np.array([[1.0, 1.0], [1.0, 1.0]]))
    with pytest.raises(ControllerError, match="4 states and 2 actions make no PI loops"):
        PiLoops(Problem.from_scenario(Scenario.load("tanks")))
