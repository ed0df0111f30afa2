from functools import cache

import numpy as np
import pytest

from controllers import ConvergedNmpc, Parameters, RtiNmpc, ThetaBlocks
from controllers.errors import ControllerError, ParameterError, QpError
from tests.helpers.differences import Feedback, assert_close, derivative, natural_scale
from tests.helpers.sampling import (
    evaporator_problem,
    random_action,
    random_parameters,
    random_point,
    random_state,
)

EXTENDED = {"slack_weights": True}


@pytest.fixture(scope="module")
def shared():
    problem = evaporator_problem()
    theta = Parameters.naive(problem, ThetaBlocks.from_problem(problem, **EXTENDED))
    return {hessian: RtiNmpc(problem, theta, hessian=hessian) for hessian in HESSIANS}


HESSIANS = ("gauss-newton", "exact")


@pytest.fixture(params=HESSIANS)
def nmpc(request, shared, problem):
    controller = shared[request.param]
    controller.parameters = Parameters.naive(problem, controller.parameters.blocks)
    controller.reset()
    return controller


def bits(solution):
    return (
        solution.value,
        solution.action.tobytes(),
        solution.value_gradient.tobytes(),
        b"".join(part.tobytes() for part in solution.multipliers),
    )


def unsettled(nmpc, rng, count=5):
    """Run a few samples, so that the guess is neither the reference nor converged."""
    for _ in range(count):
        nmpc.prepare()
        solution = nmpc.feedback(random_state(nmpc.problem, rng))
    return solution


# the two phases -------------------------------------------------------------------------------


def test_a_second_preparation_changes_nothing(nmpc, problem, rng):
    unsettled(nmpc, rng)
    s = random_state(problem, rng)
    nmpc.prepare()
    point, first = nmpc.linearisation_point, nmpc.feedback(s)
    nmpc.prepare_at(point)
    nmpc.prepare()
    nmpc.prepare()
    assert bits(nmpc.feedback(s)) == bits(first)


def test_prepare_shifts_the_last_solution(nmpc, rng):
    last = unsettled(nmpc, rng)
    nmpc.prepare()
    x, u, costates = nmpc.linearisation_point
    np.testing.assert_array_equal(x, last.predicted_states[1:])
    np.testing.assert_array_equal(u[:-1], last.predicted_actions[1:])
    np.testing.assert_array_equal(u[-1], last.predicted_actions[-1])
    np.testing.assert_allclose(costates[:-1], last.costates[2:] / 0.99, rtol=1e-15)


def test_the_policy_keeps_the_bounds(nmpc):
    nmpc.parameters = nmpc.parameters.replace({"b_l": [0, 0, -600, 900]})
    np.testing.assert_allclose(nmpc.policy([26.0, 50.0]), [400.0, 100.0], rtol=1e-14)


# replay and reset -----------------------------------------------------------------------------


def test_replay_gives_the_same_bits_whatever_was_solved_before(nmpc, problem, rng):
    blocks = nmpc.parameters.blocks
    theta, other = (random_parameters(problem, blocks, rng) for _ in range(2))
    nmpc.parameters = theta
    stored = []
    for number in range(20):
        nmpc.prepare()
        s, a = random_state(problem, rng), random_action(problem, rng) if number % 2 else None
        stored.append((nmpc.linearisation_point, s, a, bits(nmpc.feedback(s, a))))
    nmpc.parameters = other
    unsettled(nmpc, rng)
    nmpc.parameters = theta
    for k in rng.permutation(20):
        point, s, a, expected = stored[k]
        nmpc.prepare_at(point)
        assert bits(nmpc.feedback(s, a)) == expected


# θ --------------------------------------------------------------------------------------------


def test_setting_theta_acts_on_the_next_feedback_at_the_same_point(nmpc, problem, rng):
    s, point = random_state(problem, rng), random_point(problem, rng)
    theta = random_parameters(problem, nmpc.parameters.blocks, rng)
    nmpc.prepare_at(point)
    before = nmpc.feedback(s).value
    nmpc.prepare_at(point)
    nmpc.theta = theta.theta
    np.testing.assert_array_equal(nmpc.theta, theta.theta)
    after = nmpc.feedback(s)
    assert after.value != before
    nmpc.parameters = theta
    nmpc.prepare_at(point)
    assert bits(nmpc.feedback(s)) == bits(after)


BAD = {
    "length": lambda t: t.theta[:-1],
    "nan": lambda t: t.theta * np.nan,
    "crossed bounds": lambda t: t.replace({"x_l": [25, 80]}).theta,
    "no linear weight": lambda t: t.replace({"w_sigma": [0, 1]}).theta,
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_theta_is_refused_and_the_old_one_stays(case, nmpc):
    before = nmpc.feedback([26.0, 50.0]).value
    nmpc.prepare_at(nmpc.linearisation_point)
    with pytest.raises(ParameterError):
        nmpc.theta = BAD[case](nmpc.parameters)
    assert nmpc.feedback([26.0, 50.0]).value == before


# failures -------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:invalid:RuntimeWarning")
@pytest.mark.parametrize("s", [[np.nan, 50.0], [25.0, np.inf]])
def test_a_state_that_is_not_finite_raises_with_the_qp_and_the_next_one_is_solved(s, nmpc):
    expected = bits(nmpc.feedback([26.0, 50.0]))
    nmpc.reset()
    with pytest.raises(QpError) as caught:
        nmpc.feedback(s)
    assert caught.value.is_solver_failure
    assert not np.isfinite(caught.value.qp.f).all()
    assert bits(nmpc.feedback([26.0, 50.0])) == expected


def test_a_cost_that_is_not_convex_raises_and_the_qp_is_carried(shared):
    nmpc = shared["gauss-newton"]
    nmpc.parameters = nmpc.parameters.replace({"B_l": -np.eye(4)})
    with pytest.raises(QpError) as caught:
        nmpc.feedback([26.0, 50.0])
    assert np.linalg.eigvalsh(caught.value.qp.H)[0] < 0


@pytest.mark.parametrize("name", ["x", "u", "costates"])
def test_a_point_that_does_not_fit_is_refused_and_changes_nothing(name, nmpc, problem, rng):
    nmpc.prepare_at(random_point(problem, rng))
    expected = bits(nmpc.feedback([26.0, 50.0]))
    for bad in (np.zeros((3, 2)), np.full((10, 2), np.nan)):
        with pytest.raises(ControllerError):
            nmpc.prepare_at(random_point(problem, rng)._replace(**{name: bad}))
        assert bits(nmpc.feedback([26.0, 50.0])) == expected


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid:RuntimeWarning")
def test_a_model_that_blows_up_raises_and_the_qp_is_carried(nmpc, problem, rng):
    point = random_point(problem, rng)
    point.x[:] = 1e200
    point.u[:] = 1e200
    with pytest.raises(QpError) as caught:
        nmpc.prepare_at(point)
    assert caught.value.qp is not None
    nmpc.reset()
    assert nmpc.feedback([26.0, 50.0]).residual < 1e-9


# other problems -------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize("backend", ["daqp", "proxqp", "qpsolvers:clarabel"])
def test_short_horizons_are_problems_too(horizon, backend):
    problem = evaporator_problem(horizon=horizon, discount=1.0)
    nmpc = RtiNmpc(problem, Parameters.naive(problem), backend=backend)
    solution = nmpc.feedback([26.0, 50.0])
    assert solution.predicted_states.shape == (horizon + 1, 2)
    assert solution.residual < 1e-8
    nmpc.prepare()
    assert nmpc.feedback([26.0, 50.0], [190.0, 210.0]).value >= nmpc.value([26.0, 50.0])


PROBLEM = evaporator_problem()
BLOCKS = ThetaBlocks.from_problem(PROBLEM, slack_weights=True)
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
