from functools import cache

import numpy as np
import pytest

from controllers import ConvergedNmpc, Parameters, RtiNmpc, ThetaBlocks
from tests.helpers.differences import Feedback, assert_close, derivative, natural_scale
from tests.helpers.sampling import evaporator_problem, random_parameters, random_state

PROBLEM = evaporator_problem()
BLOCKS = ThetaBlocks.of(PROBLEM, slack_weights=True)
NAIVE = Parameters.naive(PROBLEM, BLOCKS)


def off(number):
    """A state away from the reference, near the bound for some."""
    return random_state(PROBLEM, np.random.default_rng(number))


@cache
def controller(iterations):
    return RtiNmpc(PROBLEM, NAIVE, iterations=iterations)


def first(s, iterations):
    """The first feedback of a controller."""
    controller(iterations).reset()
    return controller(iterations).feedback(s)


@pytest.mark.parametrize("number", range(4))
def test_one_qp_is_the_real_time_iteration(number):
    one, rti = first(off(number), 1), RtiNmpc(PROBLEM, NAIVE).feedback(off(number))
    assert one.value == rti.value
    assert np.array_equal(one.action, rti.action)


@pytest.mark.parametrize("number", range(4))
def test_many_qps_end_at_the_converged_solution(number):
    s = off(number)
    converged = ConvergedNmpc(PROBLEM, NAIVE).feedback(s)
    errors = [np.abs(first(s, k).action - converged.action) for k in (1, 2, 4, 30)]
    assert errors[-1].max() < 1e-6
    assert errors[2].max() <= errors[0].max() + 1e-9
    assert first(s, 30).value == pytest.approx(converged.value, rel=1e-9)


@pytest.mark.parametrize("number", range(3))
def test_derivatives_are_those_of_the_last_qp(number):
    rng = np.random.default_rng(number)
    theta, s = random_parameters(PROBLEM, BLOCKS, rng), random_state(PROBLEM, rng)
    solution = RtiNmpc(PROBLEM, theta, iterations=3).feedback(s)
    step = Feedback(RtiNmpc(PROBLEM, theta), theta.theta, solution.prepared.point, s)
    assert step().value == pytest.approx(solution.value, rel=1e-12)
    by_theta = derivative(lambda x: step(theta=x), theta.theta, natural_scale(theta))
    parts = BLOCKS.slices
    assert_close(solution.value_gradient, by_theta["value"], parts, "V", by_theta["value_noise"])
    assert_close(solution.policy_jacobian, by_theta["action"], parts, "π", by_theta["action_noise"])


def test_q_at_the_policy_is_v_and_the_sample_begins_anew():
    nmpc = RtiNmpc(PROBLEM, NAIVE, iterations=3)
    nmpc.prepare()
    point = nmpc.linearisation_point
    s = off(1)
    v = nmpc.feedback(s)
    q = nmpc.feedback(s, v.action)
    assert q.value == pytest.approx(v.value, rel=1e-10)
    assert nmpc.feedback(s).value == v.value
    for one, other in zip(point, nmpc.linearisation_point, strict=True):
        assert np.array_equal(one, other)
