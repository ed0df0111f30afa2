"""Ranks of cases, shared by those that cannot be told apart."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from cosim.core.protocols import Array
from cosim.core.statistics import paired_difference


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
