"""Solved problems as files: what is read back, what a key depends on, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from controllers import optimum as store
from controllers.dynamic_programming import GainEstimate, Settings, solve
from controllers.errors import OptimumError
from controllers.problem import DisturbanceLaw, PlantProblem, Problem
from cosim import Scenario
from tests.helpers.linear_plant import SCALAR

PROBLEM = Problem.from_scenario(Scenario.load("paper"))
LAW = DisturbanceLaw("uniform", np.array([5.0, 10, 40, 25]), np.ones(4))
P = PROBLEM.model.nominal_parameters


@pytest.fixture(scope="module")
def optimum():
    certificate = (GainEstimate("solution", 1.0, 0.9, 1.1),)
    return replace(solve(SCALAR.plant, Settings(level=0)), certificate=certificate)


@pytest.fixture
def stored(optimum, tmp_path):
    return store.write_optimum(tmp_path / "policy.npz", optimum, "abc")


def test_what_is_written_is_read_back_bit_by_bit(stored, optimum, tmp_path):
    found = store.read_optimum(stored, "abc")
    for name in ("actions", "W", "distribution"):
        np.testing.assert_array_equal(getattr(found, name), getattr(optimum, name))
    for name in ("gain", "lower", "upper", "accuracy", "certificate"):
        assert getattr(found, name) == getattr(optimum, name)
    again = store.write_optimum(tmp_path / "again.npz", optimum, "abc")
    assert again.read_bytes() == stored.read_bytes()


def test_a_damaged_or_foreign_file_is_refused(stored):
    with pytest.raises(OptimumError, match="abc, not of def"):
        store.read_optimum(stored, "def")
    stored.write_bytes(stored.read_bytes()[:-100])
    with pytest.raises(OptimumError):
        store.read_optimum(stored, "abc")
    np.savez(stored, document=np.array("[]"))
    with pytest.raises(OptimumError):
        store.read_optimum(stored, "abc")


def changed_key(problem=PROBLEM, law=LAW, parameters=P, settings=None):
    return store.optimum_key(PlantProblem(problem, law, parameters), settings or Settings())


CHANGES = {
    "bound": {"problem": replace(PROBLEM, state_lower=[24.9, 40])},
    "actuator": {"problem": replace(PROBLEM, action_upper=[400, 300])},
    "penalty": {"problem": replace(PROBLEM, penalty_linear=[1e4, 1e5])},
    "sampling": {"problem": replace(PROBLEM, sampling_time=6.0)},
    "law": {"law": replace(LAW, kind="normal")},
    "range": {"law": replace(LAW, ranges=2 * np.ones(4))},
    "plant parameter": {"parameters": P * 1.01},
    "solver": {"settings": Settings(cells=13)},
}


@pytest.mark.parametrize("what", CHANGES)
def test_key_changes_with_all_that_the_solution_depends_on(what):
    assert changed_key(**CHANGES[what]) != changed_key()


def test_key_changes_with_the_equations():
    model = PROBLEM.model
    other = replace(model, economic_cost=lambda x, u, d, p: model.economic_cost(x, u, d, p) + u[0])
    assert changed_key(problem=replace(PROBLEM, model=other)) != changed_key()
