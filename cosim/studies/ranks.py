"""Comparisons of cases by pairs of their runs, and ranks, shared where no difference is shown."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
import pandas as pd

from cosim.core.protocols import Array
from cosim.core.statistics import paired_difference

NO_SEED = -1
"""Stands for the training seed of a controller, which has none."""


def shared_ranks(
    cases: Sequence[str],
    trained_once: Collection[str],
    is_worse: Callable[[str, str], bool],
) -> dict[str, int | None]:
    """Rank cases; those that are not shown to be worse than the first of their group share its.

    Args:
        cases: names in the order of their costs, the lowest first.
        trained_once: of them those with one training, whose spread is unknown: they have no rank,
            and no other case's rank depends on them.
        is_worse: whether a case is shown to cost more than another one.

    Returns:
        Rank of each case, from 1; None where it has none.
    """
    ranks: dict[str, int | None] = {}
    leader = ""
    rank = 0
    # How many cases have a rank so far: after two that share rank 1 comes rank 3.
    place = 0
    for case in cases:
        if case in trained_once:
            ranks[case] = None
            continue
        place += 1
        if not leader or is_worse(case, leader):
            leader = case
            rank = place
        ranks[case] = rank
    return ranks


def paired_runs(cost: pd.DataFrame, other: pd.DataFrame) -> tuple[Array, Array]:
    """Costs of two cases over the training seeds that both have.

    Args:
        cost: J, a row for each training seed (`NO_SEED` of a controller), a column for each seed
            of the noise.
        other: J' of the case that it is compared with, likewise.

    Returns:
        J and J', (R, S) each; R is 0 where both are trained and have no seed in common.
    """
    has_controller = NO_SEED in cost.index or NO_SEED in other.index
    if not has_controller:
        # Both are in the order of the training seeds, so that rows of one number are a pair.
        common = cost.index.intersection(other.index)
        cost = cost[cost.index.isin(common)]
        other = other[other.index.isin(common)]
    # A controller has one row, which is compared with each run.
    cost_array, other_array = np.broadcast_arrays(cost.to_numpy(), other.to_numpy())
    return cost_array, other_array


def costs_more(cost: Array, other: Array, optimum: Array) -> bool:
    """Whether paired runs are shown to cost more: the interval of the difference is above zero.

    Args:
        cost: J of each run and noise seed, (R, S).
        other: J' of the counterparts, (R, S).
        optimum: J* on the same noise, (S,).

    Returns:
        False, too, where nothing is known: without a pair, or without an interval.
    """
    if not cost.size:
        return False
    _, interval, _ = paired_difference(cost, other, optimum)
    if interval is None:
        return False
    low, _ = interval
    return low > 0
