"""The paper's own figures beside a study's: gains over its baselines (a) naive and (b) tuned."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cosim.statistics import Estimate, gain, shown
from cosim.study import online, theta
from cosim.study.records import RunResult
from cosim.study.results import StudyResults

Lines = list[list[str]]

NAIVE, TUNED = "naive", "tuned"
PAPER = {NAIVE: 21.0, TUNED: 15.0}
"""Gain of the paper's RL-tuned RTI-NMPC over (a) and (b), in per cent."""
NEAR = 3.0
"""Per cent within which a gain is taken for the paper's, which it gives as approximate."""
HEADER = (
    "scenario", "case", "J(b)/J(a)", "J, median", "gain over (a) %", "gain over (b) %",
    "economic over (a) %", "economic over (b) %", "like the paper",
)  # fmt: skip


def comparison(results: StudyResults) -> tuple[str, tuple[str, ...], Lines]:
    """Title, header and rows: gains of each trained case's median run on every scenario.

    The paper's two gains imply J(b)/J(a) = (1 − 0.21)/(1 − 0.15) = 0.93, whatever was learnt.
    """
    lines = []
    for scenario in results.scenarios:
        bases = {name: results.of(name, scenario) for name in PAPER}
        if not all(bases.values()):
            continue
        ratio = bases[TUNED][0].J / bases[NAIVE][0].J
        for name, case in results.cases.items():
            runs = sorted(results.of(name, scenario), key=lambda run: run.J)
            if not case.trained or not runs:
                continue
            middle = runs[(len(runs) - 1) // 2]
            gains = {base: _gain(middle, bases[base][0], "J") for base in PAPER}
            costs = [_gain(middle, bases[base][0], "economic_cost") for base in PAPER]
            lines.append(
                [
                    scenario,
                    name,
                    f"{ratio:.3f}",
                    shown(middle.J, None, 1.0, 6),
                    *(_percent(estimate) for estimate in (*gains.values(), *costs)),
                    " and ".join(_like_paper(gains)),
                ]
            )
    title = "The paper's comparison: it gives about 21 % over (a) and 15 % over (b)"
    return title, HEADER, lines


def _gain(run: RunResult, base: RunResult, figure: str) -> Estimate:
    return gain(run.indicators[figure], base.indicators[figure])


def _percent(estimate: Estimate) -> str:
    return shown(estimate.value, estimate.t, 100.0, 3)


def _like_paper(gains: dict[str, Estimate]) -> list[str]:
    """Which of the paper's two gains are shown, within `NEAR`."""
    return [
        f"({letter})"
        for letter, (name, wanted) in zip("ab", PAPER.items(), strict=True)
        if np.isfinite(gains[name].value) and abs(100 * gains[name].value - wanted) <= NEAR
    ]


FURTHER: dict[str, Callable[[StudyResults], tuple[str, tuple[str, ...], Lines]]] = {
    "paper": comparison
}


def further(results: StudyResults) -> list[tuple[str, tuple[str, ...], Lines]]:
    """The further tables that a study asks for."""
    own = [*online.tables(results), *theta.tables(results)]
    return [*own, *(FURTHER[name](results) for name in results.about["tables"])]
