"""The extended Kalman filter against Gaussian conditioning, and output feedback around it."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controllers import ControllerError, ExtendedKalmanFilter, Model, OutputFeedback, Quantity
from controllers.errors import ModelError, ParameterError, QpError
from controllers.factories import build_controller, naive, nmpc
from controllers.filter_model import INITIAL_DEVIATION
from controllers.model import discretise
from controllers.problem import Problem, Varying
from controllers.theta import add_margin
from cosim import FmuPlant, Scenario, simulate
from cosim.core.protocols import Decision
from cosim.core.scenario import SensorTable
from tests.helpers.compiler import needs_compiler

RATES = np.array([[-0.02, 0.01], [0.005, -0.03]])
BY_ACTION = np.array([[0.1], [0.05]])
NOISE = np.array([0.3, 0.2])
SAMPLES = 12


def linear_model(rates=RATES, outputs=None):
    """Two states with linear rates, an action and two disturbances; the sum is an output."""
    if outputs is None:
        outputs = {"sum": lambda x, u, d, p: x[0] + 2.0 * x[1]}
    return Model(
        name="linear",
        states=(Quantity("a", "1"), Quantity("b", "1")),
        actions=(Quantity("u", "1"),),
        disturbances=(Quantity("d1", "1", 0.0, 1.0), Quantity("d2", "1", 0.0, 1.0)),
        parameters=(),
        ode=lambda x, u, d, p: ca.DM(rates) @ x + ca.DM(BY_ACTION) @ u + 0.1 * d,
        economic_cost=lambda x, u, d, p: ca.sumsqr(x) + ca.sumsqr(u),
        outputs=outputs,
    )


def linear_problem(model=None):
    """A task on the linear model, a sample of one second."""
    return Problem(
        model=linear_model() if model is None else model,
        sampling_time=1.0,
        horizon=3,
        substeps=1,
        discount=0.99,
        state_lower=np.full(2, -5.0),
        state_upper=np.full(2, 5.0),
        action_lower=np.array([-1.0]),
        action_upper=np.array([1.0]),
        penalty_linear=np.ones(2),
        penalty_quadratic=np.ones(2),
        reference_state=np.array([0.5, -0.5]),
        reference_action=np.zeros(1),
        reference_cost=0.0,
    )


sensors = st.builds(
    SensorTable,
    variable=st.just("a"),
    deviation=st.floats(0.05, 2.0),
    every=st.integers(1, 4),
    delay=st.integers(0, 3),
)


@settings(max_examples=25, deadline=None)
@given(first=sensors, second=sensors, seed=st.integers(0, 1000))
def test_it_is_gaussian_conditioning_on_all_that_arrived(first, second, seed):
    """Theory: on a linear model the filter gives the mean and covariance of x_k given all y."""
    rng = np.random.default_rng(seed)
    problem = linear_problem()
    tables = [first, second.model_copy(update={"variable": "sum"})]
    rows = np.array([[1.0, 0.0], [1.0, 2.0]])
    estimator = ExtendedKalmanFilter(problem, tables, disturbance_deviation=NOISE)

    f = discretise(problem.model, 1.0, 1)
    x, u, d, p = problem.model.symbols()
    step = f(x, u, d, p)
    A, B, G = (np.array(ca.DM(ca.jacobian(step, by)).full()) for by in (x, u, d))
    # Every x_k is an affine function of the independent (x_0, w_0, …, w_{K−1}).
    size = 2 + 2 * SAMPLES
    prior = np.concatenate(
        [np.full(2, (INITIAL_DEVIATION * 10.0) ** 2), np.tile(NOISE**2, SAMPLES)]
    )
    mean = problem.reference_state.copy()
    slope = np.zeros((2, size))
    slope[:, :2] = np.eye(2)
    means, slopes = [], []
    known_rows, known_means, known_variances, known_values = [], [], [], []
    for k in range(SAMPLES):
        means.append(mean)
        slopes.append(slope)
        y = np.full(2, np.nan)
        for i, table in enumerate(tables):
            taken = k - table.delay
            if taken < 0 or taken % table.every:
                continue
            y[i] = rng.normal(0.0, 3.0)
            known_rows.append(rows[i] @ slopes[taken])
            known_means.append(rows[i] @ means[taken])
            known_variances.append(table.deviation**2)
            known_values.append(y[i])
        estimate = estimator.correct(y)
        expected, covariance = mean, slope @ np.diag(prior) @ slope.T
        if known_rows:
            H = np.array(known_rows)
            S = H @ np.diag(prior) @ H.T + np.diag(known_variances)
            gain = slope @ np.diag(prior) @ H.T @ np.linalg.inv(S)
            expected = mean + gain @ (np.array(known_values) - np.array(known_means))
            covariance = covariance - gain @ H @ np.diag(prior) @ slope.T
        assert np.allclose(estimate, expected, rtol=0, atol=1e-9)
        assert np.allclose(estimator.covariance, covariance, rtol=0, atol=1e-9)
        a = rng.normal(size=1)
        estimator.predict(a)
        mean = A @ mean + B @ a
        slope = A @ slope
        slope[:, 2 + 2 * k : 4 + 2 * k] += G


@pytest.mark.parametrize(
    "compiles", [False, pytest.param(True, marks=[needs_compiler, pytest.mark.slow])]
)
def test_a_known_disturbance_acts_as_an_action_at_its_place(compiles):
    """Theory: where u and d enter the model alike, knowing d is as good as having applied it."""
    model = dataclasses.replace(
        linear_model(), ode=lambda x, u, d, p: ca.DM(RATES) @ x + ca.DM(BY_ACTION) @ (u + d[0])
    )
    known = Varying("feed", "disturbance", 0, 0.0)
    problems = [linear_problem(model)]
    problems.append(dataclasses.replace(problems[0], varying=(known,)))
    tables = [SensorTable(variable="a", deviation=0.3, delay=2)]
    filters = [ExtendedKalmanFilter(problem, tables) for problem in problems]
    if compiles:
        for each in filters:
            each.compile()
            assert each.functions == "compiled"
    rng = np.random.default_rng(2)
    for k in range(20):
        y = [np.nan] if k < 2 else rng.normal(size=1)
        a = rng.normal(size=1)
        d = rng.normal(size=3)
        # What is known ahead is the controller's.
        filters[1].inform({"feed": d, "another": np.ones(1)})
        assert np.allclose(filters[0].correct(y), filters[1].correct(y), rtol=1e-12, atol=1e-12)
        filters[0].predict(a + d[0])
        filters[1].predict(a)


def test_the_prediction_is_of_what_was_known_at_the_sample_before():
    problem = dataclasses.replace(
        linear_problem(), varying=(Varying("feed", "disturbance", 0, 0.0),)
    )
    estimator = ExtendedKalmanFilter(problem, [SensorTable(variable="a")])
    law = OutputFeedback(estimator, Half())
    law.reset()
    means = []
    for feed in (2.0, 5.0):
        law.inform({"feed": np.array([feed])})
        law.prepare()
        means.append(estimator.estimate)
        law.feedback([np.nan], np.zeros(1))
    f = discretise(problem.model, 1.0, 1)
    expected = f(means[0], np.zeros(1), [2.0, 0.0], [])
    assert np.allclose(means[1], np.array(expected).ravel(), rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"uncertain": ("gain",)}, "one of both"),
        ({"outputs": {"sum": lambda x, u, d, p: p[0] * x[0]}}, "cannot read 'sum'"),
    ],
)
def test_a_parameter_that_is_a_signal_is_neither_uncertain_nor_read(changes, message):
    model = dataclasses.replace(
        linear_model(),
        parameters=(Quantity("gain", "1", 1.0),),
        ode=lambda x, u, d, p: ca.DM(RATES) @ x + p[0] * ca.DM(BY_ACTION) @ u,
        **changes,
    )
    known = Varying("gain", "parameter", 0, 1.0)
    problem = dataclasses.replace(linear_problem(model), varying=(known,))
    with pytest.raises(ModelError, match=message):
        ExtendedKalmanFilter(problem, [SensorTable(variable="sum")])


def test_exact_sensors_at_each_sample_give_the_state():
    scenario = Scenario.load("paper")
    measured = scenario.replace({"sensor": [{"variable": "X2"}, {"variable": "P2"}]})
    runs = []
    for each in (scenario, measured):
        with FmuPlant(each) as plant:
            runs.append(simulate(plant, build_controller("naive", each), 60, 2))
    assert np.allclose(runs[0].actions, runs[1].actions, rtol=0, atol=2e-3)
    assert np.allclose(runs[1]["estimated[X2]"], runs[1]["X2"], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_a_wrong_parameter_is_found():
    """The plant's UA2 is 5.2, the model's 6.84: after two days of readings it is known to 10 %."""
    scenario = Scenario.load("assay-fouled")
    controller = build_controller("tuned", scenario)
    with FmuPlant(scenario) as plant:
        simulate(plant, controller, 2880, 3)
    assert abs(controller.estimator.parameters["UA2"] - 5.2) < 0.5


def test_a_growing_direction_that_no_sensor_shows_is_refused():
    growing = linear_model(rates=np.array([[-0.02, 0.0], [0.0, 0.03]]))
    with pytest.raises(ControllerError, match="direction \\+1 b"):
        ExtendedKalmanFilter(linear_problem(growing), [SensorTable(variable="a")])
    # Of two integrators their sum shows each, and not their difference.
    integrators = linear_model(
        rates=np.zeros((2, 2)), outputs={"y": lambda x, u, d, p: x[0] + x[1]}
    )
    with pytest.raises(ControllerError, match=r"direction [+-]1 a [+-]1 b"):
        ExtendedKalmanFilter(linear_problem(integrators), [SensorTable(variable="y")])
    # One that decays by itself may stay unseen.
    decaying = linear_model(rates=np.array([[-0.02, 0.0], [0.0, -0.03]]))
    ExtendedKalmanFilter(linear_problem(decaying), [SensorTable(variable="a")])


@pytest.mark.parametrize(
    ("variable", "message"),
    [("c", "neither a state nor an output"), ("u", "neither a state nor an output")],
)
def test_a_sensor_of_what_the_model_does_not_have_is_refused(variable, message):
    with pytest.raises(ModelError, match=message):
        ExtendedKalmanFilter(linear_problem(), [SensorTable(variable=variable)])


def test_an_output_of_the_action_is_refused():
    with pytest.raises(ModelError, match="depends on u or d"):
        linear_model(outputs={"y": lambda x, u, d, p: x[0] + u[0]})


@pytest.mark.parametrize("y", [[1.0], [1.0, 2.0, 3.0], [np.inf, 1.0]])
def test_readings_of_another_number_are_refused(y):
    tables = [SensorTable(variable="a"), SensorTable(variable="b")]
    with pytest.raises(ControllerError, match="y must be 2 readings"):
        ExtendedKalmanFilter(linear_problem(), tables).correct(y)


class Recorded:
    """An estimator that keeps its calls; the estimate is the number of corrections."""

    def __init__(self):
        self.calls = []
        self.estimate = np.zeros(2)

    def reset(self):
        self.calls.append("reset")

    def predict(self, a):
        self.calls.append(("predict", *a))

    def correct(self, y):
        self.calls.append(("correct", *y))


class Half:
    """A controller whose action is half of what it is fed."""

    def reset(self):
        pass

    def prepare(self):
        pass

    def feedback(self, s, a=None):
        return Decision(np.array([0.5, 0.5]) if a is None else a)


def test_the_estimator_is_told_what_was_applied():
    estimator = Recorded()
    law = OutputFeedback(estimator, Half())
    law.reset()
    law.prepare()
    law.feedback([1.0])
    # Q(s, a) of the same sample corrects no second time.
    law.feedback([1.0], np.array([7.0, 7.0]))
    law.applied(np.array([3.0, 4.0]))
    law.prepare()
    # A second preparation of a sample predicts no second time.
    law.prepare()
    law.feedback([2.0])
    law.prepare()
    assert estimator.calls == [
        "reset",
        ("correct", 1.0),
        ("predict", 3.0, 4.0),
        ("correct", 2.0),
        ("predict", 0.5, 0.5),
    ]


class Unprepared(Half):
    """Has no QP at its second sample, and says so when it prepares."""

    preparations = 0

    def prepare(self):
        self.preparations += 1
        if self.preparations == 2:
            raise QpError("told to fail", status="QP not finite")


def test_readings_are_taken_up_where_the_preparation_fails():
    """As in C: they come only once, so that without them the next estimate would be worse."""
    tables = [SensorTable(variable="a", deviation=0.1), SensorTable(variable="b", deviation=0.1)]
    alone = ExtendedKalmanFilter(linear_problem(), tables)
    law = OutputFeedback(ExtendedKalmanFilter(linear_problem(), tables), Unprepared())
    readings = np.array([[1.0, 0.0], [2.0, -1.0], [0.5, 0.5]])
    law.reset()
    for k, y in enumerate(readings):
        law.prepare()
        if k == 1:
            with pytest.raises(QpError, match="told to fail"):
                law.feedback(y)
            law.resume()
        else:
            law.feedback(y)
        if k > 0:
            alone.predict([0.25])
        alone.correct(y)
        assert np.array_equal(law.estimate, alone.estimate)
        law.applied(np.array([0.25]))


def with_margin(scenario, factors):
    """The naive controller with a block `margin`, behind the scenario's filter."""
    parameters = naive(scenario).parameters
    parameters = add_margin(parameters, Problem.from_scenario(scenario))
    controller = nmpc(scenario, parameters.replace({"margin": factors}))
    return OutputFeedback.from_scenario(scenario, controller)


def test_a_margin_is_the_same_as_bounds_moved_by_deviations_of_the_estimate():
    """Small behind a reading, then growing; at each sample the plain QP with those bounds."""
    scenario = Scenario.load("assay")
    factors = np.array([1.8, 0.0, 0.0, 0.5])
    law = with_margin(scenario, factors)
    plain = naive(scenario)
    start = plain.parameters
    deviations = []
    law.reset()
    for k in range(20):
        y = np.array([26.0 if k % 15 == 0 else np.nan, 50.0])
        law.prepare()
        point = law.linearisation_point
        ours = law.feedback(y)
        deviation = np.sqrt(np.maximum(law.estimator.covariance.diagonal(), 0.0))
        lower = start["x_l"] + factors[:2] * deviation
        upper = start["x_u"] - factors[2:] * deviation
        plain.parameters = start.replace({"x_l": lower, "x_u": upper})
        plain.prepare_at(point)
        theirs = plain.feedback(law.estimate)
        assert ours.value == pytest.approx(theirs.value, rel=1e-12)
        np.testing.assert_allclose(ours.action, theirs.action, rtol=0, atol=1e-10)
        deviations.append(deviation[0])
    # X2 is read exactly at the samples 0 and 15, and less and less known in between.
    assert deviations[0] < 1e-3 and deviations[15] < 1e-3
    assert np.all(np.diff(deviations[:15]) > 0.0)
    assert deviations[14] > 1.0


def test_margins_leave_bounds_that_do_not_cross():
    """However far the estimate is off, each gives way by a quarter of the width at most."""
    scenario = Scenario.load("assay")
    law = with_margin(scenario, np.full(4, 1e6))
    law.reset()
    law.prepare()
    solution = law.feedback([np.nan, np.nan])
    widths = scenario.state_upper - scenario.state_lower
    place = law.parameters.blocks.slices["x_l"]
    found = solution.prepared.part("theta")[place]
    np.testing.assert_allclose(found, scenario.state_lower + widths / 4, rtol=1e-14)
    # What is limited follows no factor.
    assert not solution.value_gradient[law.parameters.blocks.slices["margin"]].any()


def test_a_margin_is_refused_where_nothing_says_how_far_the_estimate_is_off():
    scenario = Scenario.load("assay")
    law = with_margin(scenario, np.zeros(4))
    parameters = law.parameters
    with pytest.raises(ParameterError, match="extended Kalman filter"):
        OutputFeedback(Recorded(), law.controller)
    for other, kind in ((Scenario.load("paper"), "rti"), (scenario, "converged")):
        with pytest.raises(ParameterError, match=r"\[\[sensor\]\] and the controller rti"):
            nmpc(other, parameters, kind)
