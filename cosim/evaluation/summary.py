"""What an evaluation says: means, intervals over seeds, and paired comparisons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.evaluation.statistics import gain, gap_closed, mean, regret

if TYPE_CHECKING:
    from cosim.evaluation.table import Evaluation

MEANS = ("economic_cost", "mean_violation", "violating_share", "J", "input_effort")
COMPARED = ("J", "economic_cost", "mean_violation", "violating_share")


def summarise(evaluation: Evaluation) -> dict[str, Any]:
    """An evaluation as a JSON document: controllers, comparisons, provenance, timing.

    `controllers`: per controller the means over all seeds and samples, `failures` in total,
    `settling_time` [s], `intervals` of each mean, where J* is known the `regret` (J − J*)/|J*|,
    and where the naive controller is there too `gap_closed` = (J_naive − J)/(J_naive − J*).
    `comparisons`: for each pair, the paired difference controller − reference of each mean, and
    `gain_in_J`, (J_ref − J)/|J_ref|. Every interval is of 95 %, paired over seeds, once by
    Student's t and once by BCa bootstrap. `optimal_J` is J* on the same seeds.
    """
    names = list(evaluation.controllers)
    return {
        **evaluation.facts,
        "seeds": list(evaluation.seeds),
        "reference": evaluation.reference,
        "optimum": evaluation.optimum,
        "optimal_J": None if evaluation.optimum is None else float(np.mean(evaluation.optimal)),
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
    if evaluation.optimum is None:
        return document
    cost = evaluation.column(name, "J")
    document["regret"] = regret(cost, evaluation.optimal).to_dict()
    if evaluation.naive is not None:
        naive = evaluation.column(evaluation.naive, "J")
        document["gap_closed"] = gap_closed(cost, naive, evaluation.optimal).to_dict()
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
        "gain_in_J": gain(cost, base).to_dict(),
    }


def _timing(evaluation: Evaluation, name: str) -> dict[str, float]:
    """Median over seeds of each of the clock's figures."""
    timings = [evaluation.results[name, seed].timing for seed in evaluation.seeds]
    return {key: float(np.median([timing[key] for timing in timings])) for key in timings[0]}
