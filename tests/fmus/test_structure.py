from __future__ import annotations

import fmpy
import pytest

import fmus
from fmus.dependencies import initial_dependencies
from fmus.structure import index
from fmus.variables import EVAPORATOR


@pytest.fixture
def description(version: int):
    return fmpy.read_model_description(str(fmus.path(fmus.NAMES[version - 2])))


def test_every_initial_unknown_has_explicit_dependencies(description) -> None:
    for unknown in (*description.initialUnknowns, *description.outputs, *description.derivatives):
        assert unknown.dependencies is not None
        assert len(unknown.dependencies) == len(unknown.dependenciesKind)


def test_states_are_the_two_of_the_model(description) -> None:
    assert [u.variable.derivative.name for u in description.derivatives] == ["X2", "P2"]


def test_dependencies_of_the_file_are_those_of_the_table(description, version: int) -> None:
    for unknown in description.initialUnknowns:
        names = [v.name for v in unknown.dependencies]
        expected = initial_dependencies(unknown.variable.name, EVAPORATOR)
        assert names == [n for n in expected if version == 2 or n != "seedHigh"]


def test_index_counts_from_one_as_the_file_does() -> None:
    variables = fmpy.read_model_description(str(fmus.path())).modelVariables
    assert [index(v.name, EVAPORATOR) for v in variables] == list(range(1, len(variables) + 1))
