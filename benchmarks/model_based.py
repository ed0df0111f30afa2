"""What the parts of `model-based` earn: greedy regret after each update, with a part taken out.

    python -m benchmarks.model_based fouled naive 12 --samples 960 --without parameters

All runs of a seed meet the same noise of the plant and explore alike until θ differs. Greedy J is
that of five held-out runs of 1000 samples, after 300, on the plant as it is at that sample;
development seeds are 11 to 19.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from controllers import compile_functions
from controllers.factories import nmpc, optimal, stored_optimum
from cosim.core.protocols import Controller
from cosim.core.scenario import Scenario
from cosim.core.simulation import simulate
from cosim.core.statistics import regrets
from cosim.core.training_options import TrainingOptions
from cosim.plant import FmuPlant
from learning.model_based import ModelBased
from learning.training_run import TrainingRun, begin_training, make_run

PARTS = {
    "parameters": {"parameter_deviation": 1e-6},  # W alone is fitted
    "slopes": {"slope_deviations": [1e-6]},  # c and offsets alone
    "evidence": {"slope_deviations": [0.1]},  # the widest prior of slopes
    "rounds": {"fit_rounds": 2},  # two Gauss-Newton steps in place of six
    "scale": {"smallest_error_size": 1e3},  # h is constant
    "doubt": {"doubt": 0.0},  # the least predicted cost, not the smallest back-off
    "tail": {"tail_widening": 0.0},
    "caution": {"least_samples": 1},
    "steadiness": {"steady_samples": 1},  # on a changed plant back-offs shrink at once
    "reach": {"state_ranges": 1e9},  # a rollout is lost by its cost alone
    "prediction": {"cost_excess": 1e9},  # no sample costs more than was predicted
    "dropping": {"forecast_evidence": 1e9},  # the fit uses all data
    "nothing": {},
}
SEEDS, STEPS, BURN = range(700_000, 700_005), 1300, 300


def greedy(scenario: Scenario, controller: Controller) -> float:
    """Mean cost per sample of a controller on the held-out noise."""
    costs = []
    with FmuPlant(scenario) as plant:
        for seed in SEEDS:
            signals = simulate(plant, controller, STEPS, seed, residuals=False).signals
            cost = signals["stage_cost"].values + signals["penalty"].values
            costs.append(cost[BURN:].mean())
    return float(np.mean(costs))


def asked(
    about: str | None, samples: int, parts: Mapping[str, Mapping[str, Any]]
) -> tuple[str, TrainingRun]:
    """The part to take out, and the run of `model-based` without it, from the arguments."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("scenario")
    parser.add_argument("start")
    parser.add_argument("seed", type=int)
    parser.add_argument("--samples", type=int, default=samples)
    parser.add_argument("--without", choices=parts, default="nothing")
    parser.add_argument("--parameters", nargs="*", default=["all"], help="of the model, in θ")
    chosen = parser.parse_args()
    settings = {"model_parameters": chosen.parameters, **parts[chosen.without]}
    options = TrainingOptions(seed=chosen.seed, start=chosen.start)
    scenario = Scenario.load(chosen.scenario)
    return chosen.without, make_run("model-based", scenario, chosen.samples, settings, options)


def main() -> None:
    """Run one trajectory and print a line for each update."""
    without, run = asked(__doc__, 960, PARTS)
    scenario, samples = run.scenario, run.samples
    best: dict[str, float] = {}
    costs: list[float] = []
    with FmuPlant(scenario) as plant:
        loop = begin_training(run, ModelBased, plant)
        judged = nmpc(scenario, loop.parameters)
        compile_functions(loop.controller, samples)
        print(f"{scenario.name} from {run.start}, seed {run.seed}, -{without}")
        print("sample   J of life    greedy J  regret %  s of CPU  elapsed  back-offs", flush=True)
        for number in range(1, samples + 1):
            begun, at = time.process_time(), time.perf_counter()
            cost, update = loop.advance()
            seconds, elapsed = time.process_time() - begun, time.perf_counter() - at
            costs.append(cost)
            if update is None and number < samples:
                continue
            now = scenario.at(number * scenario.sampling_time)
            if now.hash not in best:
                known = stored_optimum(now) is not None
                best[now.hash] = greedy(now, optimal(now)) if known else float("nan")
            judged.theta = loop.parameters.theta
            J = greedy(now, judged)
            away = np.concatenate(
                [
                    loop.parameters["x_l"] - scenario.state_lower,
                    scenario.state_upper - loop.parameters["x_u"],
                ]
            )
            print(
                f"{number:6d} {np.mean(costs):11.2f} {J:11.2f} "
                f"{100 * regrets(J, best[now.hash]):9.2f} {seconds:9.1f} {elapsed:8.1f}  "
                f"{away.round(3).tolist()}",
                flush=True,
            )


if __name__ == "__main__":
    main()
