from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest

from learning.checkpoint import arrays_of, load, save, take_up
from learning.errors import CheckpointError

RUN = {"algorithm": "actor-critic", "seed": 3, "deviation": (5.0,)}


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "checkpoint.npz"
    return save(path, RUN, {"theta": np.linspace(0, 1, 5)})


def test_another_runs_checkpoint_is_refused_by_the_field_that_differs(stored):
    with pytest.raises(CheckpointError, match="seed is 3 there and 4 here"):
        load(stored, {**RUN, "seed": 4})


@dataclass
class Memory:
    KEPT: ClassVar = ("number", "mean", "began", "weights")
    number: int = 0
    mean: float = 0.0
    began: bool = False
    weights: np.ndarray = field(default_factory=lambda: np.zeros(3))


class Kept:
    KEPT = ("memory", "table", "rows", "nothing")

    def __init__(self):
        self.memory, self.table, self.rows, self.nothing = Memory(), {}, [], None


def test_what_is_kept_goes_through_arrays_with_the_types_that_it_had():
    first, found = Kept(), Kept()
    first.memory = Memory(3, 0.1, True, np.arange(4.0))
    first.table, first.rows = {"a b": np.ones(2)}, [np.zeros(2), np.ones(2)]
    take_up(found, arrays_of(first))
    memory = found.memory
    assert (memory.number, memory.mean, memory.began) == (3, 0.1, True)
    assert (type(memory.number), type(memory.began)) == (int, bool)
    assert memory.weights.tolist() == [0.0, 1.0, 2.0, 3.0]
    assert found.table["a b"].tolist() == [1.0, 1.0] and found.nothing is None
    assert [row.tolist() for row in found.rows] == [[0.0, 0.0], [1.0, 1.0]]
    take_up(found, arrays_of(Kept()))
    assert found.rows == [] and found.table == {}
    with pytest.raises(KeyError):
        take_up(found, {})
