"""Finished units are lines of one file: nothing that was written is lost, nothing torn is read."""

import errno
import os

import pytest

from cosim.errors import EvaluationError
from cosim.evaluation.store import FILE, Store
from cosim.evaluation.unit import SETTLING, UnitResult


def unit(first, count=2):
    seeds = tuple(range(first, first + count))
    return UnitResult(
        seeds, {"J": [0.1 * s for s in seeds]}, {"wall_time_s": [1.0] * count}, ("compiled",)
    )


@pytest.fixture
def stored(tmp_path):
    store = Store(tmp_path)
    for first in (0, 2, 4):
        store.save("a", unit(first))
    return tmp_path / FILE


def found(path, *keys):
    return list(Store(path.parent).load(keys or ("a",)))


def test_what_was_saved_is_loaded_to_the_same_bits(stored):
    assert found(stored) == [("a", unit(0)), ("a", unit(2)), ("a", unit(4))]


def test_a_settling_run_has_no_seed(tmp_path):
    Store(tmp_path).save("a", UnitResult(SETTLING, {"settling_time": [float("inf")]}, {}))
    ((_, result),) = found(tmp_path / FILE)
    assert (result.seeds, result.indicators) == (SETTLING, {"settling_time": [float("inf")]})


def test_units_of_other_keys_are_passed_over(stored):
    Store(stored.parent).save("b", unit(9))
    assert found(stored, "b") == [("b", unit(9))]
    assert found(stored, "c") == []


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.999])
def test_a_torn_line_counts_for_nothing_and_makes_room(stored, share):
    whole = stored.read_bytes()
    last = len(whole.splitlines(keepends=True)[-1])
    stored.write_bytes(whole[: len(whole) - last + int(share * last)])
    assert [result for _, result in found(stored)] == [unit(0), unit(2)]
    Store(stored.parent).save("a", unit(4))
    assert stored.read_bytes() == whole


def test_a_torn_line_longer_than_what_is_read_at_once_makes_room(stored):
    whole = stored.read_bytes()
    stored.write_bytes(whole + b"x" * 200_000)
    Store(stored.parent).save("a", unit(6))
    assert [result for _, result in found(stored)] == [unit(0), unit(2), unit(4), unit(6)]


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize(
    "old, new", [(b"0.", b"1."), (b"seeds", b"seed"), (b"[", b""), (b"{", b"")]
)
def test_a_damaged_line_is_named_wherever_it_is(stored, number, old, new):
    lines = stored.read_bytes().splitlines(keepends=True)
    lines[number - 1] = lines[number - 1].replace(old, new, 1)
    stored.write_bytes(b"".join(lines))
    with pytest.raises(EvaluationError, match=rf"^line {number} of the finished work units"):
        found(stored)


@pytest.mark.parametrize(
    "content", [b"\n", b"[]\n", b"\xff\n", b"[" * 9999 + b"\n", b"1" * 9999 + b"\n"]
)
def test_a_file_of_another_kind_is_refused(stored, content):
    stored.write_bytes(content)
    with pytest.raises(EvaluationError, match="is damaged; delete the line, or the file"):
        found(stored)


def test_a_folder_in_its_place_is_refused(tmp_path):
    (tmp_path / FILE).mkdir()
    with pytest.raises(EvaluationError, match="not a regular file"):
        found(tmp_path / FILE)
    with pytest.raises(OSError, match="units"):
        Store(tmp_path).save("a", unit(0))


def test_a_full_disk_is_named_and_leaves_what_was_there(stored, monkeypatch):
    before = stored.read_bytes()

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=FILE):
        Store(stored.parent).save("a", unit(6))
    assert stored.read_bytes() == before


def test_without_a_folder_nothing_is_stored(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Store(None).save("a", unit(0))
    assert list(Store(None).load({"a"})) == []
    assert list(tmp_path.iterdir()) == []
