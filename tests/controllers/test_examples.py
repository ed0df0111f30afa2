"""The examples in the docstrings that the reference page shows first."""

import doctest

import numpy as np
import pytest

from controllers import Model, Parameters, Problem, Quantity, RtiNmpc
from cosim import Scenario

NAMES = {
    "np": np,
    "Model": Model,
    "Parameters": Parameters,
    "Problem": Problem,
    "Quantity": Quantity,
    "RtiNmpc": RtiNmpc,
    "Scenario": Scenario,
}


@pytest.mark.parametrize("kind", [Model, Parameters, Problem, RtiNmpc])
def test_the_example_gives_what_it_shows(kind):
    tests = doctest.DocTestFinder(recurse=False).find(kind, globs=dict(NAMES))
    assert tests and tests[0].examples
    outcome = doctest.DocTestRunner(verbose=False).run(tests[0])
    assert outcome.failed == 0
