"""An evaluation by two workers beside the same by one, starting the workers included."""

from time import perf_counter

from benchmarks.measuring import figure
from cosim import evaluate

SEEDS, JOBS, REPETITIONS = 100, 2, 3


def measure(scenario, steps):
    """Wall time of a sample; AssertionError where one and two workers give other bytes."""
    seconds, tables = {1: [], JOBS: []}, set()
    evaluate(scenario, ["naive"], 1, steps, jobs=1)  # loads and compiles what is done once
    for _ in range(REPETITIONS):
        for jobs, spent in seconds.items():
            begin = perf_counter()
            found = evaluate(scenario, ["naive"], SEEDS, steps, jobs=jobs)
            spent.append((perf_counter() - begin) / (SEEDS * steps))
            tables.add(found.to_csv())
    assert len(tables) == 1
    return [figure(f"{JOBS} workers", seconds[JOBS], "1 worker", seconds[1])]
