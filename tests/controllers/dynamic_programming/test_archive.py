import os
from dataclasses import replace

import numpy as np
import pytest

from controllers.dynamic_programming import archive
from controllers.dynamic_programming.certificate import Certificate, Figure
from controllers.dynamic_programming.plant import PlantProblem
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
    found = solve(SCALAR.plant, Settings(level=1))
    figure = Figure("solution", found.gain, found.lower, found.upper)
    return replace(found, certificate=Certificate((figure,)))


@pytest.fixture
def stored(optimum, tmp_path):
    return archive.write(tmp_path / "policy.npz", optimum, "abc")


def test_a_solution_survives_storage_bit_for_bit(optimum, stored):
    found = archive.read(stored, "abc", SCALAR.problem)
    for name in ("actions", "W", "distribution"):
        np.testing.assert_array_equal(getattr(found, name), getattr(optimum, name))
    for ours, theirs in zip(found.grid.axes, optimum.grid.axes, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (found.gain, found.lower, found.upper) == (optimum.gain, optimum.lower, optimum.upper)
    assert (found.discount, found.accuracy) == (optimum.discount, optimum.accuracy)
    assert found.grid.smooth == optimum.grid.smooth
    assert found.certificate == optimum.certificate


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
        archive.read(stored, "abc", SCALAR.problem)


def test_a_pickle_is_refused(tmp_path):
    path = tmp_path / "policy.npz"
    np.savez(path, document=np.array([{"key": "abc"}], dtype=object))
    with pytest.raises(OptimumError, match="not a readable optimal policy"):
        archive.read(path, "abc", SCALAR.problem)


WRONG = {
    "one value less": (lambda o: {"W": o.W[:-1]}, "do not fit its grid"),
    "actions of one axis": (lambda o: {"actions": o.actions[:, 0]}, "do not fit its grid"),
    "NaN": (lambda o: {"W": np.full_like(o.W, np.nan)}, "not finite"),
    "infinite": (lambda o: {"actions": o.actions + np.inf}, "not finite"),
    "complex": (lambda o: {"W": o.W.astype(complex)}, "not finite numbers"),
    "gain below its bounds": (lambda o: {"gain": o.lower - 1.0}, "do not enclose"),
    "gain above its bounds": (lambda o: {"gain": o.upper + 1.0}, "do not enclose"),
    "bounds inverted": (lambda o: {"lower": o.upper + 1, "upper": o.lower}, "do not enclose"),
    "bound NaN": (lambda o: {"upper": np.nan}, "do not enclose"),
    "huge actions": (lambda o: {"actions": o.actions + 1e9}, "actions beyond their bounds"),
    "negative share": (lambda o: {"distribution": o.distribution - 1.0}, "distribution is none"),
    "no share": (lambda o: {"distribution": 0.0 * o.distribution}, "distribution is none"),
}


@pytest.mark.parametrize("what", WRONG)
def test_content_that_cannot_be_is_refused_though_its_checksum_fits(optimum, tmp_path, what):
    change, message = WRONG[what]
    path = archive.write(tmp_path / "policy.npz", replace(optimum, **change(optimum)), "abc")
    with pytest.raises(OptimumError, match=message):
        archive.read(path, "abc", SCALAR.problem)


def test_content_changed_by_hand_is_refused(stored):
    with np.load(stored) as file:
        arrays = dict(file)
    arrays["W"] = arrays["W"] + 1e-9
    np.savez_compressed(stored, **arrays)
    with pytest.raises(OptimumError, match="its checksum does not fit its content; delete it"):
        archive.read(stored, "abc", SCALAR.problem)


def test_the_packages_own_is_preferred_to_the_users(optimum, tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    archive.keep("abc", lambda: optimum)
    assert archive.stored("abc") == tmp_path / "optima" / "abc.npz"
    archive.write(tmp_path / "shipped" / "abc.npz", optimum, "abc")
    monkeypatch.setattr(archive, "SHIPPED", tmp_path / "shipped")
    assert archive.stored("abc") == tmp_path / "shipped" / "abc.npz"


def test_another_problems_file_is_refused(stored):
    with pytest.raises(OptimumError, match="policy of problem abc, not of def"):
        archive.read(stored, "def", SCALAR.problem)


def test_what_is_solved_once_is_read_the_next_time(optimum, tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    calls = []

    def make():
        calls.append(1)
        return optimum

    first, second = (archive.obtain("abc", SCALAR.problem, make) for _ in range(2))
    assert len(calls) == 1
    np.testing.assert_array_equal(first.W, second.W)


def test_a_cache_that_cannot_be_written_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "file"))
    calls = []
    with pytest.raises(OptimumError, match=r"cannot be kept there .*COSIM_CACHE"):
        archive.obtain("abc", SCALAR.problem, lambda: calls.append(1))
    assert not calls


OPENED = {
    "folder open to others": lambda path: path.parent.chmod(0o777),
    "cache open to others": lambda path: path.parent.parent.chmod(0o777),
    "file open to others": lambda path: path.chmod(0o666),
    "link": lambda path: path.rename(path.with_name("b")) and path.symlink_to("b"),
    "second name": lambda path: path.with_name("b").hardlink_to(path),
}


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
@pytest.mark.parametrize("how", OPENED)
def test_what_others_may_have_written_is_not_read(optimum, tmp_path, monkeypatch, how):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    archive.keep("abc", lambda: optimum)
    OPENED[how](tmp_path / "cache" / "optima" / "abc.npz")
    assert archive.stored("abc") is None


def changed_key(problem=PROBLEM, law=LAW, parameters=P, settings=None):
    return archive.key(PlantProblem(problem, law, parameters), settings or Settings())


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
