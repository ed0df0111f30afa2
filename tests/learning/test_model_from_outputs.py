"""Filter and back-offs from readings with gaps: the parts by theory, the rule on its preset."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from controllers import ExtendedKalmanFilter, RtiNmpc
from controllers.errors import ModelWarning, QpError
from controllers.factories import tuned
from controllers.problem import Problem
from controllers.theta import add_margin
from cosim import Scenario
from cosim.core.scenario import Penalty
from cosim.core.sensors import Sensors
from cosim.core.training_options import TrainingOptions
from learning import train
from learning.errors import ConfigurationError
from learning.gaussian_penalty import expected_penalties_with_errors, normal_penalties
from learning.innovations import Stretch, fit_noise, replay
from learning.log import to_csv
from learning.model_based import ModelBasedConfiguration
from learning.model_from_outputs import BackOffsBehindFilter, FittedPlant, SimulatedCost
from learning.training import run_training
from learning.training_run import make_run
from tests.helpers.training import killed_and_resumed
from tests.helpers.training import make_run as run_of


@pytest.mark.parametrize("mean", [-2.0, 0.1, 3.0])
def test_the_expected_penalty_is_the_integral(mean):
    """Independent: numerical integration of penalty times density."""
    penalty = Penalty([0.0], [1.0], [50.0], [7.0])
    deviation = 0.8
    ours = normal_penalties(penalty, np.array([[mean]]), np.array([[deviation**2]]))

    def integrand(x):
        return penalty([x]) * norm.pdf(x, mean, deviation)

    points = [mean - 10 * deviation, 0.0, 1.0, mean + 10 * deviation]
    pieces = zip(sorted(points)[:-1], sorted(points)[1:], strict=True)
    theirs = sum(quad(integrand, low, high)[0] for low, high in pieces)
    assert np.isclose(ours.sum(), theirs, rtol=1e-9)


def test_the_expected_penalty_of_a_known_state_is_its_penalty():
    penalty = Penalty([0.0, 0.0], [1.0, 1.0], [50.0, 3.0], [7.0, 2.0])
    states = np.array([[-0.5, 0.5], [0.2, 1.7], [0.1, 0.9]])
    ours = normal_penalties(penalty, states, np.zeros_like(states))
    assert np.allclose(ours.sum(axis=0), penalty.along(states), rtol=1e-12)


def test_errors_that_were_seen_count_beside_the_normal_law():
    """In the limit of many draws of the law both are one; without any it is the normal law's."""
    penalty = Penalty([0.0], [1.0], [50.0], [7.0])
    means = np.array([[0.3], [1.4]])
    variances = np.full((2, 1), 0.5)
    normal = normal_penalties(penalty, means, variances)
    draws = norm.ppf((np.arange(20000) + 0.5) / 20000)
    both = expected_penalties_with_errors(penalty, means, variances, [draws], 1e-3)
    assert np.allclose(both, normal, rtol=1e-3)
    none = expected_penalties_with_errors(penalty, means, variances, [np.empty(0)], 60.0)
    assert np.allclose(none, normal, rtol=1e-14)
    worst = expected_penalties_with_errors(penalty, means, variances, [np.array([-9.0])], 1.0)
    seen = penalty.along(means - 9.0 * np.sqrt(variances))
    assert np.allclose(worst[0], (normal[0] + seen) / 2, rtol=1e-14)


def linear_readings(deviations, samples, seed):
    """Readings of the linear plant of the filter's own tests, with noise of known deviations."""
    from tests.controllers.test_estimator import linear_problem

    problem: Problem = linear_problem()
    scenario = Scenario.load("assay")
    tables = [
        scenario.sensors[0].model_copy(update={"variable": "a", "deviation": 0.02}),
        scenario.sensors[1].model_copy(update={"variable": "sum", "every": 3, "deviation": 0.05}),
    ]
    estimator = ExtendedKalmanFilter(problem, tables, differentiates=True)
    from controllers.model import discretise

    step = discretise(problem.model, 1.0, 1)
    rng = np.random.default_rng(seed)
    sensors = Sensors(tables)
    x = problem.reference_state
    readings = [sensors.start(seed, [x[0], x[0] + 2 * x[1]])]
    actions = rng.normal(0.0, 0.3, (samples, 1))
    for k in range(samples - 1):
        d = deviations * rng.standard_normal(2)
        x = step(x, actions[k], d, []).full()[:, 0]
        readings.append(sensors.read(k + 1, [x[0], x[0] + 2 * x[1]]))
    return estimator, np.array(readings), actions


@pytest.mark.slow
def test_the_variances_that_made_the_data_are_found():
    """Theory: on a linear plant the likelihood is exact, so that its maximiser is consistent."""
    true = np.array([0.6, 2.0])
    estimator, readings, actions = linear_readings(true, 600, 4)
    noise, innovations = fit_noise(
        estimator, [Stretch(readings, actions)], estimator.noise, 3.0, 15
    )
    truth = np.log(np.array([*true, 0.02, 0.05]) ** 2)
    assert np.abs(noise[:2] - truth[:2]).max() < 0.3
    # With the right variances the innovations are standard normal.
    assert abs(np.nanstd(innovations) - 1.0) < 0.05


@pytest.mark.parametrize("rounds", [1, 2, 15])
def test_a_fit_never_ends_worse_than_where_it_began_or_than_the_prior(rounds):
    """A line search may fail where the filter runs away; its last point is no answer."""
    estimator, readings, actions = linear_readings(np.array([0.6, 2.0]), 60, 4)
    mean = estimator.noise

    def loss(noise):
        estimator.noise = noise
        replay(estimator, Stretch(readings, actions))
        away = (noise - mean) / 1.0
        return float(away @ away) / 2 - estimator.log_likelihood

    # From variances that are far too small each reading is a surprise, and the slope is steep.
    start = mean - 3.9
    before = min(loss(start), loss(mean))
    estimator.noise = start
    noise, _ = fit_noise(estimator, [Stretch(readings, actions)], mean, 1.0, rounds)
    assert loss(noise) <= before


class Bowl:
    """A stand-in for a fitted plant, whose cost is least at 5; beyond 8 no penalty is left."""

    def run(self, theta, n_samples, burn_in):
        back_off = theta["x_l"][0] - 25.0
        penalties = np.array([max(8.0 - back_off, 0.0), 0.0, 0.0, 0.0])
        return SimulatedCost(100.0 + (back_off - 5.0) ** 2, penalties, np.ones(2))


def test_a_back_off_that_went_too_far_comes_down_to_what_is_cheapest():
    """Its penalty does not show any more, and that it does not is the back-off's merit."""
    scenario = Scenario.load("assay")
    settings = ModelBasedConfiguration.from_dict({})
    reserve = np.array([4.0, 2.0, 18.0, 2.0])
    base = tuned(scenario).parameters
    search = BackOffsBehindFilter(Bowl(), base, np.full(2, 50.0), reserve, np.zeros(2), settings)
    start = reserve + np.array([26.0, 0.0, 0.0, 0.0])
    best = search.best(start, may_shrink=True)
    assert best[0] == pytest.approx(5.0, abs=settings.back_off_step)
    assert np.array_equal(best[1:], reserve[1:])


class Valley:
    """A stand-in whose cost is least at δ = 5 and κ = 2 about a deviation of 1.5."""

    def run(self, theta, n_samples, burn_in):
        factor = theta["margin"][0]
        back_off = theta["x_l"][0] - 25.0 + 1.5 * factor
        cost = 100.0 + (back_off - 5.0) ** 2 + (factor - 2.0) ** 2
        return SimulatedCost(cost, np.array([1.0, 0.0, 0.0, 0.0]), np.ones(2))


@pytest.mark.parametrize(("may_shrink", "factor"), [(True, 2.0), (False, 0.0)])
def test_a_search_moves_what_follows_the_deviation_at_the_same_mean(may_shrink, factor):
    scenario = Scenario.load("assay")
    settings = ModelBasedConfiguration.from_dict({})
    base = add_margin(tuned(scenario).parameters, Problem.from_scenario(scenario))
    mean_deviation = np.array([1.5, 0.5])
    search = BackOffsBehindFilter(
        Valley(), base, np.full(2, 50.0), np.full(4, 1.0), mean_deviation, settings
    )
    best = search.best(np.array([3.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), may_shrink)
    np.testing.assert_allclose(best, [5.0, 1.0, 1.0, 1.0, factor, 0.0, 0.0, 0.0])
    theta = search.theta(best)
    assert theta["x_l"][0] == 25.0 + 5.0 - 1.5 * factor
    assert theta["margin"][0] == factor


class RunsAway:
    """Stands for a filter whose readings fit ever better, until it runs away with η > 0.5."""

    sensitivities = SimpleNamespace(log_likelihood=np.array([100.0]))
    standardised = np.zeros(1)

    def __init__(self, noise):
        self.noise = np.array([noise])

    def reset(self):
        pass

    def correct(self, y):
        pass

    @property
    def log_likelihood(self):
        return 100.0 * self.noise[0] if self.noise[0] < 0.5 else np.nan


NOTHING = [Stretch(np.zeros((1, 1)), np.zeros((1, 1)))]


@pytest.mark.parametrize("start", [-2.0, 0.4])
def test_variances_with_which_the_filter_runs_away_are_not_the_result(start):
    estimator = RunsAway(start)
    noise, _ = fit_noise(estimator, NOTHING, np.zeros(1), 2.0, 15)
    assert start <= noise[0] < 0.5
    assert np.isfinite(estimator.log_likelihood)


def test_where_the_filter_runs_away_from_the_start_the_prior_stands_in():
    estimator = RunsAway(0.7)
    noise, _ = fit_noise(estimator, NOTHING, np.zeros(1), 2.0, 15)
    assert noise[0] == 0.0
    assert np.isfinite(estimator.log_likelihood)


@pytest.mark.parametrize("state", [[1e8, 50.0], [np.nan, 50.0]])
def test_a_fitted_plant_that_runs_away_costs_more_than_any(state):
    """From a state that leads to no finite QP, in its preparation or its feedback."""
    scenario = Scenario.load("assay-fouled")
    run = make_run("model-based", scenario, 60)
    start = run.starting_parameters()
    estimator = ExtendedKalmanFilter.from_scenario(scenario, differentiates=True)
    memory = estimator.state_dict()
    memory["states"][0, :2] = state
    estimator.load_state_dict(memory)
    plant = FittedPlant(scenario, start, run.configuration.normal_errors)
    plant.fit(estimator, {"UA2": 6.84}, [np.empty(0), np.empty(0)], 1)
    assert plant.run(start, 30, 10).mean == np.inf


@pytest.mark.slow
def test_model_based_fits_the_filter_to_some_hours_of_readings():
    """`assay-fouled`: UA2 is found and the filter's variances move."""
    training = train(
        "model-based",
        "assay-fouled",
        240,
        start="cautious",
        seed=1,
        settings={"fit_noise_rounds": 6, "simulated_samples": 600},
        evaluation_seeds=0,
    )
    learned = training.learned
    UA2 = learned["p"][learned.blocks.block("p").labels.index("UA2")]
    assert abs(UA2 - 5.2) < 0.5
    assert np.abs(learned["noise"] - training.start["noise"]).max() > 0.1
    assert training.updates == 2


@pytest.mark.slow
def test_readings_that_no_noise_explains_leave_theta_where_it_is():
    """Without its uncertain parameter the model of `assay-fouled` is wrong for good."""
    certain = Scenario.load("assay-fouled").replace({"estimator": {"parameter_drift": 0.0}})
    with pytest.warns(ModelWarning, match=r"the readings of .*P2.* are off the model's for good"):
        training = train(
            "model-based",
            certain,
            240,
            start="cautious",
            seed=1,
            settings={"fit_noise_rounds": 6, "simulated_samples": 600},
            evaluation_seeds=0,
        )
    np.testing.assert_array_equal(training.learned.theta, training.start.theta)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "settings"),
    [
        ("model-based", {"fit_noise_rounds": 2, "simulated_samples": 310, "least_samples": 30}),
        (
            "q-learning",
            {"noise": True, "margin": True, "prior_samples": 20, "step_every": 10},
        ),
    ],
)
def test_a_run_resumed_after_a_kill_ends_in_the_same_digits(algorithm, settings, tmp_path):
    every = {"samples": 60, "log_every": 20, "evaluate_every": 60, "checkpoint_every": 20}
    run = run_of(algorithm, "assay", settings, start="tuned", **every)
    whole = run_training(run)
    resumed = killed_and_resumed(run, tmp_path, 40)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert np.array_equal(resumed.learned.theta, whole.learned.theta)
    assert not np.array_equal(whole.learned["noise"], whole.start["noise"])


def test_without_a_filter_of_ours_it_says_what_is_missing():
    scenario = Scenario.load("assay").replace({"estimator": {"kind": "none"}})
    with pytest.raises(ConfigurationError, match="no estimator of kind 'ekf'"):
        train("model-based", scenario, 60, start="naive", evaluation_seeds=0)


def test_the_block_is_where_sensors_are():
    blocks = {}
    for name in ("paper", "assay"):
        run = make_run("model-based", Scenario.load(name), 60)
        blocks[name] = run.starting_parameters().blocks
    assert "noise" not in blocks["paper"]
    assert blocks["assay"].block("noise").labels[-1] == "sensor P2"


def test_a_margin_is_an_entry_of_theta_where_it_is_asked_for():
    """It begins at zero, before `noise`; a file's stays; rules that replay refuse it."""
    scenario = Scenario.load("assay")
    for settings, expected in (({}, False), ({"margin": True}, True)):
        run = make_run("model-based", scenario, 60, settings)
        start = run.starting_parameters()
        assert ("margin" in start.blocks) is expected
    assert [block.name for block in start.blocks][-2:] == ["margin", "noise"]
    assert not start["margin"].any()
    assert (
        "margin"
        not in make_run("model-based", Scenario.load("paper"), 60, {"margin": True})
        .starting_parameters()
        .blocks
    )


def test_a_margin_of_a_file_is_kept_and_rules_that_replay_refuse_it(tmp_path):
    scenario = Scenario.load("assay")
    parameters = add_margin(tuned(scenario).parameters, Problem.from_scenario(scenario))
    parameters = parameters.replace({"margin": [1.8, 0.0, 0.0, 0.0]})
    file = str(parameters.save(tmp_path / "theta.toml"))
    options = TrainingOptions(start=file)
    kept = make_run("actor-critic", scenario, 60, options=options).starting_parameters()
    assert kept["margin"][0] == 1.8
    with pytest.raises(ConfigurationError, match="batch-q-learning replays"):
        make_run("batch-q-learning", scenario, 60, options=options).starting_parameters()


def test_a_rollout_whose_preparation_fails_costs_infinitely_much(monkeypatch):
    """Where the filter of a fitted plant runs away there is no QP to solve, and no cost."""
    scenario = Scenario.load("assay")
    estimator = ExtendedKalmanFilter.from_scenario(scenario)
    theta = tuned(scenario).parameters
    plant = FittedPlant(scenario, theta, n_normal=60.0)
    plant.fit(estimator, {"UA2": 6.84}, [np.zeros(0), np.zeros(0)], seed=1)

    def fails(controller):
        raise QpError("the QP is not finite", status="not finite")

    monkeypatch.setattr(RtiNmpc, "prepare", fails)
    cost = plant.run(theta, 60, 10)
    assert cost.mean == np.inf
    assert np.array_equal(cost.deviation, np.zeros(2))
