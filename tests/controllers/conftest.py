import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from sampling import evaporator_problem


@pytest.fixture(scope="session")
def problem():
    return evaporator_problem()


@pytest.fixture
def rng():
    return np.random.default_rng(20200513)
