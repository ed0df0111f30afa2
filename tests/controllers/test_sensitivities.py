"""Value, policy and all their derivatives against finite differences of the same feedback step."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest

from controllers import LinearisationPoint, Parameters, RtiNmpc, ThetaBlocks
from controllers.errors import ControllerError
from tests.helpers import stored
from tests.helpers.differences import Feedback, assert_close, derivative, natural_scale
from tests.helpers.sampling import (
    evaporator_problem,
    random_action,
    random_parameters,
    random_point,
    random_state,
)

BLOCKS = {
    "paper": {},
    "extended": {"slack_weights": True},
    "physical": {"slack_weights": True, "model_parameters": ("UA2", "h")},
}
HESSIANS = ("gauss-newton", "exact")
WHOLE = {"all": slice(None)}
FEW, MANY = 2, 12
KINDS = [(blocks, hessian) for blocks in BLOCKS for hessian in HESSIANS]


@lru_cache
def controller(blocks, hessian, backend="daqp"):
    problem = evaporator_problem()
    chosen = ThetaBlocks.from_problem(problem, **BLOCKS[blocks])
    return RtiNmpc(problem, Parameters.naive(problem, chosen), hessian=hessian, backend=backend)


class Sample(NamedTuple):
    theta: Parameters
    point: LinearisationPoint
    s: np.ndarray
    a: np.ndarray


def sample(blocks, hessian, number):
    """A random θ, linearisation point, state and action; some inputs are cheap and saturate."""
    nmpc = controller(blocks, hessian)
    problem = nmpc.problem
    rng = np.random.default_rng([KINDS.index((blocks, hessian)), number])
    theta = random_parameters(problem, nmpc.parameters.blocks, rng)
    if number % 3 == 0:
        cheap = np.diag([1.0, 1.0, 0.2, 0.2])
        theta = theta.replace({"B_l": cheap @ theta["B_l"] @ cheap})
        theta = theta.replace({"B_l": (theta["B_l"] + theta["B_l"].T) / 2})
    point = random_point(problem, rng)
    return Sample(theta, point, random_state(problem, rng), random_action(problem, rng))


def check_derivatives(blocks, hessian, numbers):
    nmpc = controller(blocks, hessian)
    slices = nmpc.parameters.blocks.slices
    for number in numbers:
        theta, point, s, a = sample(blocks, hessian, number)
        step = Feedback(nmpc, theta.theta, point, s)
        label = f"{blocks}, {hessian}, sample {number}"
        value, action_value = step(), step(a=a)
        assert not value.weakly_active
        assert not action_value.weakly_active
        for solution, enforced, name in ((value, None, "V"), (action_value, a, "Q")):
            by_theta = derivative(
                lambda x, b=enforced, f=step: f(theta=x, a=b), theta.theta, natural_scale(theta)
            )
            by_state = derivative(lambda x, b=enforced, f=step: f(s=x, a=b), s, np.ones(2))
            for gradient, fd, parts in (
                (solution.value_gradient, by_theta, slices),
                (solution.costates[0], by_state, WHOLE),
            ):
                assert_close(gradient, fd["value"], parts, f"{label}: d{name}", fd["value_noise"])
            if enforced is None:
                for jacobian, fd, parts in (
                    (solution.policy_jacobian, by_theta, slices),
                    (solution.policy_state_jacobian, by_state, WHOLE),
                ):
                    assert_close(jacobian, fd["action"], parts, f"{label}: dπ", fd["action_noise"])
        fd = derivative(lambda x, f=step: f(a=x), a, np.ones(2))
        assert_close(
            action_value.action_gradient, fd["value"], WHOLE, f"{label}: dQ/da", fd["value_noise"]
        )


# `physical` has every block that `extended` has.
DIFFERENTIATED = [kind for kind in KINDS if kind[0] != "extended"]


@pytest.mark.parametrize(("blocks", "hessian"), DIFFERENTIATED)
def test_every_derivative_equals_finite_differences(blocks, hessian):
    check_derivatives(blocks, hessian, range(FEW))


@pytest.mark.slow
@pytest.mark.parametrize(("blocks", "hessian"), DIFFERENTIATED)
def test_every_derivative_equals_finite_differences_at_many_points(blocks, hessian):
    # One in three has inputs that saturate.
    check_derivatives(blocks, hessian, range(FEW, MANY))


# V, Q and π from one linearisation point ------------------------------------------------------


def random_cases(backend="daqp"):
    for blocks, hessian in KINDS if backend == "daqp" else KINDS[:2]:
        nmpc = controller(blocks, hessian, backend)
        for number in range(20):
            theta, point, s, a = sample(blocks, hessian, number)
            nmpc.parameters = theta
            nmpc.prepare_at(point)
            yield nmpc, s, a


def stored_cases(backend="daqp"):
    """The QPs of real runs, where the policy keeps the next state on its bound."""
    for nmpc, qp in stored.prepared(backend, range(0, len(stored.qps()), 5)):
        yield nmpc, qp.s, nmpc.policy(qp.s) + np.array([3.0, -2.0])


@pytest.mark.parametrize("backend", ["daqp", "proxqp"])
@pytest.mark.parametrize("cases", [random_cases, stored_cases])
def test_the_value_is_the_action_value_of_the_policy(cases, backend):
    for nmpc, s, _ in cases(backend):
        value = nmpc.feedback(s)
        assert nmpc.feedback(s, value.action).value == pytest.approx(value.value, rel=1e-8)


@pytest.mark.parametrize("cases", [random_cases, stored_cases])
def test_no_action_is_worth_more_than_the_policys(cases):
    for nmpc, s, a in cases():
        value = nmpc.feedback(s)
        other = np.clip(a, nmpc.problem.action_lower, nmpc.problem.action_upper)
        for action in (other, value.action + (other - value.action) * 1e-3):
            assert nmpc.action_value(s, action) >= value.value - 1e-9 * abs(value.value)


@pytest.mark.parametrize("backend", ["daqp", "proxqp"])
@pytest.mark.parametrize("cases", [random_cases, stored_cases])
def test_value_and_action_value_have_the_same_gradients_at_the_policy(cases, backend):
    kinks = 0
    for nmpc, s, _ in cases(backend):
        slices = nmpc.parameters.blocks.slices
        value = nmpc.feedback(s)
        action_value = nmpc.feedback(s, value.action)
        kinks += action_value.weakly_active
        # The slack of a row at its limit, which is a gradient too, is zero up to rounding.
        assert_close(
            action_value.value_gradient, value.value_gradient, slices, "dQ/dθ, dV/dθ", 1e-8
        )
        assert_close(action_value.costates[0], value.costates[0], WHOLE, "dQ/ds, dV/ds")
        inside = (value.action > nmpc.problem.action_lower + 1e-6) & (
            value.action < nmpc.problem.action_upper - 1e-6
        )
        size = 1e-6 * max(1.0, np.abs(value.costates).max())
        assert np.abs(action_value.action_gradient[inside]).max(initial=0) <= size
    assert kinks > 10


# flags ----------------------------------------------------------------------------------------


def change_of_activity(blocks, number):
    """Two states 1e-13 apart whose QPs have different active sets, and the samples beside them."""
    nmpc = controller(blocks, "gauss-newton")
    theta, point, low, _ = sample(blocks, "gauss-newton", number)
    step = Feedback(nmpc, theta.theta, point, low)

    def active(s):
        solution = step(s=s)
        return [mask.tolist() for mask in solution.multipliers.active(solution.qp)]

    start = active(low)
    ways = (c * np.array([4.0, -6.0]) for c in (1, -1, 2, -2, 4, -4))
    way = next(way for way in ways if active(low + way) != start)
    high = low + way
    for _ in range(48):
        middle = (low + high) / 2
        low, high = (middle, high) if active(middle) == start else (low, middle)
    return step, low, high, way


@pytest.mark.parametrize("number", range(12))
def test_the_flag_is_up_where_activity_is_weak_and_down_beside_it(number):
    step, low, high, way = change_of_activity("paper", number)
    states = (low - 1e-4 * way, low, high, high + 1e-4 * way)
    assert [step(s=s).weakly_active for s in states] == [False, True, True, False]


def test_the_flag_is_up_where_an_eigenvalue_is_about_to_be_lifted():
    nmpc = controller("paper", "exact")
    theta, point, s, _ = sample("paper", "exact", 1)

    def least(factor):
        nmpc.parameters = theta
        nmpc.prepare_at(point._replace(costates=factor * point.costates))
        solution = nmpc.feedback(s)
        spectrum = solution.prepared.spectrum
        return (spectrum.values - spectrum.floor).min(), solution.weakly_active

    low, high = 0.0, 1e4
    assert least(low)[0] > 0 > least(high)[0]
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if least(middle)[0] > 0 else (low, middle)
    assert least(low)[1]
    assert not least(0.99 * low)[1]


def test_licq_fails_where_the_enforced_action_holds_a_state_on_its_bound():
    failing = 0
    for nmpc, s, _ in stored_cases():
        value = nmpc.feedback(s)
        assert value.licq
        if np.abs(value.predicted_states[1, 0] - nmpc.parameters["x_l"][0]) < 1e-9:
            action_value = nmpc.feedback(s, value.action)
            assert action_value.weakly_active
            failing += not action_value.licq
    assert failing > 20


# read-outs ------------------------------------------------------------------------------------


def test_an_enforced_action_has_no_policy_jacobian():
    nmpc = controller("paper", "gauss-newton")
    solution = nmpc.feedback([25.5, 50.0], [190.0, 210.0])
    np.testing.assert_allclose(solution.action, [190.0, 210.0], rtol=1e-15)
    for name in ("policy_jacobian", "policy_state_jacobian"):
        with pytest.raises(ControllerError):
            getattr(solution, name)


def test_predictions_follow_the_linearised_model_and_its_slack():
    nmpc = controller("paper", "gauss-newton")
    for number in range(10):
        theta, point, s, _ = sample("paper", "gauss-newton", number)
        solution = Feedback(nmpc, theta.theta, point, s)()
        x = solution.predicted_states
        np.testing.assert_allclose(x[0], s, rtol=1e-15)
        state = nmpc.problem.scale.state
        y = (solution.qp.rows @ solution.multipliers.v).reshape(-1, 2) * state
        lower = solution.qp.row_lower.reshape(-1, 2) * state
        np.testing.assert_allclose(y - lower, x[1:] - theta["x_l"], atol=1e-9)
        outside = np.maximum(theta["x_l"] - x[1:], x[1:] - theta["x_u"])
        np.testing.assert_allclose(solution.slack, np.maximum(outside, 0), atol=1e-12)


def test_the_value_is_the_papers_cost_of_the_prediction():
    nmpc = controller("extended", "gauss-newton")
    problem = nmpc.problem
    for number in range(10):
        theta, point, s, a = sample("extended", "gauss-newton", number)
        step = Feedback(nmpc, theta.theta, point, s)
        for solution in (step(), step(a=a)):
            xi = solution.predicted_states - problem.reference_state
            v, slack = solution.predicted_actions - problem.reference_action, solution.slack
            total = problem.penalty(s) + theta["c_lambda"]
            total += xi[0] @ theta["B_lambda"] @ xi[0] + theta["b_lambda"] @ xi[0]
            for k in range(problem.horizon):
                w, t = np.concatenate([xi[k], v[k]]), slack[k]
                total += 0.99**k * (w @ theta["B_l"] @ w + theta["b_l"] @ w)
                total += 0.99 ** (k + 1) * (theta["w_sigma"] @ t + theta["W_sigma"] @ t**2)
            end = xi[-1] @ theta["B_Vf"] @ xi[-1] + theta["b_Vf"] @ xi[-1]
            assert solution.value == pytest.approx(total + 0.99**problem.horizon * end, rel=1e-12)


def test_a_solution_keeps_its_read_outs_after_the_controller_went_on():
    nmpc = controller("paper", "exact")
    theta, point, s, _ = sample("paper", "exact", 1)
    first, again = (Feedback(nmpc, theta.theta, point, s)() for _ in range(2))
    gradient, jacobian = again.value_gradient.copy(), again.policy_jacobian.copy()
    residual = again.residual
    for number in (2, 3):
        theta, point, s, _ = sample("paper", "exact", number)
        Feedback(nmpc, theta.theta, point, s)().policy_jacobian  # noqa: B018
    np.testing.assert_array_equal(first.value_gradient, gradient)
    np.testing.assert_array_equal(first.policy_jacobian, jacobian)
    assert first.residual == residual
