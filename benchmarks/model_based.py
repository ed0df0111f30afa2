"""What the parts of `model-based` earn: greedy regret after each update, with a part taken out.

    python -m benchmarks.model_based fouled naive 12 --samples 960 --without parameters

All runs of a seed meet the same noise of the plant and explore alike until θ differs. Greedy J is
that of five held-out runs of 1000 samples, after 300, on the plant as it is at that sample;
development seeds are 11 to 19.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from controllers import compile_functions
from controllers.factories import nmpc, optimal
from controllers.optimum import stored_optimum
from cosim.plant import FmuPlant
from cosim.protocols import Controller
from cosim.scenario import Scenario
from cosim.simulation import simulate
from learning import empirical_model, model_based
from learning.training import begin, prepare

PARTS = {
    "parameters": (empirical_model, "PARAMETER_DEVIATION", 1e-6),  # W alone is fitted
    "slopes": (empirical_model, "SLOPE_DEVIATIONS", (1e-6,)),  # c and offsets alone
    "evidence": (empirical_model, "SLOPE_DEVIATIONS", (0.1,)),  # the widest prior of slopes
    "rounds": (empirical_model, "ROUNDS", 2),  # two Gauss-Newton steps in place of six
    "scale": (empirical_model, "FLOOR", 1e3),  # h is constant
    "doubt": (model_based, "DOUBT", 0.0),  # the least promised cost, not the smallest back-off
    "tail": (model_based, "TAIL", 0.0),
    "caution": (model_based, "CAUTION", 0),
    "reach": (model_based, "REACH", 1e9),  # a rollout is lost by its cost alone
    "promise": (model_based, "BROKEN", 1e9),  # no promise is ever broken
    "dropping": (empirical_model, "EVIDENCE", np.inf),  # the fit uses all data
    "offset": (
        empirical_model.EmpiricalModel,
        "lack",
        lambda model, inputs, c: inputs[0, : model.features.outputs - 1] * 0.0,
    ),
    "nothing": (model_based, "CAUTION", model_based.CAUTION),
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


def main() -> None:
    """Run one trajectory and print a line for each update."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("start")
    parser.add_argument("seed", type=int)
    parser.add_argument("--samples", type=int, default=960)
    parser.add_argument("--without", choices=PARTS, default="nothing")
    parser.add_argument("--parameters", nargs="*", default=[], help="of the model, in θ")
    chosen = parser.parse_args()
    setattr(*PARTS[chosen.without])
    scenario = Scenario.load(chosen.scenario)
    options = {"seed": chosen.seed, "start": chosen.start}
    settings = {"model_parameters": chosen.parameters}
    run = prepare("model-based", scenario, chosen.samples, settings, options)
    best: dict[str, float] = {}
    costs: list[float] = []
    with FmuPlant(scenario) as plant:
        loop = begin(run, model_based.ModelBased, plant)
        judged = nmpc(scenario, loop.parameters)
        compile_functions(loop.controller, chosen.samples)
        print(f"{chosen.scenario} from {chosen.start}, seed {chosen.seed}, -{chosen.without}")
        print("sample   J of life    greedy J  regret %  s of CPU  elapsed  back-offs", flush=True)
        for number in range(1, chosen.samples + 1):
            begun, at = time.process_time(), time.perf_counter()
            cost, update = loop.advance()
            seconds, elapsed = time.process_time() - begun, time.perf_counter() - at
            costs.append(cost)
            if update is None and number < chosen.samples:
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
                f"{100 * (J / best[now.hash] - 1):9.2f} {seconds:9.1f} {elapsed:8.1f}  "
                f"{away.round(3).tolist()}",
                flush=True,
            )


if __name__ == "__main__":
    main()
