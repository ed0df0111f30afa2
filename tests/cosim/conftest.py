import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from cosim import FmuPlant, Scenario


@pytest.fixture(scope="session")
def paper():
    return Scenario.load("paper")


@pytest.fixture(params=["evaporator", "evaporator_fmi3"])
def plant(request, paper):
    with FmuPlant(paper, request.param) as plant:
        yield plant
