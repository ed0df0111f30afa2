import numpy as np
import pytest

from controllers.converged import ConvergedNmpc
from controllers.rti import RtiNmpc
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.starting_point import build_controller, build_strategy, starting_parameters


def test_the_papers_theta_is_the_naive_guess(problem):
    theta = starting_parameters(
        problem, Configuration(parametrisation="paper", value_offset="stage-cost")
    )
    assert "w_sigma" not in theta.blocks
    assert theta["c_lambda"] == pytest.approx(problem.reference_cost)
    assert np.array_equal(theta["B_l"], np.eye(4))


def test_the_extended_theta_starts_at_the_configured_slack_weights(problem):
    theta = starting_parameters(problem, Configuration(slack_quadratic_weight=500.0))
    assert theta["w_sigma"].tolist() == [100.0, 100.0]
    assert theta["W_sigma"].tolist() == [500.0, 500.0]
    assert theta["c_lambda"] == pytest.approx(problem.reference_cost / (1 - problem.discount))


def test_controllers_by_name(scenario, problem, parameters):
    assert type(build_controller("rti", scenario, problem, parameters)) is RtiNmpc
    assert type(build_controller("converged", scenario, problem, parameters)) is ConvergedNmpc
    with pytest.raises(ConfigurationError, match="'mpc'"):
        build_controller("mpc", scenario, problem, parameters)


def test_exploration_as_the_scenario_says(scenario):
    strategy = build_strategy(Configuration(exploration="scenario"), scenario, 100)
    assert strategy.probability(0) == 0.1
    assert strategy.deviation(0) == pytest.approx(np.sqrt([10.0, 10.0]))


def test_a_scenario_without_exploration_says_so(scenario):
    silent = scenario.replace(
        {"exploration": {"kind": "none", "standard_deviation": [], "probability": 0.0}}
    )
    with pytest.raises(ConfigurationError, match="has no exploration"):
        build_strategy(Configuration(exploration="scenario"), silent, 100)
