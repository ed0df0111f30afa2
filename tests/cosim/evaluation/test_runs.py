"""What is known of many runs: by seed, in the seeds' order, whatever order they come in."""

import numpy as np
import pytest

from cosim.evaluation.runs import Runs
from cosim.evaluation.unit import UnitResult


def unit(*seeds, functions=()):
    return UnitResult(
        seeds, {"J": [10.0 * s for s in seeds]}, {"wall_time_s": [1.0] * len(seeds)}, functions
    )


@pytest.mark.parametrize("seeds", [[0, 1, 2, 3], [7, 3, 2**64 - 1, 0], [5]])
def test_runs_are_found_under_their_seeds(seeds):
    runs = Runs(seeds)
    for seed in reversed(seeds):
        assert runs.add(unit(seed)) == 1
    assert runs.column("J").tolist() == [10.0 * seed for seed in seeds]
    assert runs.missing() == []


def test_what_is_missing_keeps_the_order_of_the_seeds():
    runs = Runs([9, 4, 6, 1])
    assert runs.add(unit(6, 9)) == 2
    assert runs.missing() == [4, 1]
    assert np.isnan(runs.column("J")).tolist() == [False, True, False, True]


def test_seeds_that_nobody_wants_are_left_out():
    runs = Runs([4, 6])
    assert runs.add(unit(5, 6, 7, functions=("compiled",))) == 1
    assert runs.add(unit(1, 99, functions=("interpreted",))) == 0
    assert runs.missing() == [4]
    assert runs.functions == {"compiled"}


def test_a_run_that_comes_twice_counts_once():
    runs = Runs([4, 6])
    assert (runs.add(unit(4)), runs.add(unit(4, 6))) == (1, 1)
