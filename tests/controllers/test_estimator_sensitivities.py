"""Derivatives through the estimate: finite differences of the whole recursion, and theory."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from controllers import ExtendedKalmanFilter, Model, OutputFeedback, Parameters, Quantity
from controllers.errors import ParameterError
from controllers.factories import naive, nmpc
from controllers.model import discretise
from controllers.problem import Problem
from controllers.theta import add_margin
from cosim import Scenario
from cosim.core.scenario import SensorTable
from tests.helpers.compiler import needs_compiler

SAMPLES = 12


def with_noise(scenario, margin=None):
    """A naive controller whose θ has a block `noise`, behind the scenario's filter.

    With `margin` (2n,) that block, too.
    """
    estimator = ExtendedKalmanFilter.from_scenario(scenario)
    parameters = estimator.add_noise(naive(scenario).parameters)
    if margin is not None:
        parameters = add_margin(parameters, Problem.from_scenario(scenario))
        parameters = parameters.replace({"margin": margin})
    return OutputFeedback.from_scenario(scenario, nmpc(scenario, parameters))


def readings_of(sensors, values, rng):
    """Random readings about `values` (n_y,) at the samples at which the sensors' arrive."""
    rows = np.full((SAMPLES, len(sensors)), np.nan)
    for k in range(SAMPLES):
        for i, sensor in enumerate(sensors):
            taken = k - sensor.delay
            if taken >= 0 and taken % sensor.every == 0:
                rows[k, i] = values[i] + rng.normal(0.0, 0.4)
    return rows


def solutions_at(law, theta, readings, actions, point):
    """V(x̂), Q(x̂, a) of the last sample, after the whole recursion at one θ.

    Args:
        law: The controller behind its filter.
        theta: θ.
        readings: y of each sample.
        actions: What is applied.
        point: Where the last QP is linearised; None: where the recursion leads.
    """
    law.theta = theta
    law.reset()
    for y, a in zip(readings[:-1], actions[:-1], strict=True):
        law.prepare()
        law.feedback(y)
        law.applied(a)
    law.prepare()
    if point is None:
        point = law.linearisation_point
    law.prepare_at(point)
    value = law.feedback(readings[-1])
    return value, law.feedback(readings[-1], actions[-1]), point


def central_difference(function, theta, i, step=2e-2):
    """Derivative by θ_i, to the fourth order of the step."""
    direction = np.zeros(theta.size)
    direction[i] = step
    values = [function(theta + factor * direction) for factor in (-2, -1, 1, 2)]
    return (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)


def late_and_slow():
    """Evaporator: X2 seldom and late, P2 at each sample, and an output that is not linear."""
    scenario = Scenario.load("assay")
    table = [
        {"variable": "X2", "every": 5, "delay": 3, "deviation": 0.2},
        {"variable": "P2", "deviation": 0.5},
    ]
    return scenario.replace({"sensor": table})


@pytest.mark.parametrize(
    ("margin", "x_l", "functions"),
    [
        (None, [25.8, 40.0], "interpreted"),
        # Two bounds that are tightened to where the first of them is active.
        ([0.9, 0.4, 0.2, 0.3], [25.0, 40.0], "interpreted"),
        pytest.param([0.9, 0.4, 0.2, 0.3], [25.0, 40.0], "compiled", marks=needs_compiler),
    ],
)
def test_v_q_and_policy_are_differentiated_through_the_estimate(margin, x_l, functions):
    """All of it anew at each perturbed θ: the same readings and actions, the same last point."""
    rng = np.random.default_rng(3)
    scenario = late_and_slow()
    law = with_noise(scenario, margin)
    if functions == "compiled":
        law.compile()
    assert law.functions == functions
    theta = law.controller.parameters.replace({"x_l": x_l}).theta
    readings = readings_of(scenario.sensors, [25.5, 50.0], rng)
    reference = law.problem.reference_action
    actions = reference + rng.normal(0.0, 8.0, (SAMPLES, 2))
    # A Q that violates by little: large violations leave few digits to differentiate.
    actions[-1] = [310.0, 216.0]
    value, action_value, point = solutions_at(law, theta, readings, actions, None)
    assert not value.weakly_active and not action_value.weakly_active

    def results(perturbed):
        v, q, _ = solutions_at(law, perturbed, readings, actions, point)
        return np.array([v.value, q.value, *v.action])

    blocks = law.controller.parameters.blocks
    # The last blocks, what goes through the estimate; and the bounds that a margin tightens.
    place = slice(blocks.slices["x_l"].start, blocks.size)
    ours = np.vstack([value.value_gradient, action_value.value_gradient, value.policy_jacobian])
    columns = []
    for i in range(place.start, place.stop):
        # A bound that moves as far as a logarithm may meet another constraint.
        step = 2e-2 if i >= blocks.slices["noise"].start else 2e-3
        columns.append(central_difference(results, theta, i, step))
    theirs = np.column_stack(columns)
    for our, their in zip(ours[:, place], theirs, strict=True):
        assert np.allclose(our, their, rtol=1e-6, atol=1e-6 * np.abs(their).max())


def test_estimate_and_likelihood_of_a_nonlinear_filter_with_an_output():
    """dx̂/dη and the likelihood's derivative, where the reading is no linear function of z."""
    model = Model(
        name="pendulum",
        states=(Quantity("angle", "rad"), Quantity("rate", "rad/s")),
        actions=(Quantity("torque", "1"),),
        disturbances=(Quantity("gust", "1", 0.0, 1.0),),
        parameters=(Quantity("length", "m", 1.2),),
        ode=lambda x, u, d, p: ca.vertcat(
            x[1], -ca.sin(x[0]) / p[0] - 0.3 * x[1] + u[0] + d[0] * ca.cos(x[0])
        ),
        economic_cost=lambda x, u, d, p: ca.sumsqr(x) + ca.sumsqr(u),
        outputs={"height": lambda x, u, d, p: p[0] * (1 - ca.cos(x[0]))},
        uncertain=("length",),
    )
    problem = Problem(
        model=model,
        sampling_time=0.2,
        horizon=3,
        discount=0.99,
        state_lower=np.full(2, -3.0),
        state_upper=np.full(2, 3.0),
        action_lower=np.array([-1.0]),
        action_upper=np.array([1.0]),
        penalty_linear=np.ones(2),
        penalty_quadratic=np.ones(2),
        reference_state=np.array([0.4, 0.1]),
        reference_action=np.zeros(1),
        reference_cost=0.0,
    )
    sensors = [
        SensorTable(variable="height", deviation=0.05, every=2, delay=2),
        SensorTable(variable="rate", deviation=0.1),
    ]
    rng = np.random.default_rng(1)
    readings = readings_of(sensors, [0.2, 0.1], rng)
    actions = rng.normal(0.0, 0.3, (SAMPLES, 1))
    estimator = ExtendedKalmanFilter(problem, sensors, differentiates=True)
    noise = estimator.noise

    def results(perturbed):
        estimator.noise = perturbed
        estimator.reset()
        for y, a in zip(readings, actions, strict=True):
            estimator.correct(y)
            estimator.predict(a)
        return np.array([*estimator.estimate, estimator.log_likelihood])

    results(noise)
    by_noise = estimator.sensitivities
    ours = np.column_stack([by_noise.states[:, 0, :2], by_noise.log_likelihood])
    for i in range(noise.size):
        theirs = central_difference(results, noise, i, 2e-3)
        assert np.allclose(ours[i], theirs, rtol=1e-6, atol=1e-8), estimator.noise_labels[i]


def test_the_steady_filter_and_its_derivative_are_those_of_the_riccati_equation():
    """Theory: on a linear model P tends to the solution of the DARE, dP/dη to its derivative."""
    model = Model(
        name="linear",
        states=(Quantity("a", "1"), Quantity("b", "1")),
        actions=(Quantity("u", "1"),),
        disturbances=(Quantity("d1", "1", 0.0, 1.0), Quantity("d2", "1", 0.0, 1.0)),
        parameters=(),
        ode=lambda x, u, d, p: (
            ca.DM([[-0.2, 0.1], [0.05, -0.3]]) @ x + ca.vertcat(0.1 * u[0], 0.05 * u[0]) + 0.1 * d
        ),
        economic_cost=lambda x, u, d, p: ca.sumsqr(x) + ca.sumsqr(u),
        outputs={"sum": lambda x, u, d, p: x[0] + 2.0 * x[1]},
    )
    problem = Problem(
        model=model,
        sampling_time=1.0,
        horizon=3,
        discount=0.99,
        state_lower=np.full(2, -5.0),
        state_upper=np.full(2, 5.0),
        action_lower=np.array([-1.0]),
        action_upper=np.array([1.0]),
        penalty_linear=np.ones(2),
        penalty_quadratic=np.ones(2),
        reference_state=np.zeros(2),
        reference_action=np.zeros(1),
        reference_cost=0.0,
        substeps=1,
    )
    sensors = [SensorTable(variable="sum", deviation=0.3)]
    estimator = ExtendedKalmanFilter(problem, sensors, differentiates=True)
    for _ in range(150):
        estimator.predict(np.zeros(1))
        estimator.correct([0.0])
    x, u, d, p = model.symbols()
    step = discretise(model, 1.0, 1)(x, u, d, p)
    A = np.array(ca.evalf(ca.jacobian(step, x)).full())
    G = np.array(ca.evalf(ca.jacobian(step, d)).full())
    C = np.array([[1.0, 2.0]])

    def corrected(noise):
        """P after a reading, of the P before it, which solves the Riccati equation."""
        variances = np.exp(noise)
        Q = (G * variances[:2]) @ G.T
        R = np.diag(variances[2:])
        P = solve_discrete_are(A.T, C.T, Q, R)
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        return P - gain @ C @ P

    noise = estimator.noise
    assert np.allclose(estimator.covariance, corrected(noise), rtol=1e-9, atol=0)
    for i in range(noise.size):
        theirs = central_difference(corrected, noise, i, 5e-3)
        assert np.allclose(estimator.sensitivities.covariance[i], theirs, rtol=1e-6, atol=1e-12)


def test_the_block_alone_changes_no_action():
    """θ with the filter's own variances in it acts as θ without."""
    scenario = late_and_slow()
    plain = OutputFeedback.from_scenario(scenario, nmpc(scenario, naive(scenario).parameters))
    laws = (plain, with_noise(scenario))
    readings = readings_of(scenario.sensors, [25.5, 50.0], np.random.default_rng(2))
    for y in readings:
        actions = []
        for law in laws:
            law.prepare()
            actions.append(law.feedback(y).action)
        assert np.allclose(*actions, rtol=1e-8, atol=0)


def test_a_filter_goes_on_from_its_state_with_its_derivatives():
    scenario = late_and_slow()
    readings = readings_of(scenario.sensors, [25.5, 50.0], np.random.default_rng(2))
    filters = [ExtendedKalmanFilter.from_scenario(scenario, differentiates=True) for _ in range(2)]
    for k, y in enumerate(readings):
        filters[0].correct(y)
        filters[0].predict(Scenario.load("assay").reference_action)
        if k == SAMPLES // 2:
            filters[1].load_state_dict(filters[0].state_dict())
        elif k > SAMPLES // 2:
            filters[1].correct(y)
            filters[1].predict(Scenario.load("assay").reference_action)
    for name, array in filters[0].state_dict().items():
        assert np.array_equal(array, filters[1].state_dict()[name]), name


def test_a_theta_file_has_the_block_and_is_held_to_its_sensors(tmp_path):
    scenario = Scenario.load("assay")
    law = with_noise(scenario)
    theta = law.controller.parameters
    noise = theta["noise"]
    noise[-1] += 0.5
    path = theta.replace({"noise": noise}).save(tmp_path / "theta.toml")
    read = Parameters.load(path, law.problem)
    assert read.blocks == theta.blocks
    assert np.array_equal(read["noise"], noise)
    # The filter has θ's variances, those that θ is set to later, too.
    again = OutputFeedback.from_scenario(scenario, nmpc(scenario, read))
    assert np.allclose(again.estimator.noise, noise, rtol=1e-14, atol=0)
    again.theta = theta.theta
    again.prepare()
    assert np.allclose(again.estimator.noise, theta["noise"], rtol=1e-14, atol=0)

    other = scenario.replace({"sensor": [{"variable": "X2"}]})
    with pytest.raises(ParameterError, match=r"of disturbance X1, .* sensor P2; the est"):
        OutputFeedback.from_scenario(other, nmpc(other, read))
    paper = Scenario.load("paper")
    with pytest.raises(ParameterError, match="'paper' has no sensor"):
        nmpc(paper, read)
    short = path.read_text().replace('"sensor P2",\n', "")
    path.write_text(short)
    with pytest.raises(ParameterError, match="noise has shape"):
        Parameters.load(path, law.problem)
