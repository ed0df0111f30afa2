"""The gains that the paper's text states, beside a study's: over (a) naive and over (b) tuned."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cosim.protocols import Array
from cosim.statistics import Estimate, gain, shown

PAPER = {"naive": 21.0, "tuned": 15.0}
"""Gain of the paper's RL-tuned RTI-NMPC over (a) and (b), in per cent."""
NEAR = 3.0
"""Per cent within which a gain agrees with the paper's, which are approximate."""
TITLE = "Gains over the baselines: the paper's text states about 21 % over (a) and 15 % over (b)"
HEADER = (
    "scenario", "case", "J(b)/J(a)", "J, median", "gain over (a) %", "gain over (b) %",
    "economic over (a) %", "economic over (b) %", "agrees with the paper on",
)  # fmt: skip


def comparison(
    scenarios: Sequence[str],
    trained: Sequence[str],
    indicator: Callable[[str, str, str], Array],
) -> tuple[str, Sequence[str], list[list[str]]]:
    """Title, header and rows: gains of each trained case's median run on every scenario.

    `indicator` maps case, scenario and name to values (R, S) of runs on noise seeds. The paper's
    two gains imply J(b)/J(a) = (1 − 0.21)/(1 − 0.15) = 0.93, whatever was learnt.
    """
    rows = []
    for scenario in scenarios:
        bases = {name: indicator(name, scenario, "J") for name in PAPER}
        if not all(map(len, bases.values())):
            continue
        ratio = bases["tuned"].mean() / bases["naive"].mean()
        for case in trained:
            cost = indicator(case, scenario, "J")
            if not len(cost):
                continue
            order = np.argsort(cost.mean(axis=1), kind="stable")
            middle = order[(len(order) - 1) // 2]
            gains: dict[str, list[Estimate]] = {}
            for name in ("J", "economic_cost"):
                own = indicator(case, scenario, name)[middle]
                gains[name] = [gain(own, indicator(base, scenario, name)[0]) for base in PAPER]
            agrees = [
                f"({letter})"
                for letter, found, wanted in zip("ab", gains["J"], PAPER.values(), strict=True)
                if abs(100 * found.value - wanted) <= NEAR
            ]
            rows.append(
                [
                    scenario,
                    case,
                    f"{ratio:.3f}",
                    shown(float(cost[middle].mean()), None, 1.0, 6),
                    *(shown(one.value, one.t, 100.0, 3) for each in gains.values() for one in each),
                    " and ".join(agrees),
                ]
            )
    return TITLE, HEADER, rows
