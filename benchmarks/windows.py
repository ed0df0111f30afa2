"""Was the plant ever dearer to run than before learning: windows of samples, paired with `held`.

    python -m benchmarks.windows fouled --algorithm model-based --seeds 5 --samples 10080

The same start, held, meets the same noise. From the first change of θ on, each window of 480
samples is dearer where the mean of the paired differences of cost is above zero by more than the
noise explains: one-sided t of its 20 blocks of 24 samples, 95 %. One window in twenty is by chance
where both cost the same.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from controllers import compile_functions
from cosim.plant import FmuPlant
from cosim.scenario import Scenario
from learning.algorithm import load_algorithm
from learning.training import begin, prepare

WINDOW, BLOCK = 480, 24


def life(
    scenario: Scenario, algorithm: str, start: str, seed: int, samples: int
) -> tuple[NDArray[np.float64], int]:
    """Cost of each sample of a run, (samples,), and the samples before its first change of θ."""
    run = prepare(algorithm, scenario, samples, None, {"seed": seed, "start": start})
    costs, first = np.empty(samples), samples
    with FmuPlant(scenario) as plant:
        loop = begin(run, load_algorithm(algorithm), plant)
        compile_functions(loop.controller, samples)
        for k in range(samples):
            costs[k], update = loop.advance()
            if update is not None and update.step > 0:
                first = min(first, k + 1)
    return costs, first


def main() -> None:
    """Print a line for each training seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--algorithm", default="model-based")
    parser.add_argument("--start", default="commissioned")
    parser.add_argument("--first-seed", type=int, default=3000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--samples", type=int, default=10_080)
    chosen = parser.parse_args()
    scenario = Scenario.load(chosen.scenario)
    print(f"{chosen.algorithm} against held, {chosen.scenario} from {chosen.start}")
    print("seed  first change  windows  dearer  dearest, % of held  all, % of held", flush=True)
    for seed in range(chosen.first_seed, chosen.first_seed + chosen.seeds):
        costs, first = life(scenario, chosen.algorithm, chosen.start, seed, chosen.samples)
        held, _ = life(scenario, "held", chosen.start, seed, chosen.samples)
        excess = (costs - held)[first:]
        count = len(excess) // WINDOW
        blocks = excess[: count * WINDOW].reshape(count, -1, BLOCK).mean(axis=2)
        mean, error = blocks.mean(axis=1), blocks.std(axis=1, ddof=1) / blocks.shape[1] ** 0.5
        dearer = int((mean > student.ppf(0.95, blocks.shape[1] - 1) * error).sum())
        print(
            f"{seed:4d} {first:13d} {count:8d} {dearer:7d} {100 * mean.max() / held.mean():19.2f} "
            f"{100 * excess.mean() / held.mean():15.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
