import numpy as np
import pytest

from tests.helpers.sampling import evaporator_problem


@pytest.fixture(scope="session")
def problem():
    return evaporator_problem()


@pytest.fixture
def rng():
    return np.random.default_rng(20200513)
