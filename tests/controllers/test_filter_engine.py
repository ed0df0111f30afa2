"""The compiled filter against the interpreted one, and what becomes of it without a compiler."""

from dataclasses import replace

import numpy as np
import pytest

from controllers import ExtendedKalmanFilter, OutputFeedback, compile_functions, functions
from controllers.errors import ControllerError, ModelWarning
from controllers.factories import naive
from controllers.filter_engine import FilterEngine
from cosim import Scenario
from cosim.core.scenario import SensorTable
from tests.controllers.test_estimator import linear_model, linear_problem
from tests.helpers.compiler import needs_compiler

SAMPLES = 500
SENSORS = {
    "each sample": [{"variable": "X2", "deviation": 0.2}, {"variable": "P2", "deviation": 0.5}],
    "slow and late": [
        {"variable": "X2", "every": 5, "delay": 7, "deviation": 0.2},
        {"variable": "P2", "deviation": 0.5},
    ],
    "exact": [{"variable": "P2", "every": 2}, {"variable": "X2", "delay": 1}],
}
SHARE_MISSING = 0.2


@pytest.fixture(autouse=True)
def compiled_fast(monkeypatch):
    """Without contraction each level gives the same digits, and this one in a tenth of the time."""
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    monkeypatch.setattr(functions, "FLAGS", ("-O0", *functions.FLAGS[1:]))


def pair(scenario, *, differentiates):
    """The filter of a scenario, compiled and interpreted."""
    filters = []
    for _ in range(2):
        made = ExtendedKalmanFilter.from_scenario(scenario, differentiates=differentiates)
        filters.append(made)
    filters[0].compile()
    assert [each.functions for each in filters] == ["compiled", "interpreted"]
    return filters


def samples_of(scenario, rng):
    """Readings about the reference as they arrive, a share of them missing, and random actions."""
    readings = scenario.reference_state + rng.normal(0.0, 0.5, (SAMPLES, 2))
    for i, sensor in enumerate(scenario.sensors):
        k = np.arange(SAMPLES) - sensor.delay
        readings[(k < 0) | (k % sensor.every != 0), i] = np.nan
    readings[rng.random(readings.shape) < SHARE_MISSING] = np.nan
    actions = scenario.reference_action + rng.normal(0.0, 10.0, (SAMPLES, 2))
    return readings, actions


@needs_compiler
@pytest.mark.parametrize(
    "sensors",
    [
        "slow and late",
        pytest.param("each sample", marks=pytest.mark.slow),
        pytest.param("exact", marks=pytest.mark.slow),
    ],
)
def test_it_is_the_interpreted_filter(sensors):
    """State, covariance, likelihood and derivatives over 500 samples, and where it is put back."""
    scenario = Scenario.load("assay").replace({"sensor": SENSORS[sensors]})
    ours, theirs = pair(scenario, differentiates=True)
    readings, actions = samples_of(scenario, np.random.default_rng(4))
    sizes = np.tile(ours.model.start_deviation, ours.model.n_kept)
    for each in (ours, theirs):
        each.noise = each.noise + np.linspace(-1.0, 1.0, each.noise.size)
    estimates = np.empty((2, SAMPLES, 2))
    standardised = np.empty((2, SAMPLES, 2))
    for k, (y, a) in enumerate(zip(readings, actions, strict=True)):
        for i, each in enumerate((ours, theirs)):
            estimates[i, k] = each.correct(y)
            standardised[i, k] = each.standardised
            each.predict(a)
        if k == SAMPLES // 2:
            state = ours.state_dict()
            ours.predict(a)
            ours.load_state_dict(state)
            theirs.load_state_dict(state)
    assert np.allclose(*estimates, rtol=1e-12, atol=0)
    assert np.allclose(*standardised, rtol=0, atol=1e-9, equal_nan=True)
    one, other = ours.state_dict(), theirs.state_dict()
    assert np.abs((one["states"] - other["states"]).ravel() / sizes).max() < 1e-11
    outer = np.outer(sizes, sizes)
    assert np.abs((one["covariance"] - other["covariance"]) / outer).max() < 1e-13
    for name in ("states_by_noise", "covariance_by_noise"):
        size = np.abs(other[name]).max(axis=(1, 2), keepdims=True)
        assert np.abs((one[name] - other[name]) / size).max() < 1e-9, name
    assert np.isclose(ours.log_likelihood, theirs.log_likelihood, rtol=1e-11, atol=0)
    by_noise = [each.sensitivities.log_likelihood for each in (ours, theirs)]
    assert np.allclose(*by_noise, rtol=1e-9, atol=1e-9)


@needs_compiler
def test_a_prediction_that_is_not_finite_forgets_every_reading():
    scenario = Scenario.load("assay")
    for each in pair(scenario, differentiates=False):
        each.correct([26.0, 49.0])
        each.predict([np.nan, 200.0])
        assert np.array_equal(each.estimate, scenario.reference_state)
        assert np.isnan(each.log_likelihood)
        assert np.isfinite(each.correct([26.0, 49.0])).all()


@needs_compiler
@pytest.mark.parametrize("y", [[1.0, 2.0, 3.0], [np.nan, -np.inf]])
def test_readings_of_another_number_are_refused(y):
    ours, _ = pair(Scenario.load("assay"), differentiates=False)
    before = ours.state_dict()
    with pytest.raises(ControllerError, match="y must be 2 readings"):
        ours.correct(y)
    for name, array in ours.state_dict().items():
        assert np.array_equal(array, before[name]), name


@needs_compiler
@pytest.mark.slow
def test_it_is_compiled_with_the_controller_behind_it():
    scenario = Scenario.load("assay")
    law = OutputFeedback.from_scenario(scenario, naive(scenario))
    compile_functions(law, 10)
    assert law.functions == "interpreted"
    compile_functions(law)
    assert (law.controller.functions, law.estimator.functions) == ("compiled", "compiled")
    assert law.functions == "compiled"


@needs_compiler
def test_a_library_of_other_numbers_is_refused(monkeypatch):
    estimator = ExtendedKalmanFilter.from_scenario(Scenario.load("assay"))
    right = FilterEngine.predict

    def wrong(engine):
        engine._arrays[0][-1] += 1e-3
        return right(engine)

    monkeypatch.setattr(FilterEngine, "predict", wrong)
    with pytest.warns(ModelWarning, match="the estimator is not compiled"):
        estimator.compile()
    assert estimator.functions == "interpreted"


def test_without_a_compiler_it_stays_interpreted(monkeypatch):
    monkeypatch.setattr("controllers.filter_engine.library", lambda sources: None)
    estimator = ExtendedKalmanFilter.from_scenario(Scenario.load("assay"))
    estimator.compile()
    assert estimator.functions == "interpreted"
    estimator.predict(Scenario.load("assay").reference_action)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("n_disturbances", [0, 2])
@pytest.mark.parametrize(
    "sensors",
    [
        [{"variable": "a", "deviation": 0.3}],
        [
            {"variable": "sum", "deviation": 0.3, "delay": 4},
            {"variable": "b", "deviation": 0.1, "delay": 1},
            {"variable": "a", "delay": 2},
        ],
    ],
)
def test_models_without_drifts_or_disturbances_too(n_disturbances, sensors):
    model = linear_model()
    if n_disturbances == 0:
        model = replace(model, disturbances=(), ode=lambda x, u, d, p: -0.02 * x + u[0])
    filters = []
    for _ in range(2):
        tables = [SensorTable(**sensor) for sensor in sensors]
        made = ExtendedKalmanFilter(linear_problem(model), tables, differentiates=True)
        filters.append(made)
    filters[0].compile()
    assert filters[0].functions == "compiled"
    rng = np.random.default_rng(0)
    for _ in range(200):
        y = rng.normal(0.0, 2.0, len(sensors))
        y[rng.random(len(sensors)) < 0.4] = np.nan
        a = rng.normal(size=1)
        for each in filters:
            each.correct(y)
            each.predict(a)
    one, other = (each.state_dict() for each in filters)
    for name, array in other.items():
        assert np.abs(one[name] - array).max() < 1e-12 * max(np.abs(array).max(), 1.0), name
