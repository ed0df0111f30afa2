"""The converged NMPC against IPOPT and finite differences of its programme."""

import numpy as np
import pytest

from benchmarks.ipopt import IpoptNmpc
from controllers import ConvergedNmpc, LinearisationPoint, Parameters, RtiNmpc, ThetaBlocks
from controllers.errors import QpError
from controllers.qp import NOT_CONVEX, DaqpBackend
from tests.helpers.differences import assert_close, derivative, natural_scale
from tests.helpers.sampling import (
    evaporator_problem,
    random_action,
    random_parameters,
    random_state,
)

WHOLE = {"all": slice(None)}


@pytest.fixture(scope="module")
def blocks():
    return ThetaBlocks.from_problem(evaporator_problem(), slack_weights=True)


@pytest.fixture(scope="module")
def converged(blocks):
    problem = evaporator_problem()
    return ConvergedNmpc(problem, Parameters.naive(problem, blocks), tolerance=1e-10)


@pytest.fixture(scope="module")
def physical():
    problem = evaporator_problem()
    blocks = ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=("UA2", "h"))
    return ConvergedNmpc(problem, Parameters.naive(problem, blocks), tolerance=1e-10)


@pytest.fixture(scope="module")
def ipopt(blocks):
    return IpoptNmpc(evaporator_problem(), blocks)


@pytest.fixture(scope="module")
def rtis(blocks):
    problem = evaporator_problem()
    theta = Parameters.naive(problem, blocks)
    return {name: RtiNmpc(problem, theta, hessian=name) for name in ("gauss-newton", "exact")}


def sample(problem, blocks, number):
    """The naive θ with the true penalty first, then random ones; every other with an action."""
    rng = np.random.default_rng(number)
    theta = random_parameters(problem, blocks, rng)
    theta = theta if number > 3 else Parameters.naive(problem, blocks)
    a = random_action(problem, rng) if number % 2 else None
    return theta, random_state(problem, rng), a


def solved(converged, theta, s, a=None):
    converged.parameters = theta
    converged.reset()
    return converged.feedback(s, a)


@pytest.mark.parametrize("number", range(24))
def test_it_equals_ipopt(number, converged, ipopt, problem, blocks):
    theta, s, a = sample(problem, blocks, number)
    ours, theirs = solved(converged, theta, s, a), ipopt.solve(theta, s, a)
    assert theirs.success
    assert ours.value == pytest.approx(theirs.value, rel=1e-6)
    np.testing.assert_allclose(ours.predicted_states, theirs.states, rtol=1e-6)
    np.testing.assert_allclose(ours.predicted_actions, theirs.controls, rtol=1e-6)
    np.testing.assert_allclose(ours.action, theirs.action, rtol=1e-6)


@pytest.mark.parametrize("number", range(0, 24, 4))
def test_a_warm_start_leads_to_the_same_solution(number, converged, problem, blocks):
    theta, s, a = sample(problem, blocks, number)
    cold = solved(converged, theta, s, a)
    converged.prepare()
    warm = converged.feedback(s, a)
    assert warm.value == pytest.approx(cold.value, rel=1e-9)
    np.testing.assert_allclose(warm.predicted_actions, cold.predicted_actions, rtol=1e-7)


@pytest.mark.parametrize("number", [4, 5, 8, 11])
def test_its_derivatives_are_those_of_the_programme(number, converged, problem, blocks):
    check_derivatives(number, converged, problem, blocks)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4, 24, 3))
def test_so_are_those_by_model_parameters(number, physical, problem):
    check_derivatives(number, physical, problem, physical.parameters.blocks)


def check_derivatives(number, converged, problem, blocks):
    theta, s, a = sample(problem, blocks, number)
    base = solved(converged, theta, s, a)
    assert not base.weakly_active

    by_theta = derivative(
        lambda x: solved(converged, theta.with_theta(x), s, a), theta.theta, natural_scale(theta)
    )
    by_state = derivative(lambda x: solved(converged, theta, x, a), s, np.ones(2))
    for gradient, jacobian, fd, parts in (
        (base.value_gradient, "policy_jacobian", by_theta, blocks.slices),
        (base.costates[0], "policy_state_jacobian", by_state, WHOLE),
    ):
        assert_close(gradient, fd["value"], parts, "dV or dQ", fd["value_noise"])
        if a is None:
            # The programme is solved to 1e-10 in an action, ten times the error of one QP.
            noise = 10 * fd["action_noise"]
            assert_close(getattr(base, jacobian), fd["action"], parts, "dπ", noise)


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize("number", [4, 5, 6, 7])
def test_value_gradients_are_those_of_the_rti_in_the_limit(
    hessian, number, converged, rtis, problem, blocks
):
    theta, s, a = sample(problem, blocks, number)
    expected = solved(converged, theta, s, a)
    rti = rtis[hessian]
    rti.parameters = theta
    rti.reset()
    solution = rti.feedback(s, a)
    for _ in range(60):
        rti.prepare_at(
            LinearisationPoint(
                solution.predicted_states[:-1], solution.predicted_actions, solution.costates[1:]
            )
        )
        solution = rti.feedback(s, a)
    assert solution.value == pytest.approx(expected.value, rel=1e-9)
    assert_close(solution.value_gradient, expected.value_gradient, blocks.slices, "dV/dθ", 1e-8)
    assert_close(solution.costates[0], expected.costates[0], WHOLE, "dV/ds", 1e-8)


def test_too_few_iterations_raise_and_the_qp_is_carried(problem):
    converged = ConvergedNmpc(problem, Parameters.naive(problem), iterations=1)
    with pytest.raises(QpError) as caught:
        converged.feedback([32.0, 60.0])
    assert caught.value.status == "not converged"
    assert caught.value.qp is not None


@pytest.mark.parametrize("where", ["load", "solve"])
def test_a_qp_that_is_not_convex_is_lifted_and_read_out_as_it_is(
    where, converged, problem, blocks, monkeypatch
):
    theta, s, a = sample(problem, blocks, 6)
    expected = solved(converged, theta, s, a)
    lifting = ConvergedNmpc(problem, theta, tolerance=1e-10)
    ordinary = getattr(DaqpBackend, where)

    def refusing(self, qp):
        if not lifting._hessian.lifts and self is lifting._backend:
            raise QpError("refused", status=NOT_CONVEX)
        return ordinary(self, qp)

    monkeypatch.setattr(DaqpBackend, where, refusing)
    solution = lifting.feedback(s, a)
    assert solution.value == pytest.approx(expected.value, rel=1e-10)
    assert_close(solution.value_gradient, expected.value_gradient, blocks.slices, "dV/dθ", 1e-7)
    assert_close(solution.policy_jacobian, expected.policy_jacobian, blocks.slices, "dπ", 1e-6)
    # The next feedback of the sample still has the QP that can be solved.
    assert lifting.feedback(s, a).value == pytest.approx(expected.value, rel=1e-10)
