"""What a practitioner would do, as algorithms: they run, count, resume, and find what is there."""

import dataclasses

import numpy as np
import pytest

from controllers.economic import tune
from controllers.optimum import fouling
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim import FmuPlant, Scenario, simulate
from learning.algorithm import load_algorithm
from learning.policy_search import Coordinates
from learning.prediction_errors import OneStepModel
from learning.training import begin, run_training, to_csv
from tests.helpers import training
from tests.helpers.training import killed_and_resumed

SETTINGS = {
    "backoff": {},
    "offset-free": {"memory": 100},
    "identified": {},
    "policy-search": {"population": 4, "episode": 20},
}
SETTINGS |= {f"{name}-simulator": settings for name, settings in SETTINGS.items()}


def make_run(name, scenario="paper", **changes):
    values = {"samples": 450, "seed": 3, "start": "tuned", "evaluation_steps": 20}
    every = {"log_every": 50, "evaluate_every": 450, "checkpoint_every": 50}
    return training.make_run(name, scenario, SETTINGS[name], **{**values, **every, **changes})


@pytest.mark.parametrize(
    "name",
    [
        "offset-free",
        pytest.param("policy-search-simulator", marks=pytest.mark.slow),
        pytest.param("backoff", marks=pytest.mark.slow),
        pytest.param("identified", marks=pytest.mark.slow),
    ],
)
def test_a_baseline_resumed_after_a_kill_ends_in_the_same_digits(name, tmp_path):
    run = make_run(name)
    whole = run_training(run)

    resumed = killed_and_resumed(run, tmp_path, 250)
    assert to_csv(resumed.rows) == to_csv(whole.rows)
    assert whole.plant_samples == 450
    assert whole.status == "finished"


@pytest.mark.parametrize("name", SETTINGS)
def test_only_the_simulators_forms_put_the_plant_back(name, scenario):
    run = make_run(name)
    with FmuPlant(scenario) as plant:
        loop, resets = begin(run, load_algorithm(name), plant), 0
        reset = plant.reset

        def counted(seed):
            nonlocal resets
            resets += 1
            return reset(seed)

        plant.reset = counted
        for _ in range(450):
            loop.advance()
    assert (resets > 0) == name.endswith("-simulator") == (loop.algorithm.asks_for == "simulator")
    assert (loop.parameters["x_l"] >= scenario.state_lower).all() or "policy" in name


def test_the_last_digits_of_the_start_choose_nothing(problem, tmp_path):
    """As those of the tuned θ, which a conic solver gives to 1e-10."""
    J, tuned, rng = [], tune(problem).parameters, np.random.default_rng(0)
    for size in (0.0, 1e-10):
        theta = tuned.theta * (1 + size * rng.uniform(-1, 1, tuned.theta.size))
        start = tuned.with_theta(theta).save(tmp_path / "start.toml")
        J.append(run_training(make_run("backoff", "fouled", samples=2000, start=str(start))).J)
    assert J[1] == pytest.approx(J[0], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["paper", "fast-sampling"])
@pytest.mark.parametrize("seed", range(2))
def test_tuned_with_back_off_is_within_a_thousandth_of_the_optimum(scenario, seed):
    from controllers.factories import optimal

    every = {"log_every": 500, "evaluate_every": 8000, "checkpoint_every": 8000}
    run = make_run("backoff-simulator", scenario, samples=8000, seed=seed, **every)
    theta = run_training(run).parameters
    problem = Problem.from_scenario(run.scenario)
    with FmuPlant(run.scenario) as plant:
        J = [
            simulate(plant, controller, 10_000, 3_000_000 + seed).summary()["J"]
            for controller in (RtiNmpc(problem, theta), optimal(run.scenario))
        ]
    assert J[0] / J[1] - 1 < 1e-3


def test_offset_free_predicts_without_bias_under_a_wrong_model():
    configuration = load_algorithm("offset-free").Configuration.from_dict({"back_off": False})
    run = make_run("offset-free", "fouled", samples=600, configuration=configuration)
    theta = run_training(run).parameters
    problem = Problem.from_scenario(run.scenario)
    assert np.array_equal(theta["x_l"], problem.state_lower), "no back-off was asked for"
    with FmuPlant(run.scenario) as plant:
        seen = simulate(plant, RtiNmpc(problem, theta), 300, 11)
    model, naive = OneStepModel(run.scenario), Parameters.naive(problem)
    parts = seen.states[:-1], seen.actions[:-1], seen.states[1:]
    before, after = (model.errors(*parts, each).mean(axis=0) for each in (naive, theta))
    assert abs(after[1]) < 0.1 * abs(before[1])


@pytest.mark.parametrize("name", ["offset-free", "identified"])
def test_in_operation_it_goes_on_and_backs_off_by_its_own_errors(name, scenario):
    run = make_run(name, "fouled", samples=1400)
    with FmuPlant(run.scenario) as plant:
        loop, moved, bounds = begin(run, load_algorithm(name), plant), [], []
        for sample in range(1400):
            if loop.advance()[1] is not None:
                moved.append(sample)
                bounds.append([loop.parameters["x_l"][0], loop.parameters["x_u"][1]])
    lower, upper = np.array(bounds).T
    assert moved[-1] >= 950 and len(moved) >= 2
    assert (lower > 25.5).sum() > len(lower) / 2 and (upper < 80.0).any()
    assert (lower >= 25.0).all() and (upper <= 80.0).all()


def test_identification_finds_the_fouled_condenser_and_tunes_with_it():
    run = make_run("identified", "fouled", samples=1200)
    theta = run_training(run).parameters
    assert theta["p"] == pytest.approx([5.2], rel=0.01)
    problem = Problem.from_scenario(run.scenario)
    model = problem.model
    fouled = dataclasses.replace(
        model,
        parameters=tuple(
            dataclasses.replace(q, nominal=float(theta["p"][0])) if q.name == "UA2" else q
            for q in model.parameters
        ),
    )
    expected = tune(dataclasses.replace(problem, model=fouled)).parameters
    for name in ("B_l", "b_l", "B_Vf", "b_Vf"):
        assert theta[name] == pytest.approx(expected[name], rel=1e-9)


def test_identification_again_and_again_follows_a_parameter():
    document = {"plant": {"parameters": {"fouling_rate": 30.0, "cleaning_period": 60.0}}}
    scenario = Scenario.load("drifting").replace(document)
    configuration = load_algorithm("identified").Configuration.from_dict(
        {"back_off": False, "every": 150}
    )
    run = make_run("identified", scenario=scenario, configuration=configuration, start="naive")
    rows = run_training(run).rows
    _, law = fouling(scenario)
    for row in rows[3::3]:
        # The fit is of the 150 samples before it, that is of their middle.
        last = row["samples"] - row["samples"] % 150
        fitted = float(row.parameters["p"][0])
        assert fitted == pytest.approx(float(law(60.0 * (last - 75))), rel=0.03)


def test_the_policy_search_hands_over_the_mean_and_improves():
    configuration = load_algorithm("policy-search").Configuration.from_dict({"episode": 60})
    every = {"log_every": 780, "evaluate_every": 2340, "checkpoint_every": 2340}
    result = run_training(
        make_run("policy-search-simulator", samples=2340, start="naive",
                 configuration=configuration, **every)
    )  # fmt: skip
    assert result.rows[0]["updates"] == 13
    costs = [row["J"] for row in result.rows]
    assert costs[2] < costs[0]
    assert result.evaluation["J"] == result.rows[-1]["greedy_J"]


def test_coordinates_begin_at_the_start_and_stay_definite(scenario, problem, rng):
    start = tune(problem).parameters
    coordinates = Coordinates(start, scenario, 0.02)
    assert coordinates.size == 25
    same = coordinates.theta(np.zeros(25))
    assert same.theta == pytest.approx(start.theta, rel=1e-12)
    for _ in range(20):
        theta = coordinates.theta(3.0 * rng.normal(size=25))
        theta.require_well_posed()
        assert np.linalg.eigvalsh(theta["B_l"])[0] > 0
        assert np.array_equal(theta["B_lambda"], start["B_lambda"])
