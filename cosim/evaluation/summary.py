"""What an evaluation says: means, intervals over seeds, and paired comparisons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.evaluation.statistics import mean, ratio

if TYPE_CHECKING:
    from cosim.evaluation.table import Evaluation

MEANS = ("economic_cost", "mean_violation", "violating_share", "J", "input_effort")
COMPARED = ("J", "economic_cost", "mean_violation", "violating_share")


def summarise(evaluation: Evaluation) -> dict[str, Any]:
    """An evaluation as a JSON document: controllers, comparisons, provenance, timing.

    `controllers`: per controller the means over all seeds and samples, `failures` in total,
    `settling_time` [s], `intervals` of each mean, and `gap_closed` = (J_ref − J)/(J_ref − J*) where
    the optimum is among the controllers. `comparisons`: for each pair, the paired difference
    controller − reference of each mean, and the economic gain (J_ref − J)/J_ref. Every interval is
    of 95 %, over seeds, once by Student's t and once by BCa bootstrap.
    """
    names = list(evaluation.controllers)
    return {
        **evaluation.facts,
        "seeds": list(evaluation.seeds),
        "reference": evaluation.reference,
        "optimum": evaluation.optimum,
        "controllers": {name: _controller(evaluation, name) for name in names},
        "comparisons": [
            _comparison(evaluation, name, reference)
            for i, name in enumerate(names)
            for reference in names[:i]
        ],
        "timing": {name: _timing(evaluation, name) for name in names},
    }


def _controller(evaluation: Evaluation, name: str) -> dict[str, Any]:
    estimates = {key: mean(evaluation.column(name, key)) for key in MEANS}
    document: dict[str, Any] = {key: estimate.value for key, estimate in estimates.items()}
    document |= {
        "failures": int(np.sum(evaluation.column(name, "failures"))),
        "settling_time": evaluation.settling[name],
        "parameters_hash": evaluation.parameters[name],
        "intervals": {
            key: {"t": estimate.t, "bootstrap": estimate.bootstrap}
            for key, estimate in estimates.items()
        },
    }
    if evaluation.optimum is not None and evaluation.optimum != evaluation.reference:
        reference = evaluation.column(evaluation.reference, "J")
        document["gap_closed"] = ratio(
            reference - evaluation.column(name, "J"),
            reference - evaluation.column(evaluation.optimum, "J"),
        ).to_dict()
    return document


def _comparison(evaluation: Evaluation, name: str, reference: str) -> dict[str, Any]:
    cost, base = evaluation.column(name, "J"), evaluation.column(reference, "J")
    return {
        "controller": name,
        "reference": reference,
        "differences": {
            key: mean(evaluation.column(name, key) - evaluation.column(reference, key)).to_dict()
            for key in COMPARED
        },
        "economic_gain": ratio(base - cost, base).to_dict(),
    }


def _timing(evaluation: Evaluation, name: str) -> dict[str, float]:
    """Median over seeds of each of the clock's figures."""
    timings = [evaluation.results[name, seed].timing for seed in evaluation.seeds]
    return {key: float(np.median([timing[key] for timing in timings])) for key in timings[0]}
