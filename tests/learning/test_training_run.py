"""What a training is, and where its θ starts."""

import numpy as np
import pytest

import fmus
from controllers.theta import Parameters, ThetaBlocks
from cosim.core.training_options import TrainingOptions
from cosim.plant import FmuPlant
from learning import QLearning
from learning.algorithm import load_algorithm
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.exploration import Strategy
from learning.training_run import begin_training, make_run, starting_parameters


def test_the_extended_theta_starts_at_slack_weights_of_the_problems_scale(problem):
    theta = starting_parameters(problem, Configuration())
    assert theta["w_sigma"].tolist() == [100.0, 100.0]
    assert theta["W_sigma"].tolist() == [1000.0, 1000.0]
    assert theta["c_lambda"] == pytest.approx(problem.reference_cost / (1 - problem.discount))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"log_every": 70}, (70, 4970, 4970)),
        ({"evaluate_every": 400}, (400, 400, 4800)),
        ({"evaluate_every": 2000, "checkpoint_every": 3000}, (1000, 2000, 3000)),
    ],
)
def test_what_is_not_given_of_log_evaluation_and_checkpoint_fits_the_rest(
    scenario, given, expected
):
    run = make_run("q-learning", scenario, 100, options=TrainingOptions(**given))
    assert (run.log_every, run.evaluate_every, run.checkpoint_every) == expected


@pytest.mark.parametrize("evaluate_every", [None, 1000, 5000])
@pytest.mark.parametrize("samples", [20, 200, 1600, 1999, 10_000, 100_001])
def test_held_out_runs_on_anothers_fmu_are_a_tenth_of_the_training(
    scenario, samples, evaluate_every
):
    foreign = scenario.replace({"plant": {"fmu": str(fmus.path(scenario.plant.fmu))}})
    options = TrainingOptions(evaluate_every=evaluate_every)
    run = make_run("q-learning", foreign, samples, options=options)
    # Of naive, the start and the optimum, between the samples, and at the end.
    evaluations = 3 + (samples - 1) // run.evaluate_every + 1
    assert 10 * evaluations * run.evaluation_seeds * run.evaluation_steps <= samples
    assert bool(run.evaluation_seeds) == (samples >= 1600 * evaluations / 4)
    asked = make_run("q-learning", foreign, samples, options=TrainingOptions(evaluation_steps=70))
    assert (asked.evaluation_seeds, asked.evaluation_steps) == (4, 70)
    ours = make_run("q-learning", scenario, samples, options=options)
    assert (ours.evaluation_seeds, ours.evaluation_steps) == (4, 500)


STATED = {
    "exploration": {"kind": "literal", "probability": 0.2, "standard_deviation": [3.0, 4.0]},
    "controller": {"value_offset": "stage-cost"},
}


def test_what_the_scenario_states_takes_the_place_of_defaults_not_of_what_the_user_sets(scenario):
    stated = scenario.replace(STATED)
    configuration = QLearning.Configuration().for_scenario(stated)
    strategy = Strategy(configuration, scenario)
    assert (strategy.kind, configuration.value_offset) == ("literal", "stage-cost")
    assert (strategy.probability, strategy.deviation.tolist()) == (0.2, [3.0, 4.0])
    chosen = Configuration(value_offset="discounted", exploration_probability=0.7)
    found = chosen.for_scenario(stated)
    assert (found.value_offset, found.exploration_probability) == ("discounted", 0.7)
    assert found.exploration == "literal"


def test_a_file_keeps_its_blocks_and_gets_those_it_lacks(problem, tmp_path):
    mine = Parameters.naive(problem).replace({"x_l": [27.0, 41.0], "c_lambda": 5.0})
    path = str(mine.save(tmp_path / "mine.toml"))
    start = starting_parameters(problem, Configuration(model_parameters=("UA2",)), path)
    assert start["x_l"].tolist() == [27.0, 41.0] and start["c_lambda"] == 5.0
    assert start["w_sigma"].tolist() == [100.0, 100.0]
    assert start["p"].tolist() == [6.84]
    literal = starting_parameters(problem, Configuration(parametrisation="paper"), path)
    assert np.array_equal(literal.theta, mine.theta)


def test_a_file_keeps_its_own_slack_weights_and_model_parameters(problem, tmp_path):
    blocks = ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=("UA2",))
    mine = Parameters.naive(problem, blocks).replace({"w_sigma": [200.0, 300.0], "p": [5.2]})
    path = str(mine.save(tmp_path / "mine.toml"))
    start = starting_parameters(problem, Configuration(model_parameters=("M", "UA2")), path)
    assert start["w_sigma"].tolist() == [200.0, 300.0]
    assert dict(zip(start.blocks.block("p").labels, start["p"], strict=True)) == {
        "UA2": 5.2,
        "M": 20.0,
    }
    with pytest.raises(ConfigurationError, match="parametrisation=extended"):
        starting_parameters(problem, Configuration(parametrisation="paper"), path)


def test_checkpoints_are_close_where_a_step_may_take_long(scenario):
    foreign = scenario.replace({"plant": {"fmu": str(fmus.path(scenario.plant.fmu))}})
    slow = make_run("q-learning", foreign, 20_000)
    fast = make_run("q-learning", scenario, 20_000)
    assert (slow.log_every, slow.checkpoint_every, slow.evaluate_every) == (100, 100, 5000)
    assert (fast.log_every, fast.checkpoint_every, fast.evaluate_every) == (1000, 5000, 5000)


@pytest.mark.parametrize(
    ("algorithm", "retreats"),
    [
        ("q-learning", True),
        ("batch-q-learning", True),
        ("actor-critic", True),
        ("model-based", True),
        ("dyna", True),
        ("offset-free", True),
        ("identified", True),
        # These try θ on the plant, and end at the one that cost least.
        ("backoff", False),
        ("policy-search", False),
    ],
)
def test_each_rule_in_operation_retreats_unless_it_tries_theta(scenario, algorithm, retreats):
    run = make_run(algorithm, scenario, 400)
    with FmuPlant(scenario) as plant:
        loop = begin_training(run, load_algorithm(algorithm), plant)
        assert any(name.startswith("retreat") for name in loop.state_dict()) is retreats
