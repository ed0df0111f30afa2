from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import scipy.linalg

from controllers import LinearisationPoint, Model, Quantity, RtiNmpc
from controllers.economic import convexify, optimal_steady_state, rotation, tune
from controllers.errors import TuningError
from controllers.model import discretise, economic_cost
from tests.helpers.sampling import evaporator_problem

PROBLEMS = {
    "paper": evaporator_problem(),
    "fast-sampling": evaporator_problem(sampling_time=6.0),
    "undiscounted": evaporator_problem(discount=1.0),
    "short-sighted": evaporator_problem(discount=0.7),
}


@pytest.fixture(scope="module", params=PROBLEMS)
def tuning(request):
    return PROBLEMS[request.param], tune(PROBLEMS[request.param])


def long_economic_problem(problem, horizon=400):
    """The economic problem itself over a long horizon, by IPOPT: s -> first action and cost."""
    model = problem.model
    steady = optimal_steady_state(problem)
    x, u = ca.MX.sym("x", 2, horizon + 1), ca.MX.sym("u", 2, horizon)
    s = ca.MX.sym("s", 2)
    d = ca.repmat(ca.DM(model.nominal_disturbance), 1, horizon)
    p = ca.repmat(ca.DM(model.nominal_parameters), 1, horizon)
    step = discretise(model, problem.sampling_time, problem.substeps).map(horizon)
    costs = economic_cost(model).map(horizon)(x[:, :-1], u, d, p)
    w = ca.vertcat(ca.vec(x), ca.vec(u))
    gaps = ca.vec(step(x[:, :-1], u, d, p) - x[:, 1:])
    nlp = {
        "x": w,
        "f": ca.sum2(costs) - horizon * steady.cost,
        "g": ca.vertcat(x[:, 0] - s, gaps, x[:, -1] - steady.x),
        "p": s,
    }
    options = {"print_level": 0, "sb": "yes", "tol": 1e-11, "bound_relax_factor": 0.0}
    solver = ca.nlpsol("long", "ipopt", nlp, {"ipopt": options, "print_time": False})
    lower = np.tile(problem.state_lower, horizon + 1)
    lower[:2] = -np.inf
    lower = np.concatenate([lower, np.tile(problem.action_lower, horizon)])
    guess = np.concatenate([np.tile(steady.x, horizon + 1), np.tile(steady.u, horizon)])

    def solve(state):
        found = solver(x0=guess, lbx=lower, lbg=0, ubg=0, p=state)
        assert solver.stats()["success"]
        return found["x"].full()[2 * (horizon + 1) :, 0][:2], float(found["f"])

    return solve


def test_steady_state_is_the_papers():
    steady = optimal_steady_state(PROBLEMS["paper"])
    np.testing.assert_allclose(steady.x, [25.0, 49.74297], atol=1e-5)
    np.testing.assert_allclose(steady.u, [191.71322, 215.88844], atol=1e-5)
    assert steady.cost == pytest.approx(6210.3845, abs=1e-4)
    assert steady.active == ("X2 ≥ 25 %",)
    np.testing.assert_allclose(steady.multipliers, [60.29, 0, 0, 0], atol=2e-3)


def test_certificate_holds(tuning):
    _, result = tuning
    steady, convex = result.steady_state, result.convexification
    rebuilt = (
        steady.hessian
        + rotation(steady.A, steady.B, convex.delta_P)
        + steady.C.T @ convex.F @ steady.C
    )
    np.testing.assert_allclose(convex.hessian, rebuilt, atol=1e-9)
    least, *_, largest = np.linalg.eigvalsh(convex.hessian)
    assert least >= (1 - 1e-5) / convex.alpha
    assert largest <= (1 + 1e-5) * convex.beta / convex.alpha
    assert np.linalg.eigvalsh(steady.hessian)[0] < -1.0
    assert np.linalg.eigvalsh(result.parameters["B_Vf"])[0] > 0
    assert result.gain_error < 1e-8
    assert "X2 ≥ 25 %" in str(result)


def test_the_published_procedure_gives_the_published_hessian():
    # ρ = 1e-3 and 20 Runge–Kutta steps a sample.
    found = tune(PROBLEMS["paper"]).convexification.hessian
    assert np.diag(found) == pytest.approx([1.5310e-2, 1.0848e-2, 9.2506e-5, 4.5407e-3], rel=5e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "fast-sampling"])
def test_the_tunings_model_is_integrated_to_a_hundred_millionth(name):
    problem = PROBLEMS[name]
    exact = optimal_steady_state(replace(problem, substeps=100))
    found = tune(problem).steady_state
    for one, other in ((found.A, exact.A), (found.B, exact.B)):
        assert one == pytest.approx(other, rel=1e-8, abs=1e-8)


def test_without_the_active_constraint_there_is_no_solution():
    steady = optimal_steady_state(PROBLEMS["paper"])
    none = np.zeros((0, 4))
    with pytest.raises(TuningError):
        convexify(steady.A, steady.B, steady.hessian, none)


@pytest.mark.slow
def test_economic_gain_is_that_of_the_nonlinear_economic_problem():
    # The oracle is to have the tuning's integrator, not the controller's coarser one.
    problem = replace(PROBLEMS["paper"], substeps=8)
    gain, solve = tune(problem).economic, long_economic_problem(problem)
    s = problem.reference_state
    np.testing.assert_allclose(solve(s)[0], problem.reference_action, atol=1e-5)
    for i in range(2):
        above, below = (solve(s + step * np.eye(2)[i])[0] for step in (1e-2, -1e-2))
        np.testing.assert_allclose((above - below) / 2e-2, gain[:, i], rtol=1e-5, atol=1e-5)


def test_rtis_local_feedback_is_the_economic_one_for_any_discount(tuning):
    problem, result = tuning
    controller = RtiNmpc(problem, result.parameters)
    controller.prepare()
    solution = controller.feedback(problem.reference_state)
    np.testing.assert_allclose(solution.action, problem.reference_action, atol=1e-5)
    gain = result.economic
    tolerance = 1e-5 * np.abs(gain).max()
    np.testing.assert_allclose(solution.policy_state_jacobian, gain, atol=tolerance)
    for i in range(2):
        above, below = (
            controller.policy(problem.reference_state + step * np.eye(2)[i])
            for step in (1e-4, -1e-4)
        )
        np.testing.assert_allclose((above - below) / 2e-4, gain[:, i], atol=tolerance)


def test_the_terminal_cost_falls_towards_the_active_bound_by_its_multiplier():
    """∇V_f(x_s) = (60.29, 0): else the bound of the last stage is active without any force."""
    problem = PROBLEMS["paper"]
    found = tune(problem)
    theta, away = found.parameters, found.steady_state.x - problem.reference_state
    gradient = theta["b_Vf"] + 2 * theta["B_Vf"] @ away
    np.testing.assert_allclose(gradient, [60.29, 0.0], atol=2e-3)


@pytest.mark.parametrize("horizon", [1, 2])
def test_the_local_feedback_needs_no_long_horizon(horizon):
    """The terminal cost is the value of what follows, with the same active bound."""
    problem = replace(PROBLEMS["paper"], horizon=horizon)
    tuning = tune(problem)
    controller = RtiNmpc(problem, tuning.parameters)
    controller.prepare()
    solution = controller.feedback(problem.reference_state)
    assert not solution.weakly_active
    gain = tuning.economic
    np.testing.assert_allclose(solution.policy_state_jacobian, gain, atol=1e-5 * np.abs(gain).max())


def test_value_is_the_economic_one_to_second_order():
    problem = PROBLEMS["undiscounted"]
    controller = RtiNmpc(problem, tune(problem).parameters.replace({"c_lambda": 0.0}))
    controller.prepare()
    solve, direction = long_economic_problem(problem), np.array([0.6, -0.8])
    errors = []
    for step in (0.8, 0.4):
        s = problem.reference_state + step * direction
        value, (_, cost) = controller.value(s), solve(s)
        errors.append(abs(value - cost))
    # The value is about −460 and −230 there; the error of third order falls to an eighth.
    assert errors[0] < 0.2
    assert errors[1] < 0.2 * errors[0]


def test_another_reference_changes_nothing_but_the_coordinates():
    problem = PROBLEMS["paper"]
    moved = replace(
        problem,
        reference_state=problem.reference_state + np.array([0.5, 1.0]),
        reference_action=problem.reference_action + np.array([2.0, -3.0]),
    )
    actions = []
    for case in (problem, moved):
        controller = RtiNmpc(case, tune(case).parameters)
        controller.prepare_at(
            LinearisationPoint(
                np.tile(problem.reference_state, (10, 1)),
                np.tile(problem.reference_action, (10, 1)),
                np.zeros((10, 2)),
            )
        )
        actions.append(controller.policy([25.3, 50.5]))
    np.testing.assert_allclose(actions[0], actions[1], atol=1e-5)


def economic_problem(cost, ode=None, **changes):
    """A scalar plant x' = −x + u with a given cost."""
    model = Model(
        name="scalar",
        states=(Quantity("x", "1"),),
        actions=(Quantity("u", "1"),),
        disturbances=(),
        parameters=(),
        ode=ode or (lambda x, u, d, p: u - x),
        economic_cost=cost,
    )
    settings = {
        "model": model,
        "sampling_time": 0.5,
        "horizon": 5,
        "discount": 0.95,
        "state_lower": [-10],
        "state_upper": [10],
        "action_lower": [-10],
        "action_upper": [10],
        "penalty_linear": [100],
        "penalty_quadratic": [1],
        "reference_state": [0.2],
        "reference_action": [0.2],
        "reference_cost": 0.0,
    }
    return type(evaporator_problem())(**(settings | changes))


def test_unconstrained_indefinite_cost_has_the_riccati_gain():
    # −0.3 x² + u²: indefinite, yet dissipative since the plant is stable.
    problem = economic_problem(lambda x, u, d, p: -0.3 * x**2 + u**2 + u, substeps=16)
    result = tune(problem)
    steady = result.steady_state
    assert steady.active == ()
    P = scipy.linalg.solve_discrete_are(
        steady.A, steady.B, steady.hessian[:1, :1], steady.hessian[1:, 1:], s=steady.hessian[:1, 1:]
    )
    S = steady.hessian[1:, 1:] + steady.B.T @ P @ steady.B
    K = -np.linalg.solve(S, steady.B.T @ P @ steady.A + steady.hessian[1:, :1])
    np.testing.assert_allclose(result.tuned, K, atol=1e-8)
    controller = RtiNmpc(problem, result.parameters)
    controller.prepare()
    x = steady.x
    slope = (controller.policy(x + 1e-3) - controller.policy(x - 1e-3)) / 2e-3
    np.testing.assert_allclose(slope, K[0], atol=1e-6)


def test_active_actuator_bound_enters():
    problem = economic_problem(lambda x, u, d, p: (x - 5) ** 2, action_upper=[3])
    result = tune(problem)
    assert result.steady_state.active == ("u ≤ 3 1",)
    np.testing.assert_allclose(result.economic, [[0.0]], atol=1e-12)


def test_penalty_below_the_multiplier_is_refused():
    with pytest.raises(TuningError):
        tune(evaporator_problem(penalty_linear=[50, 1e5]))


def test_problem_without_steady_state_is_refused():
    problem = economic_problem(lambda x, u, d, p: u**2, ode=lambda x, u, d, p: 1 + u**2)
    with pytest.raises(TuningError):
        tune(problem)
