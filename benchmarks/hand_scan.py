"""`python -m benchmarks.hand_scan`: the back-off of X2 that a scan on the plant finds best.

What an engineer does in an hour with a plant at hand: the θ of `cautious` behind the shipped
filter, its bound of X2 set to one value after the other, each on the noise of the stored study on
sensors. Regret is against the optimum that sees the state.

With `--margin` a part of the back-off follows the estimate's deviation (block `margin` of θ), on
the seeds of `--first-seed`.
"""

import argparse
from tempfile import TemporaryDirectory

import cosim
from controllers.factories import build_controller
from controllers.problem import Problem
from controllers.theta import add_margin

SCENARIOS = ("assay", "assay-fouled", "late")
BACK_OFFS = (4.5, 5.0, 5.5, 6.0, 6.5)
"""Of X2's lower bound, %; `cautious` has 4.9."""
MARGINS = ((2.0, 2.0), (2.4, 1.8), (2.8, 1.8), (3.0, 1.5))
"""Constant part of that back-off, %, and deviations of the estimate that are added to it."""
FIRST_SEED, SEEDS, STEPS = 3_245_000, 100, 2500


def scanned(name, folder, pairs):
    """θ files of a scenario by the names of their back-offs, each a constant and a factor."""
    scenario = cosim.Scenario.load(name)
    start = build_controller("cautious", scenario).controller.parameters
    files = {}
    for back_off, factor in pairs:
        parameters = start
        x_l = start["x_l"]
        x_l[0] = scenario.state_lower[0] + back_off
        label = f"X2 + {back_off}"
        if factor:
            parameters = add_margin(start, Problem.from_scenario(scenario))
            margin = parameters["margin"]
            margin[0] = factor
            parameters = parameters.replace({"margin": margin})
            label += f" + {factor} deviations"
        file = f"{folder}/{name}-{back_off}-{factor}.toml"
        parameters.replace({"x_l": x_l}).save(file)
        files[label] = file
    return {"cautious": "cautious", **files}


def main():
    """Print the regret of each back-off with its interval."""
    parser = argparse.ArgumentParser("python -m benchmarks.hand_scan", description=__doc__)
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    parser.add_argument("--margin", action="store_true", help="scan what follows the deviation")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    arguments = parser.parse_args()
    pairs = [(back_off, 0.0) for back_off in BACK_OFFS]
    if arguments.margin:
        pairs += MARGINS
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    with TemporaryDirectory() as folder:
        for name in arguments.scenarios:
            table = cosim.evaluate(name, scanned(name, folder, pairs), seeds, STEPS)
            print(name)
            print(table.table(), flush=True)


if __name__ == "__main__":
    main()
