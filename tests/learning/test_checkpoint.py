from dataclasses import dataclass, field

import numpy as np
import pytest

from learning.checkpoint import (
    Checkpoint,
    arrays_of,
    generator_state,
    load,
    restore_generator,
    save,
    take_up,
)
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


def test_a_generator_goes_on_where_it_was():
    rng = np.random.default_rng(1)
    rng.random(10)
    other = np.random.default_rng(2)
    restore_generator(other, generator_state(rng))
    assert np.array_equal(rng.random(5), other.random(5))
    with pytest.raises(CheckpointError):
        restore_generator(rng, {"bit_generator": "MT19937"})


@dataclass
class Memory:
    number: int = 0
    mean: float = 0.0
    began: bool = False
    weights: np.ndarray = field(default_factory=lambda: np.zeros(3))


def test_a_dataclass_goes_through_arrays_with_the_types_that_it_had():
    arrays = arrays_of(Memory(3, 0.1, True, np.arange(4.0)))
    found = Memory()
    take_up(found, arrays)
    assert (found.number, found.mean, found.began) == (3, 0.1, True)
    assert (type(found.number), type(found.began)) == (int, bool)
    assert found.weights.tolist() == [0.0, 1.0, 2.0, 3.0]
    with pytest.raises(KeyError):
        take_up(found, {})
