import numpy as np
import pytest

from learning.checkpoint import Checkpoint, generator_state, load, restore_generator, save
from learning.errors import CheckpointError

RUN = {"algorithm": "actor-critic", "seed": 3, "deviation": (5.0,)}


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "checkpoint.npz"
    checkpoint = Checkpoint(RUN, {"number": 7}, {"theta": np.linspace(0, 1, 5)})
    return save(path, checkpoint)


def test_arrays_and_state_come_back_exactly(stored):
    found = load(stored, RUN)
    assert found.state == {"number": 7}
    assert np.array_equal(found.arrays["theta"], np.linspace(0, 1, 5))


def test_another_runs_checkpoint_is_refused_by_the_field_that_differs(stored):
    with pytest.raises(CheckpointError, match="seed is 3 there and 4 here"):
        load(stored, {**RUN, "seed": 4})


def test_a_missing_checkpoint_says_what_to_do(tmp_path):
    with pytest.raises(CheckpointError, match="without --resume"):
        load(tmp_path / "checkpoint.npz")


@pytest.mark.parametrize("position", range(0, 1200, 97))
def test_damage_anywhere_is_refused(stored, position):
    data = bytearray(stored.read_bytes())
    data[position % len(data)] ^= 0xFF
    stored.write_bytes(bytes(data))
    try:
        found = load(stored, RUN)
    except CheckpointError:
        return
    # A flipped bit in the archive's own slack harms nothing.
    assert np.array_equal(found.arrays["theta"], np.linspace(0, 1, 5))
    assert found.state == {"number": 7}


def test_half_a_file_is_refused(stored):
    stored.write_bytes(stored.read_bytes()[:200])
    with pytest.raises(CheckpointError, match="not a readable checkpoint"):
        load(stored, RUN)


def test_a_pickle_is_refused(tmp_path):
    path = tmp_path / "checkpoint.npz"
    np.savez(path, about=np.array([{"a": 1}], dtype=object))
    with pytest.raises(CheckpointError):
        load(path)


def test_python_objects_are_not_stored(tmp_path):
    entries = {"x": np.array([object()])}
    with pytest.raises(CheckpointError, match="'x' holds Python objects"):
        save(tmp_path / "checkpoint.npz", Checkpoint(RUN, {}, entries))
    assert list(tmp_path.iterdir()) == []


def test_a_generator_goes_on_where_it_was():
    rng = np.random.default_rng(1)
    rng.random(10)
    other = np.random.default_rng(2)
    restore_generator(other, generator_state(rng))
    assert np.array_equal(rng.random(5), other.random(5))


def test_another_generators_state_is_refused():
    rng = np.random.default_rng(1)
    with pytest.raises(CheckpointError, match="cannot be restored"):
        restore_generator(rng, {"bit_generator": "MT19937"})
