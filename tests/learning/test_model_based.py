"""The empirical model, its rollouts in two languages, the back-offs found on it, and the rule."""

from types import SimpleNamespace

import numpy as np
import pytest

from controllers import Problem
from controllers.factories import tuned
from cosim import Scenario
from learning import model_based
from learning.empirical_model import EmpiricalModel, Features, PlantData, Rollout
from learning.model_based import BackOffs, ExpectedCosts, ModelBased
from learning.training import run_training, to_csv
from tests.helpers.compiler import needs_compiler
from tests.helpers.training import killed_and_resumed, make_run


@pytest.fixture(scope="module")
def features(problem):
    return Features(problem)


@pytest.fixture(scope="module")
def base(scenario):
    return tuned(scenario).parameters


def plant_data(features, rng, count, error, offset=0.0):
    """Inputs about the steady state and outputs of a plant whose parameter errors are `error`."""
    inputs = rng.normal([27.0, 60.0, 220.0, 230.0], [2.0, 6.0, 20.0, 20.0], (count, 4))
    y, _, h = features(inputs, error)
    noise = rng.uniform(-0.1, 0.1, y.shape)
    return inputs, y + h * (noise + offset)


@pytest.fixture
def fitted(features, rng):
    error = -0.2 * np.eye(features.count)[0]
    return EmpiricalModel.fit(features, *plant_data(features, rng, 2000, error))


def test_the_fit_predicts_a_plant_with_another_parameter(features, rng):
    error = rng.normal(scale=0.1, size=features.count)
    model = EmpiricalModel.fit(features, *plant_data(features, rng, 4000, error))
    inputs, outputs = plant_data(features, rng, 4000, error)
    nominal, _, h = features(inputs, np.zeros(features.count))
    c, W = model.coefficients
    predicted = features(inputs, c)[0] + np.column_stack([np.ones(4000), inputs]) @ W.T
    wrong = np.abs((predicted - features(inputs, error)[0]) / h)
    assert wrong.max() < 0.03
    assert np.abs((nominal - outputs) / h).mean() > 5 * wrong.mean()
    assert np.allclose(model.residuals.std(axis=0), 0.1 / np.sqrt(3), rtol=0.05)


def test_what_the_nominal_model_knows_exactly_says_nothing_of_its_parameters(features, rng):
    inputs, outputs = plant_data(features, rng, 400, np.zeros(features.count))
    exact = features(inputs, np.zeros(features.count))[0][:, -1]
    outputs[:, -1] = exact * (1 + 1e-9 * rng.normal(size=400))
    model = EmpiricalModel.fit(features, inputs, outputs)
    assert np.abs(model.coefficients[0]).max() < 0.1


def test_exact_outputs_do_not_drown_what_noisy_ones_say(rng):
    problem = Problem.from_scenario(Scenario.load("tanks"))
    features = Features(problem)
    reference = np.concatenate([problem.reference_state, problem.reference_action])
    inputs = reference * rng.uniform(0.9, 1.1, (480, 6))
    y, _, _ = features(inputs, rng.normal(scale=0.05, size=features.count))
    model = EmpiricalModel.fit(features, inputs, y + rng.normal(size=y.shape) * [0.3, 0.3, 0, 0, 0])
    assert np.abs((model.predict(inputs)[0] - y).mean(axis=0)).max() < 0.05


def test_the_deviation_of_the_mean_cost_is_what_the_fits_scatter(features, rng):
    at = plant_data(features, rng, 50, np.zeros(features.count))[0]
    costs, deviations = [], []
    for _ in range(12):
        error = rng.normal(scale=0.15, size=features.count).clip(-0.4, 0.4)
        model = EmpiricalModel.fit(features, *plant_data(features, rng, 200, error))
        row, true = model.cost_row(at), features(at, error)[0]
        costs.append((model.predict(at)[0] - true)[:, -1].mean())
        deviations.append(np.sqrt(row @ model.covariance @ row))
    assert 0.4 < np.std(costs) / np.mean(deviations) < 1.6


def test_an_error_that_no_parameter_makes_is_fitted_too(features, rng):
    inputs, outputs = plant_data(features, rng, 8000, np.zeros(features.count))
    outputs[:, 0] += 0.2 * (inputs[:, 0] - 27.0) - 0.02 * (inputs[:, 2] - 220.0)
    model = EmpiricalModel.fit(features, inputs[:4000], outputs[:4000])
    predicted, h, _ = model.predict(inputs[4000:])
    beyond = (outputs - features(inputs, np.zeros(features.count))[0])[:4000, :-1].mean(axis=0)
    lack = model.lack(inputs[:4000], np.zeros(features.count))
    assert lack == pytest.approx(beyond, rel=0.05, abs=0.01)
    assert np.allclose(((outputs[4000:] - predicted) / h).std(axis=0), 0.1 / np.sqrt(3), rtol=0.05)


@pytest.mark.slow  # compiles the controller
@needs_compiler
def test_both_rollouts_are_one(problem, base, features, fitted, rng, monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "now")
    rollout = Rollout(problem, base, features)
    assert rollout.compiled is not None
    thetas = [base.replace({"x_l": base["x_l"] + [delta, 0.0]}).theta for delta in (0.0, 2.0, 3.0)]
    picks = rng.integers(2000, size=40, dtype=np.int32)
    compiled = rollout(thetas, np.array([30.0, 78.0]), fitted, picks)
    rollout.compiled = None
    interpreted = rollout(thetas, np.array([30.0, 78.0]), fitted, picks)
    for one, other in zip(compiled, interpreted, strict=True):
        for part, like in zip(one, other, strict=True):
            assert np.allclose(part, like, rtol=1e-9, atol=0.0)


def riding(problem, base):
    """A rollout of a loop whose first state rides its lower bound, at 10 000 of cost a unit."""
    where = base.blocks.slices["x_l"].start

    def one(theta, picks):
        predicted = np.tile([theta[where], 60.0, 0.0], (len(picks), 1))
        predicted[:, 2] = 6000.0 + 10_000.0 * (theta[where] - problem.state_lower[0])
        inputs = np.tile([theta[where], 60.0, 220.0, 230.0], (len(picks), 1))
        return inputs, predicted, np.ones((len(picks), 3))

    return lambda thetas, start, model, picks: [one(theta, picks) for theta in thetas]


@pytest.fixture
def search(problem, base, rng):
    residuals = np.column_stack([rng.uniform(-1.0, 1.0, (20_000, 1)), np.zeros((20_000, 2))])
    model = SimpleNamespace(residuals=residuals, mean=np.zeros(1), covariance=np.zeros((1, 1)))
    model.cost_row = lambda inputs: np.zeros(1)
    model.predict = lambda at: (at[:, :3] * [1.0, 1.0, 0.0], np.ones((len(at), 3)), None)
    visited = np.tile([27.0, 60.0, 220.0, 230.0], (model_based.RECENT, 1))
    visited[0, 0] = 20.0
    return BackOffs(problem, riding(problem, base), base, model, visited, 0.0, rng)


def test_the_back_off_of_a_known_loop_is_found(search):
    found = search.best(np.zeros(4), np.zeros(4), model_based.LEVELS)
    # slope = 1e5 · P(noise < −δ) at the optimum; the tails are widened by a per cent.
    assert found[0] == pytest.approx(0.8, abs=0.06)
    assert (found[1:] == 0).all()


def test_without_a_grid_the_search_begins_at_the_present_back_offs(search):
    search.best(np.array([0.7, 0.0, 0.0, 0.0]), np.zeros(4), model_based.LEVELS)
    with_grid, search.samples = search.samples, 0
    found = search.best(np.array([0.7, 0.0, 0.0, 0.0]), np.zeros(4), ())
    assert found[0] == pytest.approx(0.8, abs=0.06)
    assert search.samples < 0.8 * with_grid


def test_a_bound_that_does_not_bind_has_a_spare_back_off(search):
    search._spare = 18.0
    spared = search.best(np.zeros(4), np.zeros(4), model_based.LEVELS)
    assert spared[0] == pytest.approx(0.8, abs=0.06)
    assert spared[2] == pytest.approx(18.0 * search._unit[2], abs=0.05)


def test_a_loop_that_goes_where_the_plant_has_not_been_promises_nothing(search):
    promises = search.promises([search.theta(np.array([delta, 0, 0, 0])) for delta in (14, 20)])
    assert np.isfinite([promise.cost for promise in promises]).tolist() == [True, False]


@pytest.fixture
def rule(scenario, base, rng):
    controller = SimpleNamespace(parameters=base, theta=base.theta)
    configuration = make_run("model-based", scenario).configuration
    return ModelBased(controller, scenario, configuration, 1000, None, rng)


def test_model_parameters_of_theta_are_the_fitted_ones(rule, scenario, features, rng):
    run = make_run("model-based", scenario, {"model_parameters": ["M", "UA2"]}, start="tuned")
    start, error = run.starting_parameters(), np.zeros(features.count)
    rule._base, rule._carried = start, (where := [8, 10])
    error[where] = -0.3, 0.1
    inputs, outputs = plant_data(features, rng, 2000, error)
    model = EmpiricalModel.fit(features, inputs, outputs)
    base, gained = rule._corrected(start, model, inputs)
    assert base["p"] == pytest.approx([14.0, 7.524], rel=0.1)  # the prior pulls to 20
    error[where] = base["p"] / start["p"] - 1
    own = features(inputs, error)[0][:, :-1] + base["c_f"]
    former = features(inputs, np.zeros(features.count))[0][:, :-1]
    assert (model.predict(inputs)[0][:, :-1] - own).mean(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert gained == pytest.approx((own - former).mean(axis=0))
    few, none = rule._corrected(start, model, inputs[:50])
    assert (few["p"] == start["p"]).all() and not none.any()


def test_back_offs_shrink_little_further_than_the_plant_has_been(rule):
    present = np.array([2.0, 0.0, 0.0, 5.0])
    inputs = np.tile([26.0, 77.0, 220.0, 230.0], (200, 1))
    assert rule._least(present, inputs) == pytest.approx(present)  # it explores still
    rule._data.count = 480
    assert rule._least(present, inputs) == pytest.approx([0.7, 0.0, 0.0, 2.1])
    assert rule._least(present, inputs[:50]) == pytest.approx(present)


def test_of_a_plant_that_has_changed_no_back_off_shrinks_below_what_it_was_before(rule):
    rule._data.count, rule._era, rule._floor = 2000, 500, np.array([1.5, 0.0, 0.0, 6.0])
    inputs = np.tile([26.0, 77.0, 220.0, 230.0], (1500, 1))
    present = np.array([2.0, 0.0, 0.0, 5.0])
    assert rule._least(present, inputs[:1000]) == pytest.approx([1.5, 0.0, 0.0, 5.0])
    assert rule._least(present, inputs) == pytest.approx([0.7, 0.0, 0.0, 2.1])


def filled(rule, inputs, outputs, model):
    """The rule's data with these samples, all since the fit of the model."""
    data = rule._data
    data._rows[: len(inputs)] = np.column_stack([inputs, outputs])
    data.count, data.era, data.model, data._judged = len(inputs), 0, model, []
    return data


def test_a_change_of_the_plant_is_seen_and_its_absence_not(rule, features, fitted, rng):
    error = -0.2 * np.eye(features.count)[0]
    for offset, window in ((0.0, 0), (0.3, 15)):
        data = filled(rule, *plant_data(features, rng, 240, error, offset), fitted)
        assert rule._alarmed(fitted) == bool(window)
        assert data.count - data.era == (window or 240)


def test_data_from_before_a_slow_change_are_dropped(features, rng):
    error, parts = np.zeros(features.count), []
    for _ in range(4):
        parts.append(plant_data(features, rng, 500, error.copy()))
        error[0] -= 0.01
    inputs, outputs = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    same = np.concatenate([parts[0][0]] * 4), np.concatenate([parts[0][1]] * 4)
    data = PlantData(features, 2000)
    assert (data._outdated(inputs, outputs), data._outdated(*same)) == (750, 0)


def test_a_plant_that_nears_its_bound_breaks_the_promise(rule, features, fitted, rng):
    error = -0.2 * np.eye(features.count)[0]
    inputs, outputs = plant_data(features, rng, 240, error)
    cost = ExpectedCosts(rule._problem, fitted)(*fitted.predict(inputs)[:2])[0].mean()
    data = filled(rule, inputs, outputs, fitted)
    for factor, broken in ((1.01, False), (0.99, True)):
        rule._limits = np.array([np.inf, np.inf, factor * cost, np.inf])
        assert (rule._alarmed(fitted), data.era) == (broken, 0)


@pytest.mark.parametrize(
    ("present", "back_off", "moves"),
    [(3.0, 9.0, False), (0.0, 3.0, True)],
    ids=["dearer", "cheaper"],
)
def test_theta_moves_only_where_the_model_promises_less(
    scenario, base, tmp_path, monkeypatch, interpreted, present, back_off, moves
):
    """Six more per cent of X2 cost 360 and save nothing; the first three save the penalty."""
    start = str(tmp_path / "start.toml")
    base.replace({"x_l": base["x_l"] + [present, 0.0]}).save(start)
    smaller = {"BURN": 5, "COARSE": 25, "FINE": 60}
    for name, value in smaller.items():
        monkeypatch.setattr(model_based, name, value)
    proposed = np.array([back_off, 0.0, 0.0, 0.0])
    monkeypatch.setattr(BackOffs, "best", lambda *arguments: proposed)
    every = {"samples": 40, "log_every": 40, "evaluate_every": 40, "checkpoint_every": 40}
    settings = {"first_update": 30, "exploration_samples": 1}
    run = make_run("model-based", scenario, settings, start=start, **every)
    done = run_training(run)
    (row,) = done.rows
    assert (row["updates"], row["refused"]) == (1, 1 - moves)
    assert np.array_equal(done.parameters.theta, done.start.theta) != moves
    if moves:
        assert done.parameters["x_l"][0] == pytest.approx(scenario.state_lower[0] + back_off)


def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(scenario, tmp_path, monkeypatch):
    smaller = {"BURN": 5, "COARSE": 25, "FINE": 30, "LEVELS": (0.0, 3.0), "SWEEPS": ((25, (1.2,)),)}
    for name, value in smaller.items():
        monkeypatch.setattr(model_based, name, value)
    every = {"samples": 60, "log_every": 20, "evaluate_every": 60, "checkpoint_every": 20}
    run = make_run("model-based", scenario, {"first_update": 15}, start="tuned", **every)
    whole = run_training(run)
    assert whole.asks_for == "operation"
    resumed = killed_and_resumed(run, tmp_path, 40)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert np.array_equal(resumed.parameters.theta, whole.parameters.theta)
    assert whole.parameters["x_l"][0] > scenario.state_lower[0]
