import numpy as np
import pytest

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.scenario import Scenario
from tests.helpers.linear_quadratic import LinearQuadratic


@pytest.fixture(scope="session")
def scenario():
    return Scenario.load("paper")


@pytest.fixture(scope="session")
def problem(scenario):
    return Problem.from_scenario(scenario)


@pytest.fixture(scope="session")
def parameters(problem):
    return Parameters.naive(problem)


@pytest.fixture
def rng():
    return np.random.default_rng(20200513)


@pytest.fixture(scope="session")
def linear_quadratic():
    return LinearQuadratic()
