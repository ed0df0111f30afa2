import pytest

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim import FmuPlant
from tests.helpers.linear_quadratic import LinearQuadratic


@pytest.fixture(scope="session")
def scenario(paper):
    return paper


@pytest.fixture(scope="module")
def plant(scenario):
    with FmuPlant(scenario) as plant:
        yield plant


@pytest.fixture(scope="session")
def problem(scenario):
    return Problem.from_scenario(scenario)


@pytest.fixture(scope="session")
def parameters(problem):
    return Parameters.naive(problem)


@pytest.fixture(scope="session")
def linear_quadratic():
    return LinearQuadratic()
