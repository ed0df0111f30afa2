"""The back-offs found on an empirical model, and the rule."""

from types import SimpleNamespace

import numpy as np
import pytest

from learning.known_signals import KnownSignals
from learning.log import to_csv
from learning.model_based import BackOffOnModel, ExpectedCosts, ModelBased
from learning.rollout import RolloutSamples
from learning.training import run_training
from tests.helpers.empirical import fit, plant_data
from tests.helpers.training import killed_and_resumed, make_run


def riding(problem, theta_at_start):
    """A rollout of a loop whose first state rides its lower bound, at 10 000 of cost a unit."""
    where = theta_at_start.blocks.slices["x_l"].start

    def one(theta, picks):
        predicted = np.tile([theta[where], 60.0, 0.0], (len(picks), 1))
        predicted[:, 2] = 6000.0 + 10_000.0 * (theta[where] - problem.state_lower[0])
        inputs = np.tile([theta[where], 60.0, 220.0, 230.0], (len(picks), 1))
        return RolloutSamples(inputs, predicted, np.ones((len(picks), 3)))

    return lambda thetas, start, model, picks, met: [one(theta, picks) for theta in thetas]


@pytest.fixture
def make_search(scenario, problem, tuned_theta, rng):
    residuals = np.column_stack([rng.uniform(-1.0, 1.0, (20_000, 1)), np.zeros((20_000, 2))])
    model = SimpleNamespace(residuals=residuals, mean=np.zeros(1), covariance=np.zeros((1, 1)))
    model.error_deviation = residuals.std(axis=0)
    model.persistence = np.zeros((3, 3))
    model.cost_derivative = lambda inputs: np.zeros(1)
    model.predict = lambda at: (at[:, :3] * [1.0, 1.0, 0.0], np.ones((len(at), 3)), None)

    def make(reserve):
        settings = make_run("model-based", scenario, {"reserve_back_off": reserve}).configuration
        visited = np.tile([27.0, 60.0, 220.0, 230.0], (settings.recent_samples, 1))
        visited[0, 0] = 20.0
        rollout = riding(problem, tuned_theta)
        signals = KnownSignals(scenario, problem, settings.recent_samples)
        numbers = range(len(visited))
        return BackOffOnModel(
            problem, rollout, tuned_theta, model, visited, settings, rng, signals, numbers
        )

    return make


@pytest.fixture
def search(make_search):
    return make_search(0.0)


LEVELS = (0.0, 2.0, 3.0, 7.0, 18.0, 50.0)


def test_the_back_off_of_a_known_loop_is_found(search):
    best = search.best(np.zeros(4), np.zeros(4), LEVELS)
    # slope = 1e5 · P(noise < −δ) at the optimum; the tails are widened by a per cent.
    assert best[0] == pytest.approx(0.8, abs=0.06)
    assert (best[1:] == 0).all()


def test_without_a_grid_the_search_begins_at_the_present_back_offs(search):
    search.best(np.array([0.7, 0.0, 0.0, 0.0]), np.zeros(4), LEVELS)
    with_grid = search.n_samples
    best = search.best(np.array([0.7, 0.0, 0.0, 0.0]), np.zeros(4), ())
    assert best[0] == pytest.approx(0.8, abs=0.06)
    assert search.n_samples - with_grid < 0.8 * with_grid


def test_a_bound_that_is_not_active_has_a_reserve(make_search):
    search = make_search(18.0)
    best = search.best(np.zeros(4), np.zeros(4), LEVELS)
    assert best[0] == pytest.approx(0.8, abs=0.06)
    assert best[2] == pytest.approx(18.0 * search.unit[2], abs=0.05)


def test_a_loop_that_goes_where_the_plant_has_not_been_has_no_predicted_cost(search):
    thetas = [search.theta(np.array([delta, 0, 0, 0])) for delta in (14, 20)]
    costs = [predicted.cost for predicted in search.predicted_costs(thetas)]
    assert np.isfinite(costs).tolist() == [True, False]


def made_rule(scenario, theta, rng, settings=None):
    controller = SimpleNamespace(parameters=theta, theta=theta.theta)
    configuration = make_run("model-based", scenario, settings or {}).configuration
    return ModelBased(controller, scenario, configuration, 1000, None, rng)


@pytest.fixture
def rule(scenario, tuned_theta, rng):
    return made_rule(scenario, tuned_theta, rng)


def with_state(rule, **changes):
    """The rule with some entries of its state changed; `__` stands for a dot."""
    rule.load_state_dict(
        rule.state_dict() | {name.replace("__", "."): value for name, value in changes.items()}
    )


@pytest.mark.slow
def test_model_parameters_of_theta_are_the_fitted_ones(scenario, features, rng):
    settings = {"model_parameters": ["M", "UA2"]}
    run = make_run("model-based", scenario, settings, start="tuned")
    start, error = run.starting_parameters(), np.zeros(features.n_parameters)
    rule = made_rule(scenario, start, rng, settings)
    carried = [8, 10]
    error[carried] = -0.3, 0.1
    inputs, outputs = plant_data(features, rng, 2000, error)
    model = fit(features, inputs, outputs)
    base, gained = rule.corrected(start, model, inputs)
    assert base["p"] == pytest.approx([14.0, 7.524], rel=0.1)  # the prior pulls to 20
    error[carried] = base["p"] / start["p"] - 1
    own = features(inputs, error)[0][:, :-1] + base["c_f"]
    former = features(inputs, np.zeros(features.n_parameters))[0][:, :-1]
    assert (model.predict(inputs)[0][:, :-1] - own).mean(axis=0) == pytest.approx(0.0, abs=1e-9)
    assert gained == pytest.approx((own - former).mean(axis=0))
    few, none = rule.corrected(start, model, inputs[:50])
    assert (few["p"] == start["p"]).all() and not none.any()


def test_back_offs_shrink_little_further_than_the_plant_has_been(rule):
    present = np.array([2.0, 0.0, 0.0, 5.0])
    inputs = np.tile([26.0, 77.0, 220.0, 230.0], (200, 1))
    assert rule.least_back_offs(present, inputs) == pytest.approx(present)  # it explores still
    with_state(rule, data__count=480)
    assert rule.least_back_offs(present, inputs) == pytest.approx([0.7, 0.0, 0.0, 2.1])
    assert rule.least_back_offs(present, inputs[:50]) == pytest.approx(present)


def test_of_a_plant_that_has_changed_no_back_off_shrinks_below_what_it_was_before(rule):
    floor = np.array([1.5, 0.0, 0.0, 6.0])
    with_state(rule, data__count=2000, regime_start=500, floor=floor)
    inputs = np.tile([26.0, 77.0, 220.0, 230.0], (1500, 1))
    present = np.array([2.0, 0.0, 0.0, 5.0])
    assert rule.least_back_offs(present, inputs[:1000]) == pytest.approx([1.5, 0.0, 0.0, 5.0])
    assert rule.least_back_offs(present, inputs) == pytest.approx([0.7, 0.0, 0.0, 2.1])


def test_samples_that_cost_more_than_was_predicted_call_for_an_update(
    rule, scenario, problem, features, fitted, rng
):
    error = -0.2 * np.eye(features.n_parameters)[0]
    inputs, outputs = plant_data(features, rng, 240, error)
    expected = ExpectedCosts(problem, fitted, rule.configuration)
    cost = expected(*fitted.predict(inputs)[:2])[0].mean()
    rows = np.zeros((rule.configuration.memory, 7))
    rows[:240] = np.column_stack([inputs, outputs])
    model = {f"data__model__{name}": value for name, value in fitted.state_dict().items()}
    for factor, alarmed in ((1.01, False), (0.99, True)):
        limits = np.array([np.inf, np.inf, factor * cost, np.inf])
        with_state(rule, limits=limits, data__rows=rows, data__count=240, **model)
        assert rule.alarmed(fitted) == alarmed
        assert rule.state_dict()["data.regime_start"] == 0, "the plant is the same"


@pytest.mark.parametrize(
    ("present", "back_off", "moves"),
    [(3.0, 9.0, False), (0.0, 3.0, True)],
    ids=["dearer", "cheaper"],
)
def test_theta_moves_only_where_the_model_predicts_less(
    scenario, tuned_theta, tmp_path, monkeypatch, interpreted, present, back_off, moves
):
    """Six more per cent of X2 cost 360 and save nothing; the first three save the penalty."""
    start = str(tmp_path / "start.toml")
    tuned_theta.replace({"x_l": tuned_theta["x_l"] + [present, 0.0]}).save(start)
    proposed = np.array([back_off, 0.0, 0.0, 0.0])
    monkeypatch.setattr(BackOffOnModel, "best", lambda *arguments: proposed)
    every = {"samples": 40, "log_every": 40, "evaluate_every": 40, "checkpoint_every": 40}
    rollouts = {"burn_in": 5, "coarse_rollout": 25, "fine_rollout": 60}
    settings = {"first_update": 30, "exploration_samples": 1, **rollouts}
    run = make_run("model-based", scenario, settings, start=start, **every)
    done = run_training(run)
    _, row = done.rows
    assert (row["updates"], row["refused"]) == (1, 1 - moves)
    assert np.array_equal(done.parameters.theta, done.start.theta) != moves
    if moves:
        assert done.parameters["x_l"][0] == pytest.approx(scenario.state_lower[0] + back_off)


SMALLER = {
    "burn_in": 5, "coarse_rollout": 25, "fine_rollout": 30, "back_off_levels": [0.0, 3.0],
    "coarse_factors": [1.2], "fine_factors": [], "finest_factors": [], "first_update": 15,
}  # fmt: skip


@pytest.mark.slow
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(scenario, tmp_path):
    every = {"samples": 60, "log_every": 20, "evaluate_every": 60, "checkpoint_every": 20}
    run = make_run("model-based", scenario, SMALLER, start="tuned", **every)
    whole = run_training(run)
    assert whole.requires == "operation"
    resumed = killed_and_resumed(run, tmp_path, 40)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert np.array_equal(resumed.parameters.theta, whole.parameters.theta)
    assert whole.parameters["x_l"][0] > scenario.state_lower[0]
