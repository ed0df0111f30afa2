import numpy as np
import pytest

from learning.checkpoint import (
    generator_state,
    load,
    part_of,
    prefixed,
    save,
    set_generator_state,
)
from learning.errors import CheckpointError

RUN = {"algorithm": "actor-critic", "seed": 3, "deviation": (5.0,)}


@pytest.fixture
def stored(tmp_path):
    path = tmp_path / "checkpoint.npz"
    return save(path, RUN, {"theta": np.linspace(0, 1, 5), "count": 3, "mean": 0.1, "began": True})


def test_arrays_and_numbers_come_back_as_they_were(stored):
    state = load(stored, RUN)
    assert state["theta"].tolist() == np.linspace(0, 1, 5).tolist()
    assert (state["count"], state["mean"], state["began"]) == (3, 0.1, True)
    assert [type(state[name]) for name in ("count", "mean", "began")] == [int, float, bool]


def test_another_runs_checkpoint_is_refused_by_the_field_that_differs(stored):
    with pytest.raises(CheckpointError, match="seed is 3 there and 4 here"):
        load(stored, {**RUN, "seed": 4})


@pytest.mark.parametrize("value", ["a text", None])
def test_what_is_no_array_nor_number_is_refused_by_its_name(tmp_path, value):
    with pytest.raises(CheckpointError, match="mine"):
        save(tmp_path / "checkpoint.npz", RUN, {"mine": value})


def test_a_part_is_under_its_name():
    state = prefixed("filter", {"mean": 1.0, "noise.variance": 2.0}) | {"filtered": 3.0}
    assert part_of(state, "filter") == {"mean": 1.0, "noise.variance": 2.0}


def test_a_generator_goes_on_where_it_was():
    rng, other = np.random.default_rng(3), np.random.default_rng(4)
    rng.integers(10, dtype=np.int32)  # leaves half of a word
    set_generator_state(other, generator_state(rng))
    assert (
        other.integers(2**31, size=5, dtype=np.int32).tolist()
        == rng.integers(2**31, size=5, dtype=np.int32).tolist()
    )
    assert other.standard_normal(3).tolist() == rng.standard_normal(3).tolist()
