"""`python -m benchmarks.hand_scan`: the back-off of X2 that a scan on the plant finds best.

What an engineer does in an hour with a plant at hand: the θ of `cautious` behind the shipped
filter, its bound of X2 set to one value after the other, each on the noise of the stored study on
sensors. Regret is against the optimum that sees the state.
"""

import argparse
from tempfile import TemporaryDirectory

import cosim
from controllers.factories import build_controller

SCENARIOS = ("assay", "assay-fouled", "late")
BACK_OFFS = (4.5, 5.0, 5.5, 6.0, 6.5)
"""Of X2's lower bound, %; `cautious` has 4.9."""
FIRST_SEED, SEEDS, STEPS = 3_245_000, 100, 2500


def scanned(name, folder):
    """θ files of a scenario by the names of their back-offs."""
    scenario = cosim.Scenario.load(name)
    start = build_controller("cautious", scenario).controller.parameters
    files = {}
    for back_off in BACK_OFFS:
        x_l = start["x_l"]
        x_l[0] = scenario.state_lower[0] + back_off
        file = f"{folder}/{name}-{back_off}.toml"
        start.replace({"x_l": x_l}).save(file)
        files[f"X2 + {back_off}"] = file
    return {"cautious": "cautious", **files}


def main():
    """Print the regret of each back-off with its interval."""
    parser = argparse.ArgumentParser("python -m benchmarks.hand_scan", description=__doc__)
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    seeds = range(FIRST_SEED, FIRST_SEED + SEEDS)
    with TemporaryDirectory() as folder:
        for name in parser.parse_args().scenarios:
            table = cosim.evaluate(name, scanned(name, folder), seeds, STEPS)
            print(name)
            print(table.table(), flush=True)


if __name__ == "__main__":
    main()
