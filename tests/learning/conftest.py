import numpy as np
import pytest

from controllers.factories import tuned
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim import FmuPlant
from learning.empirical_model import Features
from tests.helpers.empirical import fit, plant_data
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


@pytest.fixture(scope="session")
def features(problem):
    return Features(problem)


@pytest.fixture(scope="session")
def tuned_theta(scenario):
    return tuned(scenario).parameters


@pytest.fixture
def fitted(features, rng):
    """A model of a plant with another parameter."""
    error = -0.2 * np.eye(features.n_parameters)[0]
    return fit(features, *plant_data(features, rng, 2000, error))
