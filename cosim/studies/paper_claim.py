"""The paper's claim, gains of about 21 % over (a) and 15 % over (b), beside what a study found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from math import hypot, isfinite
from typing import NamedTuple

import numpy as np

from cosim.core import statistics
from cosim.core.protocols import Array
from cosim.core.result import TextTable
from cosim.core.statistics import shown
from cosim.studies.measurements import StudyMeasurements

PAPER = {"naive": 21.0, "tuned": 15.0}
"""Gain of the paper's RL-tuned RTI-NMPC over (a) and (b), in per cent."""
NEAR = 3.0
"""Per cent within which a gain agrees with the paper's, which are approximate."""
IMPLIED_RATIO = (1 - PAPER["naive"] / 100) / (1 - PAPER["tuned"] / 100)
"""J(b)/J(a) that both gains of the paper imply, 0.93."""


class Gains(NamedTuple):
    """Gain of the median run of a trained case over both baselines on a scenario.

    Attributes:
        scenario, case: names.
        n_runs: trainings of the case.
        ratio: J(b)/J(a).
        cost: J of the median run.
        over_a, over_b: gain in J over naive (a) and tuned (b).
        economic_over_a, economic_over_b: the same of the economic cost alone.
    """

    scenario: str
    case: str
    n_runs: int
    ratio: float
    cost: float
    over_a: statistics.Estimate
    over_b: statistics.Estimate
    economic_over_a: statistics.Estimate
    economic_over_b: statistics.Estimate

    @property
    def agrees_on(self) -> list[str]:
        """The baselines, `(a)` and `(b)`, over which the gain is the paper's."""
        agreeing = []
        if abs(100 * self.over_a.value - PAPER["naive"]) <= NEAR:
            agreeing.append("(a)")
        if abs(100 * self.over_b.value - PAPER["tuned"]) <= NEAR:
            agreeing.append("(b)")
        return agreeing

    @property
    def distance(self) -> float:
        """Distance of both gains from the paper's, in per cent."""
        from_a = 100 * self.over_a.value - PAPER["naive"]
        from_b = 100 * self.over_b.value - PAPER["tuned"]
        return hypot(from_a, from_b)


def all_gains(study: StudyMeasurements) -> list[Gains]:
    """Gains of each trained case on every scenario that has both baselines."""
    trained = [name for name, case in study.cases.items() if case["trained"]]
    gains = []
    for scenario, case in product(study.scenarios, trained):
        indicators = study.indicators.get((scenario, case))
        naive = study.indicators.get((scenario, "naive"))
        tuned = study.indicators.get((scenario, "tuned"))
        # A case, or a baseline, may not run on this scenario.
        if indicators is None or naive is None or tuned is None:
            continue
        gains.append(_gains(scenario, case, indicators, naive, tuned))
    return gains


def _gains(
    scenario: str,
    case: str,
    indicators: Mapping[str, Array],
    naive: Mapping[str, Array],
    tuned: Mapping[str, Array],
) -> Gains:
    """Gains of a case's median run.

    Args:
        scenario: its name.
        case: its name.
        indicators: of the case, (R, S) each.
        naive: indicators of the controller (a), (1, S) each.
        tuned: indicators of the controller (b), (1, S) each.
    """
    cost = indicators["J"].mean(axis=1)
    by_cost = np.argsort(cost, kind="stable")
    # Of an even number the mean of both middle runs, as everywhere.
    first = (len(cost) - 1) // 2
    middle = by_cost[first : len(cost) // 2 + 1]

    def gain(name: str, baseline: Mapping[str, Array]) -> statistics.Estimate:
        of_median = indicators[name][middle].mean(axis=0)
        # A controller has one run.
        return statistics.gain(of_median, baseline[name][0])

    return Gains(
        scenario,
        case,
        n_runs=len(cost),
        ratio=float(tuned["J"].mean() / naive["J"].mean()),
        cost=float(cost[middle].mean()),
        over_a=gain("J", naive),
        over_b=gain("J", tuned),
        economic_over_a=gain("economic_cost", naive),
        economic_over_b=gain("economic_cost", tuned),
    )


def paper_table(study: StudyMeasurements) -> TextTable:
    """Title, header and rows: gains of each trained case's median run on every scenario.

    The paper's two gains imply J(b)/J(a) = (1 − 0.21)/(1 − 0.15) = 0.93.
    """
    rows = []
    for gains in all_gains(study):
        estimates = (gains.over_a, gains.over_b, gains.economic_over_a, gains.economic_over_b)
        cells = []
        for gain in estimates:
            cells.append(shown(gain.value, gain.interval, scale=100.0, digits=3))
        rows.append(
            [
                gains.scenario,
                gains.case,
                f"{gains.ratio:.3f}",
                shown(gains.cost, digits=6),
                *cells,
                " and ".join(gains.agrees_on),
            ]
        )
    title = (
        "Gains over the baselines: the paper's text states about 21 % over (a) and 15 % over (b)"
    )
    header = (
        "scenario",
        "case",
        "J(b)/J(a)",
        "J, median",
        "gain over (a) %",
        "gain over (b) %",
        "economic over (a) %",
        "economic over (b) %",
        "agrees with the paper on",
    )
    return title, header, rows


def _cheaper(ratios: Sequence[float]) -> str:
    """What (b) costs beside (a), from the least to the greatest J(b)/J(a), in words."""
    words = []
    for ratio in (min(ratios), max(ratios)):
        side = "cheaper" if ratio <= 1 else "dearer"
        words.append(f"{100 * abs(1 - ratio):.0f} % {side}")
    return f"it is {' to '.join(dict.fromkeys(words))}"


def paper_verdict(study: StudyMeasurements) -> dict[str, str]:
    """The paper's claim, what was found, and whether that reproduces it and why, a line each."""
    claim = (
        f"learning gains {PAPER['naive']:.0f} % over (a) the naive and {PAPER['tuned']:.0f} % over "
        "(b) the tuned controller"
    )
    # A run that diverged may have no finite cost.
    every = [gains for gains in all_gains(study) if isfinite(gains.distance)]
    if not every:
        return {
            "claim": claim,
            "found": "no finished training beside both baselines",
            "verdict": "neither reproduced nor refuted",
        }
    nearest = min(every, key=lambda gains: gains.distance)
    n_runs = "one run" if nearest.n_runs == 1 else f"{nearest.n_runs} runs"
    found = (
        f"of {len(every)} trainings and readings the nearest gains "
        f"{100 * nearest.over_a.value:.0f} % and {100 * nearest.over_b.value:.0f} % "
        f"({nearest.case} on {nearest.scenario}, median of {n_runs})"
    )
    agreeing = [gains for gains in every if len(gains.agrees_on) == len(PAPER)]
    if agreeing:
        names = ", ".join(f"{gains.case} on {gains.scenario}" for gains in agreeing)
        verdict = f"reproduced within {NEAR:.0f} %, by {names}"
    else:
        ratios = [gains.ratio for gains in every]
        verdict = (
            f"not reproduced: none is within {NEAR:.0f} % of both. The paper's two gains need (b) "
            f"{100 * (1 - IMPLIED_RATIO):.0f} % cheaper than (a); here, without any learning, "
            f"{_cheaper(ratios)}"
        )
    return {"claim": claim, "found": found, "verdict": verdict}
