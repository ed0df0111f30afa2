"""How much faster several workers are than one, and that they give the same bytes."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import Any

from cosim.evaluation.paired import evaluate
from cosim.evaluation.unit import Factory
from cosim.scenario import Scenario

WARM_UP = 3000
"""Samples after which functions that are worth it have been compiled, or are about to be."""


def measure(
    scenario: Scenario,
    controllers: Mapping[str, Factory],
    seeds: int,
    steps: int,
    jobs: int,
    repetitions: int = 3,
) -> dict[str, Any]:
    """Wall times in s of one evaluation by 1 and by `jobs` workers in turn, and their ratio.

    Starting the workers and building the controllers counts; in this process a controller is built
    once too. `speed_up` is the ratio of the least times, which others on the machine spoil least;
    `same_bytes` says whether every repetition gave the same table. A first, short evaluation by
    one worker loads what is loaded once, and compiles what is compiled once.
    """
    times: dict[int, list[float]] = {1: [], jobs: []}
    tables = set()
    evaluate(scenario, controllers, 1, min(steps, WARM_UP), jobs=1)
    for _ in range(repetitions):
        for workers, spent in times.items():
            begin = perf_counter()
            evaluation = evaluate(scenario, controllers, seeds, steps, jobs=workers)
            spent.append(perf_counter() - begin)
            tables.add(evaluation.to_csv())
    return {
        "scenario": scenario.name,
        "controllers": list(controllers),
        "seeds": seeds,
        "steps": steps,
        "jobs": jobs,
        "same_bytes": len(tables) == 1,
        "timing": {
            "seconds_by_jobs": {str(workers): values for workers, values in times.items()},
            "speed_up": min(times[1]) / min(times[jobs]),
        },
    }
