"""What a rule on a model knows of signals, and the rollouts that meet them."""

from types import SimpleNamespace

import numpy as np
import pytest

from controllers.factories import tuned
from controllers.problem import Problem
from cosim import FmuPlant, Scenario
from cosim.core.signals import Signals
from learning.empirical_model import Features
from learning.known_signals import KnownSignals
from learning.rollout import Rollout
from tests.helpers.compiler import needs_compiler
from tests.helpers.empirical import fit

NOISELESS = {"disturbance": {"law": "none"}}


def known_signals(scenario, capacity=20):
    return KnownSignals(scenario, Problem.from_scenario(scenario), capacity)


def sample(number, known):
    return SimpleNamespace(number=number, known=known)


def test_periodic_signals_are_known_beyond_the_samples():
    scenario = Scenario.load("set-point")
    signals = known_signals(scenario)
    signals.add(sample(236, Signals(scenario).known(236)))
    met = signals.coming(4)
    # Samples 237 to 240; of the bound that steps at 240 two samples ahead are known.
    assert met.stages[:, 0, 0].tolist() == [25.0, 25.0, 25.0, 30.0]
    assert met.stages[:, 2, 0].tolist() == [25.0, 30.0, 30.0, 30.0]
    assert (met.stages[1:, 3:, 0] == 30.0).all()
    # A sample's penalty is that of the state to which it leads.
    assert met.lower[:, 0].tolist() == [25.0, 25.0, 30.0, 30.0]
    assert met.inputs.shape == (4, 0)


def test_forecasts_are_those_of_the_latest_samples():
    scenario = Scenario.load("forecast")
    signals = known_signals(scenario, capacity=3)
    rows = {k: np.arange(11.0) + 10 * k for k in range(5)}
    for k, row in rows.items():
        signals.add(sample(k, {"feed_composition": row, "feed_temperature": -row}))
    met = signals.coming(5)
    for k, of_sample in zip([2, 3, 4, 2, 3], met.stages, strict=True):
        assert of_sample[:, 0].tolist() == rows[k].tolist()
    assert met.inputs[0].tolist() == [20.0, -20.0]


@pytest.mark.parametrize(
    ("name", "length", "expected"),
    [("prices", 1800, 1740), ("prices", 5300, 4620), ("paper", 1800, 1800)],
)
def test_a_rollout_counts_whole_periods(name, length, expected):
    signals = known_signals(Scenario.load(name))
    assert signals.whole_periods(length, burn_in=300, longest=20_000) == expected


def test_what_prices_change_is_the_plants_at_the_reference():
    scenario = Scenario.load("prices").replace(NOISELESS)
    signals = known_signals(scenario)
    # The last of a ring of no samples: the next one is the first.
    met = signals.coming(180)
    costs = []
    for task in (scenario, scenario.still):
        with FmuPlant(task) as plant:
            plant.reset(0)
            costs.append([plant.step(task.reference_action).stage_cost for _ in range(180)])
    np.testing.assert_allclose(met.costs, np.subtract(*costs), rtol=1e-6, atol=1e-6)


def test_the_nominal_model_follows_the_signals():
    """Price and measured disturbances of a sample are inputs of the model, without an error."""
    for name, entries in (("prices", [870.0]), ("forecast", [5.4, 38.0])):
        scenario = Scenario.load(name)
        problem = Problem.from_scenario(scenario)
        features = Features(problem)
        model = problem.model
        s, a = problem.reference_state, problem.reference_action
        y, _, _ = features(np.array([[*s, *a, *entries]]), np.zeros(features.n_parameters))
        p = model.nominal_parameters
        d = model.nominal_disturbance
        if name == "prices":
            p[-1] = 870.0
        else:
            d[[0, 2]] = entries
        expected = float(model.economic_cost(s, a, d, p))
        assert y[0, -1] == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow  # compiles controllers
@needs_compiler
@pytest.mark.parametrize("name", ["prices", "set-point", "forecast"])
def test_rollouts_under_signals_are_one(name, rng, monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "now")
    scenario = Scenario.load(name)
    problem = Problem.from_scenario(scenario)
    features = Features(problem)
    signals = KnownSignals(scenario, problem, 30)
    for k in range(230, 235):
        known = {item.signal: rng.normal(item.nominal, 1.0, 11) for item in problem.varying}
        signals.add(sample(k, known))
    theta = tuned(scenario).parameters
    rollout = Rollout(problem, theta, features)
    assert rollout.compiled is not None
    met = signals.coming(40)
    n_v = features.n_signals
    inputs = rng.normal([27.0, 50.0, 200.0, 220.0], 2.0, (500, 4))
    nominal = np.array([item.nominal for item in problem.varying])[:n_v]
    inputs = np.hstack([inputs, rng.normal(nominal, 1.0, (500, n_v))])
    y, _, h = features(inputs, np.zeros(features.n_parameters))
    model = fit(features, inputs, y + h * rng.uniform(-0.1, 0.1, y.shape))
    picks = rng.integers(500, size=40, dtype=np.int32)
    start = np.array([26.0, 52.0])
    (compiled,) = rollout([theta.theta], start, model, picks, met)
    rollout.compiled = None
    (interpreted,) = rollout([theta.theta], start, model, picks, met)
    for part, like in zip(compiled, interpreted, strict=True):
        np.testing.assert_allclose(part, like, rtol=1e-9)
    # Told nothing, the controller does something else.
    if name == "set-point":
        blind = met._replace(stages=np.full_like(met.stages, 25.0))
        (other,) = rollout([theta.theta], start, model, picks, blind)
        assert np.abs(other.inputs - interpreted.inputs).max() > 1.0
