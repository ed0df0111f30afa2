"""Learning from a log: what is refused, what is predicted, and what the intervals hold."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from controllers.factories import nmpc
from controllers.problem import Problem
from cosim import FmuPlant, Scenario, build_controller, simulate
from cosim.core.logged_data import LoggedData, LoggedDataError, read_logged_data
from cosim.core.simulation import indicators_of
from cosim.core.statistics import mean
from learning import ConfigurationError, train_from_data
from learning.empirical_model import EmpiricalModel, Features
from learning.log_answer import excitation
from learning.log_checks import usable
from learning.log_configuration import LogConfiguration
from learning.log_prediction import Expectation, difference
from learning.model_based import ExpectedCosts, ModelBasedConfiguration
from tests.helpers.empirical import SETTINGS, fit, plant_data

LOG = LogConfiguration()
QUICK = {"coarse_rollout": 600, "fine_rollout": 900, "back_off_levels": [2.0, 7.0]}
"""A search of a second."""


def logged(features, rng, count=400):
    """Transitions of a plant that is the nominal model with noise, under inputs at random."""
    inputs, outputs = plant_data(features, rng, count, np.zeros(features.n_parameters))
    return LoggedData(
        time=60.0 * np.arange(count),
        states=inputs[:, :2],
        actions=inputs[:, 2:],
        next_states=outputs[:, :2],
        stage_cost=outputs[:, 2],
        follows=np.arange(count) > 0,
        rows=count + 1,
        left_out={},
    )


@pytest.fixture
def data(features, rng):
    return logged(features, rng)


def test_a_sound_log_is_used_as_it_is(data, paper, features):
    used = usable(data, paper, features, SETTINGS, LOG)
    assert len(used) == len(data)
    assert used.left_out == {}


def shifted(data, rows):
    return replace(data, actions=np.roll(data.actions, rows, axis=0))


MISREAD = {
    "late": (lambda data: shifted(data, 1), "inputs are logged 1 row late"),
    "two rows late": (lambda data: shifted(data, 2), "inputs are logged 2 rows late"),
    "early": (lambda data: shifted(data, -1), "inputs are logged 1 row early"),
    "inputs": (
        lambda data: replace(data, actions=data.actions[:, ::-1].copy()),
        "columns P100 and F200 are exchanged",
    ),
    "states": (
        lambda data: replace(
            data,
            states=data.states[:, ::-1].copy(),
            next_states=data.next_states[:, ::-1].copy(),
        ),
        "columns X2 and P2 are exchanged",
    ),
    "unit": (
        lambda data: replace(
            data,
            states=data.states * [0.01, 1.0],
            next_states=data.next_states * [0.01, 1.0],
        ),
        "predicts X2 more than 5 times worse than that it stays",
    ),
    "cents": (
        lambda data: replace(data, stage_cost=100.0 * data.stage_cost),
        "logged stage cost is .* on average, and the model's",
    ),
}


def test_inputs_of_one_size_are_not_taken_for_exchanged(data, paper, features):
    """Errors of parameters that exchanged inputs would undo: the nominal model prefers them."""
    rng = np.random.default_rng(3)
    count = len(data)
    states = np.column_stack([rng.uniform(25, 30, count), rng.uniform(45, 55, count)])
    actions = rng.normal([196.0, 204.0], 3.0, (count, 2))
    errors = rng.normal(0.0, 0.15, features.n_parameters)
    y, _, h = features(np.column_stack([states, actions]), errors)
    next_states = y[:, :2] + 0.1 * h[:, :2] * rng.standard_normal((count, 2))
    log = replace(data, states=states, actions=actions, next_states=next_states, stage_cost=None)
    assert len(usable(log, paper, features, SETTINGS, LOG)) == count


def test_shares_of_samples_have_the_mean_of_the_expected_costs(paper, features, rng):
    """The chance of the errors moves where a cost stands in the log, not how large it is."""
    problem = Problem.from_scenario(paper)
    inputs, outputs = plant_data(features, rng, 300, np.zeros(features.n_parameters))
    model = fit(features, inputs, outputs)
    settings = ModelBasedConfiguration.from_dict({"tail_widening": 0.0})
    predicted, h, _ = model.predict(inputs - [3.0, 0.0, 0.0, 0.0])
    costs, _ = ExpectedCosts(problem, model, settings)(predicted, h)
    shares = Expectation(problem, model, settings, 0, 20)(predicted, h)
    assert shares.shape == (280,)
    assert shares.mean() == pytest.approx(costs[20:].mean())
    # Penalties of a few errors: their chance is larger than that of the states alone.
    assert shares.std() > costs[20:].std()


def steady(data):
    """The same log with states that move little from row to row."""
    states = [27.0, 60.0] + 0.01 * (data.states - [27.0, 60.0])
    return replace(data, states=states, next_states=data.next_states - data.states + states)


@pytest.mark.parametrize("case", MISREAD)
def test_a_log_that_is_misread_is_refused(data, paper, features, case):
    spoil, words = MISREAD[case]
    with pytest.raises(LoggedDataError, match=words):
        usable(spoil(data), paper, features, SETTINGS, LOG)


def test_a_wrong_unit_is_seen_in_a_log_of_pieces(data, paper, features):
    spoil, words = MISREAD["unit"]
    pieces = replace(spoil(data), follows=np.arange(len(data)) % 2 == 1)
    with pytest.raises(LoggedDataError, match=words):
        usable(pieces, paper, features, SETTINGS, LOG)


@pytest.mark.parametrize("length", [1, 4])
def test_a_spike_or_a_dropout_of_a_sensor_is_left_out(data, paper, features, length):
    data = steady(data)
    data.next_states[100 : 100 + length, 0] += 30.0
    data.states[101 : 101 + length, 0] += 30.0
    used = usable(data, paper, features, SETTINGS, LOG)
    assert used.left_out == {"jump there and back": length + 1}
    assert not used.follows[100]


def test_a_setting_says_how_long_a_dropout_is(data, paper, features):
    data = steady(data)
    data.next_states[100:104, 0] += 30.0
    data.states[101:105, 0] += 30.0
    short = LOG.model_copy(update={"longest_dropout": 3})
    assert usable(data, paper, features, SETTINGS, short).left_out == {}


def test_a_jump_that_stays_is_the_plants(data, paper, features):
    data.next_states[100, 0] += 20.0
    assert usable(data, paper, features, SETTINGS, LOG).left_out == {}


def test_an_older_part_than_is_remembered_is_counted(data, paper, features):
    used = usable(data, paper, features, SETTINGS.model_copy(update={"memory": 250}), LOG)
    assert used.left_out == {"older than what is used": 150}
    assert not used.follows[0]


def test_a_log_of_which_too_little_is_left_is_refused(data, paper, features):
    few = SETTINGS.model_copy(update={"memory": 119})
    with pytest.raises(LoggedDataError, match=r"119 .* 120 are needed; .* what is used: 281"):
        usable(data, paper, features, few, LOG)


def test_errors_do_not_persist_over_a_gap(features, rng):
    inputs, outputs = plant_data(features, rng, 300, np.zeros(features.n_parameters))
    y, _, h = features(inputs, np.zeros(features.n_parameters))
    # Pairs of rows within which an error persists, one after the other in any order.
    first = rng.normal(0.0, 0.1, (150, 3))
    second = 0.9 * first + rng.normal(0.0, 0.04, (150, 3))
    errors = np.stack([first, second], axis=1).reshape(300, 3)
    outputs = y + h * errors
    follows = np.arange(300) % 2 == 1
    model = EmpiricalModel.fit(features, inputs, outputs, SETTINGS, follows=follows)
    radius = np.abs(np.linalg.eigvals(model.persistence)).max()
    assert radius == pytest.approx(0.9, abs=0.15)


@pytest.mark.slow
def test_drawn_models_differ_but_explain_the_data(features, rng):
    inputs, outputs = plant_data(features, rng, 200, np.zeros(features.n_parameters))
    model = fit(features, inputs, outputs)
    draws = model.draws(inputs, outputs, SETTINGS, 5, rng)
    precision = np.linalg.inv(model.noise)

    def loss(drawn):
        predicted, h, _ = drawn.predict(inputs)
        errors = (outputs - predicted) / h
        return np.einsum("mi,ij,mj->", errors, precision, errors) / 2

    # Half a χ² of as many degrees of freedom as there are coefficients, at most.
    limit = stats.chi2(len(model.mean)).isf(1e-4) / 2
    assert max(loss(drawn) - loss(model) for drawn in draws) < limit
    spread = np.std([drawn.mean for drawn in draws], axis=0)
    deviation = np.sqrt(np.diag(model.covariance))
    assert 0.5 < np.mean(spread / deviation) < 1.5


def test_a_differences_variance_is_of_models_and_of_chance(rng):
    models = rng.normal(0.0, 2.0, (LOG.drawn_models, 1))
    # Eight stretches, within which costs are the same: sixteen would not be independent.
    chance = rng.normal(0.0, 8.0, 8)
    costs = 5.0 + models + np.repeat(chance, 100)
    estimate, share = difference(costs, np.zeros_like(costs), LOG.stretches)
    of_models = models.var(ddof=1)
    of_chance = chance.var(ddof=1) / 8
    low, high = estimate.interval
    deviation = (of_models + of_chance) ** 0.5
    assert share == pytest.approx(of_models / (of_models + of_chance))
    assert estimate.value == pytest.approx(costs.mean())
    # Between the quantiles of a normal law and of the fewest degrees of freedom.
    assert 1.96 * deviation < (high - low) / 2 < 2.37 * deviation


def test_a_lost_rollout_leaves_no_interval():
    costs = np.ones((LOG.drawn_models, 100))
    lost = costs.copy()
    lost[3] = np.inf
    assert difference(lost, costs, LOG.stretches)[0].interval is None
    assert difference(costs, lost, LOG.stretches)[0].interval is None


def test_what_only_follows_from_the_states_excites_nothing(data, paper):
    gains = np.array([[2.0, 0.1], [-1.0, 0.4]])
    feedback = replace(data, actions=200.0 + data.states @ gains.T)
    assert max(excitation(feedback.states, feedback.actions, paper).values()) < 1e-9
    stepped = feedback.actions.copy()
    stepped[::2, 0] += 6.0
    free = excitation(feedback.states, stepped, paper)
    assert free["P100"] == pytest.approx(3.0 / 300.0, rel=0.1)
    assert free["F200"] < 1e-9


@pytest.mark.parametrize(
    ("algorithm", "name", "words"),
    [
        ("q-learning", "paper", "cannot learn from logged data"),
        ("model-based", "late", "has sensors, and the data are LoggedData"),
        ("batch-q-learning", "late", "has sensors"),
        ("model-based", "prices", "has signals"),
    ],
)
def test_what_no_log_can_teach_is_refused(data, algorithm, name, words):
    with pytest.raises(ConfigurationError, match=words):
        train_from_data(algorithm, data, name)


@pytest.mark.parametrize("wrong", [{"jumps": 3.0}, {"stretches": [1]}, {"drawn_models": 1}])
def test_a_setting_that_means_nothing_is_refused(data, wrong):
    (name,) = wrong
    with pytest.raises(ConfigurationError, match=f"log settings: .*{name}"):
        train_from_data("model-based", data, "paper", log_settings=wrong)


def log_of(scenario, controller, samples, folder):
    with FmuPlant(scenario) as plant:
        run = simulate(plant, controller, samples, 0)
        units = plant.units
    return read_logged_data(run.write_csv(folder / "log.csv"), scenario, units=units)


def test_inputs_that_follow_lasting_disturbances_are_not_taken_for_early(tmp_path):
    """A feedback's inputs of the row before tell of a disturbance that is there still."""
    scenario = Scenario.load("random-coloured-12")
    data = log_of(scenario, build_controller("lqr", scenario), 3000, tmp_path)
    features = Features(Problem.from_scenario(scenario), SETTINGS.smallest_error_size)
    used = usable(data, scenario, features, SETTINGS, LOG)
    assert len(used) == len(data)
    with pytest.raises(LoggedDataError, match="inputs are logged 1 row late"):
        usable(shifted(data, 1), scenario, features, SETTINGS, LOG)


@pytest.mark.slow
def test_a_start_that_was_in_charge_costs_what_was_logged(tmp_path, paper):
    data = log_of(paper, build_controller("cautious", paper), 500, tmp_path)
    answer = train_from_data("model-based", data, paper, start="cautious", settings=QUICK)
    # The model's errors repeat the log: the same actions meet the same disturbances.
    assert answer.start_cost == pytest.approx(answer.modelled_cost, rel=1e-9)
    low, high = answer.start_against_logged.interval
    assert high - low < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["model-based", "batch-q-learning"])
def test_a_poor_start_is_bettered_and_the_plant_agrees(tmp_path, paper, algorithm):
    data = log_of(paper, build_controller("naive", paper), 1500, tmp_path)
    settings = QUICK if algorithm == "model-based" else {}
    answer = train_from_data(algorithm, data, paper, start="naive", settings=settings)
    assert answer.verdict == "better"
    assert answer.experiment == ""
    costs = []
    with FmuPlant(paper) as plant:
        for theta in (answer.parameters, answer.start):
            costs.append(indicators_of(plant, nmpc(paper, theta), range(5, 11), 1500)["J"])
    true_low, true_high = mean(costs[0] - costs[1]).interval
    low, high = answer.against_start.interval
    assert low < true_high
    assert true_low < high


@pytest.mark.slow
def test_a_log_that_cannot_tell_keeps_the_start(tmp_path, paper):
    data = log_of(paper, build_controller("lqr", paper), 130, tmp_path)
    unpriced = replace(data, stage_cost=None)
    answer = train_from_data("model-based", unpriced, paper, start="cautious", settings=QUICK)
    assert answer.verdict == "cannot tell"
    assert np.array_equal(answer.parameters.theta, answer.start.theta)
    assert answer.experiment
    assert answer.cost_is_modelled
    assert answer.modelled_cost == pytest.approx(answer.logged_cost, rel=0.2)
