"""Signals along the horizon: the QP against one built by hand, derivatives by differences."""

from functools import partial

import casadi as ca
import numpy as np
import pytest
import qpsolvers

from controllers import ControllerError, ConvergedNmpc, Parameters, Problem, RtiNmpc
from controllers.economic import tune
from controllers.errors import ModelError
from controllers.rti import nmpc
from controllers.theta import ThetaBlocks
from cosim import Scenario

HORIZON = 3
MODEL = {"model": "controllers.evaporator:priced_model", "horizon": HORIZON}
SIGNALS = {
    "cooling": {"model": "T200"},
    "condenser": {"model": "UA2"},
    "steam": {"model": "steam_price"},
    "least": {"bound": "x_l[X2]"},
    "most": {"bound": "x_u[P2]"},
    "target": {"reference": "P2"},
}
NOMINAL = {
    "cooling": 25.0, "condenser": 6.84, "steam": 600.0, "least": 25.0, "most": 80.0,
    "target": 49.74297463837443,
}  # fmt: skip
DEVIATION = {
    "cooling": 4.0, "condenser": 0.5, "steam": 200.0, "least": 1.5, "most": 20.0, "target": 2.0,
}  # fmt: skip
STATE = np.array([25.4, 55.0])


def scenario(names=tuple(SIGNALS)):
    """`paper` with a short horizon, some of the signals known along it."""
    tables = []
    for name in names:
        table = {"name": name, "values": [NOMINAL[name]], "period": 60.0, "known": "preview"}
        tables.append(table | SIGNALS[name])
    changes = {"controller": MODEL}
    if tables:
        changes["signal"] = tables
    return Scenario.load("paper").replace(changes)


def tuned(problem, parameters=()):
    """θ of the tuned cost, with slack weights and model parameters in it."""
    blocks = ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=parameters)
    start = tune(problem).parameters
    return start.placed_in(Parameters.naive(problem, blocks))


def drawn_signals(seed):
    """Values of every signal at the stages 0 … N."""
    rng = np.random.default_rng(seed)
    values = {}
    for name, nominal in NOMINAL.items():
        values[name] = nominal + DEVIATION[name] * rng.uniform(-1.0, 1.0, HORIZON + 1)
    return values


def moved_point(controller, seed):
    """A point of linearisation that is not the reference."""
    rng = np.random.default_rng(seed)
    controller.prepare()
    point = controller.linearisation_point
    return point._replace(
        x=point.x + rng.uniform(-1.0, 1.0, point.x.shape),
        u=point.u + rng.uniform(-10.0, 10.0, point.u.shape),
        costates=point.costates + rng.uniform(-50.0, 50.0, point.costates.shape),
    )


def next_state(problem, x, u, d, p):
    """Classical Runge–Kutta steps of the model over a sample."""
    model = problem.model
    h = problem.sampling_time / model.time_unit / problem.substeps
    for _ in range(problem.substeps):
        k1 = model.ode(x, u, d, p)
        k2 = model.ode(x + h / 2 * k1, u, d, p)
        k3 = model.ode(x + h / 2 * k2, u, d, p)
        k4 = model.ode(x + h * k3, u, d, p)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def value_by_hand(problem, theta, point, signals, s):  # noqa: PLR0915
    """V(s) and π(s) of the Gauss–Newton QP in x_1 … x_N, u_0 … u_{N−1} and the slack, by quadprog.

    In absolute states and actions, whose units are tens, so that no scaling is needed.
    """
    n, m, N, gamma = 2, 2, HORIZON, problem.discount
    model = problem.model
    x, u, d, p = model.symbols()
    following = next_state(problem, x, u, d, p)
    w = ca.vertcat(x, u)
    dynamics = ca.Function("f", [x, u, d, p], [following, ca.jacobian(following, w)])
    cost = model.economic_cost(x, u, d, p)
    economics = ca.Function("l", [x, u, d, p], [cost, ca.gradient(cost, w)])
    size = N * (n + m) + N * n
    P, c, constant = np.zeros((size, size)), np.zeros(size), 0.0
    E, e, G, h = [], [], [], []

    def select(rows, first):
        matrix = np.zeros((rows, size))
        matrix[:, first : first + rows] = np.eye(rows)
        return matrix

    # Each of x_k, u_k as an affine function of the variables; x_0 is given.
    states = [(np.zeros((n, size)), s)]
    states += [(select(n, k * n), np.zeros(n)) for k in range(N)]
    actions = [select(m, N * n + k * m) for k in range(N)]
    slacks = [select(n, N * (n + m) + k * n) for k in range(N)]

    def add(matrix, offset, B, b, weight):
        nonlocal P, c, constant
        P += 2 * weight * matrix.T @ B @ matrix
        c += weight * matrix.T @ (2 * B @ offset + b)
        constant += weight * (offset @ B @ offset + b @ offset)

    for k in range(N + 1):
        reference = problem.reference.copy()
        reference[1] = signals["target"][k]
        X, offset = states[k]
        if k == N:
            add(X, offset - reference[:n], theta["B_Vf"], theta["b_Vf"], gamma**N)
            break
        W = np.vstack([X, actions[k]])
        at = np.concatenate([offset, np.zeros(m)])
        add(W, at - reference, theta["B_l"], theta["b_l"], gamma**k)
        disturbance = model.nominal_disturbance
        disturbance[3] = signals["cooling"][k]
        parameters = theta.of_model(model)
        parameters[10] = signals["condenser"][k]
        nominal = parameters.copy()
        parameters[15] = signals["steam"][k]
        here = np.concatenate([point.x[k], point.u[k]])
        dear, dear_slope = economics(here[:n], here[n:], disturbance, parameters)
        usual, usual_slope = economics(here[:n], here[n:], disturbance, nominal)
        slope = (dear_slope - usual_slope).full().reshape(-1)
        c += gamma**k * slope @ W
        constant += gamma**k * (float(dear - usual) + slope @ (at - here))
        value, jacobian = dynamics(here[:n], here[n:], disturbance, parameters)
        A, B = jacobian.full()[:, :n], jacobian.full()[:, n:]
        r = value.full().reshape(-1) - A @ here[:n] - B @ here[n:] + theta["c_f"]
        E.append(states[k + 1][0] - A @ X - B @ actions[k])
        e.append(A @ offset + r)
        t = slacks[k]
        weight = gamma ** (k + 1)
        c += weight * theta["w_sigma"] @ t
        P += 2 * weight * t.T @ np.diag(theta["W_sigma"]) @ t
        lower = theta["x_l"] + [signals["least"][k + 1] - 25.0, 0.0]
        upper = theta["x_u"] + [0.0, signals["most"][k + 1] - 80.0]
        G += [-states[k + 1][0] - t, states[k + 1][0] - t, -t, actions[k], -actions[k]]
        h += [-lower, upper, np.zeros(n), problem.action_upper, -problem.action_lower]
    xi = s - problem.reference_state
    constant += xi @ theta["B_lambda"] @ xi + theta["b_lambda"] @ xi + theta["c_lambda"]
    bounds = np.array([[signals["least"][0], 40.0], [100.0, signals["most"][0]]])
    outside = np.maximum(np.maximum(bounds[0] - s, s - bounds[1]), 0.0)
    constant += problem.penalty_linear @ outside + problem.penalty_quadratic @ outside**2
    z = qpsolvers.solve_qp(
        P, c, np.vstack(G), np.concatenate(h), np.vstack(E), np.concatenate(e), solver="quadprog"
    )
    return 0.5 * z @ P @ z + c @ z + constant, z[N * n : N * n + m]


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_the_qp_is_that_of_a_hand_with_other_values_at_each_stage(seed):
    problem = Problem.from_scenario(scenario())
    theta = tuned(problem)
    signals = drawn_signals(seed)
    controller = RtiNmpc(problem, theta)
    controller.inform(signals)
    point = moved_point(controller, seed)
    controller.prepare_at(point)
    solution = controller.feedback(STATE)
    value, action = value_by_hand(problem, theta, point, signals, STATE)
    assert solution.value == pytest.approx(value, rel=1e-8)
    assert solution.action == pytest.approx(action, rel=1e-8)


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize(
    "enforced", [None, pytest.param(np.array([200.0, 210.0]), marks=pytest.mark.slow)]
)
def test_derivatives_are_those_by_differences(hessian, enforced):
    problem = Problem.from_scenario(scenario())
    theta = tuned(problem, ("C", "lambda_s"))
    controller = RtiNmpc(problem, theta, hessian=hessian)
    controller.inform(drawn_signals(8))
    point = moved_point(controller, 8)
    rng = np.random.default_rng(8)
    direction = theta.blocks.scale * rng.uniform(-1.0, 1.0, theta.theta.size)

    def at(step):
        controller.theta = theta.theta + step * direction
        controller.prepare_at(point)
        return controller.feedback(STATE, enforced)

    def difference(read, step=2e-5):
        near = read(at(step)) - read(at(-step))
        far = read(at(2 * step)) - read(at(-2 * step))
        return (8 * near - far) / (12 * step)

    solution = at(0.0)
    slope = solution.value_gradient @ direction
    assert slope == pytest.approx(difference(lambda found: found.value), rel=1e-6)
    if enforced is None:
        moved = solution.policy_jacobian @ direction
        expected = difference(lambda found: found.action)
        assert moved == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", SIGNALS)
def test_nominal_values_change_nothing(name):
    without = Problem.from_scenario(scenario(()))
    problem = Problem.from_scenario(scenario((name,)))
    theta = tune(without).parameters
    solutions = []
    for each in (without, problem):
        controller = RtiNmpc(each, theta)
        controller.inform({name: np.array([NOMINAL[name]])})
        controller.prepare()
        solutions.append(controller.feedback(STATE))
    still, varying = solutions
    assert varying.value == pytest.approx(still.value, rel=1e-13)
    assert varying.action == pytest.approx(still.action, rel=1e-13)


@pytest.mark.slow
def test_a_bound_that_is_known_to_move_is_that_of_a_scenario_with_it():
    moved = Scenario.load("paper").replace({"controller": {"horizon": HORIZON}})
    moved = moved.replace({"bounds": {"state_lower": [27.0, 40.0]}})
    other = Problem.from_scenario(moved)
    problem = Problem.from_scenario(scenario(("least",)))
    theta = tune(problem).parameters
    first = RtiNmpc(problem, theta)
    first.inform({"least": np.array([27.0])})
    second = RtiNmpc(other, theta.replace({"x_l": [27.0, 40.0]}))
    for controller in (first, second):
        controller.prepare()
    one, two = first.feedback(STATE), second.feedback(STATE)
    assert one.value == pytest.approx(two.value, rel=1e-9)
    assert one.action == pytest.approx(two.action, rel=1e-9)


def test_beyond_what_is_known_the_last_value_holds():
    problem = Problem.from_scenario(scenario(("steam",)))
    controller = RtiNmpc(problem, tune(problem).parameters)
    values = []
    for known in ([500.0, 700.0], [500.0, 700.0, 700.0], [500.0] + 9 * [700.0]):
        controller.inform({"steam": np.array(known)})
        controller.prepare()
        values.append(controller.value(STATE))
    assert values[0] == values[1] == values[2]


@pytest.mark.slow
def test_the_converged_programme_takes_signals_too():
    problem = Problem.from_scenario(scenario())
    theta = tuned(problem)
    signals = drawn_signals(3)
    converged = ConvergedNmpc(problem, theta)
    converged.inform(signals)
    converged.prepare()
    solution = converged.feedback(STATE)
    # The Gauss–Newton QP at the solution has it for its own solution.
    controller = RtiNmpc(problem, theta)
    controller.inform(signals)
    controller.prepare_at(solution.unshifted)
    assert controller.feedback(STATE).action == pytest.approx(solution.action, abs=1e-6)


def test_what_is_not_known_or_no_number_is_refused():
    problem = Problem.from_scenario(scenario(("steam",)))
    controller = RtiNmpc(problem, tune(problem).parameters)
    with pytest.raises(ControllerError, match="nothing is known of the problem's signal 'steam'"):
        controller.inform({})
    with pytest.raises(ControllerError, match="must be known by finite values"):
        controller.inform({"steam": np.array([600.0, np.nan])})
    unknown = scenario(("steam",)).to_dict()
    unknown["signal"][0]["model"] = "steam_prize"
    with pytest.raises(ModelError, match=r"no disturbance or parameter 'steam_prize'.*steam_price"):
        Problem.from_scenario(Scenario.from_dict(unknown))
    with pytest.raises(ModelError, match="UA2, which is in θ too"):
        RtiNmpc(*_with_condenser_in_theta())


def _with_condenser_in_theta():
    problem = Problem.from_scenario(scenario(("condenser",)))
    return problem, tuned(problem, ("UA2",))


@pytest.mark.slow
@pytest.mark.parametrize("stagewise", [False, True])
def test_compiled_code_gives_what_the_interpreter_gives(monkeypatch, stagewise):
    monkeypatch.setenv("COSIM_COMPILE", "now")
    if stagewise:
        compiled = partial(nmpc.Engine.compile, stagewise=True)
        monkeypatch.setattr(nmpc.Engine, "compile", compiled)
    problem = Problem.from_scenario(scenario())
    theta = tuned(problem, ("C",))
    signals = drawn_signals(5)
    solutions = []
    for is_compiled in (False, True):
        controller = RtiNmpc(problem, theta)
        if is_compiled:
            controller.compile()
            if controller.functions != "compiled":
                pytest.skip("there is no C compiler")
        controller.inform(signals)
        controller.prepare_at(moved_point(controller, 5))
        for a in (None, np.array([200.0, 210.0])):
            solutions.append(controller.feedback(STATE, a))
    for one, other in zip(solutions[:2], solutions[2:], strict=True):
        assert other.iterations is not None
        # DAQP's accuracy, not rounding.
        assert other.value == pytest.approx(one.value, rel=1e-9)
        assert other.action == pytest.approx(one.action, rel=1e-9)
        assert other.value_gradient == pytest.approx(one.value_gradient, rel=1e-8, abs=1e-7)
    expected = solutions[0].policy_jacobian
    assert solutions[2].policy_jacobian == pytest.approx(expected, rel=1e-7, abs=1e-9)
