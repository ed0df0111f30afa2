from dataclasses import replace

import numpy as np
import pytest

from controllers.dynamic_programming import archive
from controllers.dynamic_programming.quadrature import DisturbanceLaw
from controllers.dynamic_programming.settings import Settings
from controllers.dynamic_programming.solution import solve
from controllers.errors import OptimumError
from tests.helpers.linear_plant import SCALAR
from tests.helpers.sampling import evaporator_problem

PROBLEM = evaporator_problem()
LAW = DisturbanceLaw("uniform", PROBLEM.model.nominal_disturbance, np.ones(4))
P = PROBLEM.model.nominal_parameters


@pytest.fixture(scope="module")
def optimum():
    return solve(SCALAR.problem, SCALAR.law, Settings(level=1))


@pytest.fixture
def stored(optimum, tmp_path):
    return archive.write(tmp_path / "policy.npz", optimum, "abc")


def test_a_solution_survives_storage_bit_for_bit(optimum, stored):
    found = archive.read(stored, "abc")
    for name in ("actions", "W", "distribution"):
        np.testing.assert_array_equal(getattr(found, name), getattr(optimum, name))
    for ours, theirs in zip(found.grid.axes, optimum.grid.axes, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (found.gain, found.lower, found.upper) == (optimum.gain, optimum.lower, optimum.upper)
    assert (found.discount, found.accuracy) == (optimum.discount, optimum.accuracy)


def test_equal_solutions_make_equal_bytes(optimum, stored, tmp_path):
    again = archive.write(tmp_path / "again.npz", optimum, "abc")
    assert again.read_bytes() == stored.read_bytes()


DAMAGE = {
    "cut short": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "text": lambda data: b"not a policy",
    "flipped byte": lambda data: data[:200] + bytes([data[200] ^ 0xFF]) + data[201:],
}


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_file_has_one_clear_error(stored, how):
    stored.write_bytes(DAMAGE[how](stored.read_bytes()))
    with pytest.raises(OptimumError, match=r"policy\.npz: .*delete it"):
        archive.read(stored, "abc")


def test_a_pickle_is_refused(tmp_path):
    path = tmp_path / "policy.npz"
    np.savez(path, document=np.array([{"key": "abc"}], dtype=object))
    with pytest.raises(OptimumError, match="not a readable optimal policy"):
        archive.read(path, "abc")


def test_arrays_that_do_not_fit_are_refused(optimum, tmp_path):
    for broken in (
        replace(optimum, W=optimum.W[:-1]),
        replace(optimum, actions=optimum.actions[:, 0]),
        replace(optimum, W=np.full_like(optimum.W, np.nan)),
    ):
        path = archive.write(tmp_path / "policy.npz", broken, "abc")
        with pytest.raises(OptimumError, match="do not fit its grid or are not finite"):
            archive.read(path, "abc")


def test_another_problems_file_is_refused(stored):
    with pytest.raises(OptimumError, match="policy of problem abc, not of def"):
        archive.read(stored, "def")


def test_what_is_solved_once_is_read_the_next_time(optimum, tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "cache_folder", lambda: tmp_path / "cache")
    calls = []

    def make():
        calls.append(1)
        return optimum

    first, second = archive.obtain("abc", make), archive.obtain("abc", make)
    assert len(calls) == 1
    np.testing.assert_array_equal(first.W, second.W)


def test_a_cache_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "file"))
    calls = []
    with pytest.raises(OptimumError, match=r"cannot be kept there .*COSIM_CACHE"):
        archive.obtain("abc", lambda: calls.append(1))
    assert not calls


def changed_key(problem=PROBLEM, law=LAW, parameters=P, settings=None):
    return archive.key(problem, law, parameters, settings or Settings())


CHANGES = {
    "bound": {"problem": replace(PROBLEM, state_lower=[24.9, 40])},
    "actuator": {"problem": replace(PROBLEM, action_upper=[400, 300])},
    "penalty": {"problem": replace(PROBLEM, penalty_linear=[1e4, 1e5])},
    "sampling": {"problem": replace(PROBLEM, sampling_time=6.0)},
    "law": {"law": replace(LAW, kind="normal")},
    "range": {"law": replace(LAW, ranges=2 * np.ones(4))},
    "plant parameter": {"parameters": P * 1.01},
    "solver": {"settings": Settings(cells=13)},
    "criterion": {"settings": Settings(criterion="discounted")},
}


@pytest.mark.parametrize("what", CHANGES)
def test_key_changes_with_all_that_the_solution_depends_on(what):
    assert changed_key(**CHANGES[what]) != changed_key()


def test_key_changes_with_the_equations():
    model = PROBLEM.model
    other = replace(model, economic_cost=lambda x, u, d, p: model.economic_cost(x, u, d, p) + u[0])
    assert changed_key(problem=replace(PROBLEM, model=other)) != changed_key()


def test_key_forgets_what_only_the_nmpc_reads():
    other = replace(PROBLEM, horizon=20, substeps=7, discount=0.5, reference_cost=1.0)
    assert changed_key(problem=other) == changed_key()
    discounted = Settings(criterion="discounted")
    assert changed_key(problem=other, settings=discounted) != changed_key(settings=discounted)
