import pytest

from tests.helpers.sampling import evaporator_problem


@pytest.fixture(scope="session")
def problem():
    return evaporator_problem()
