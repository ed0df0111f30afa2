"""Logs of plants whose optimum is known: `python -m benchmarks.data_sets --out FOLDER`.

A day of each of three plants under each regime of `benchmarks.logged_data`, as CSV files with units
in their headers, and index.csv: how each was made, its J and the plant's J*. The same command gives
the same bytes.
"""

import argparse
from pathlib import Path

from benchmarks.logged_data import REGIMES, Judge
from cosim import FmuPlant, Scenario, simulate
from cosim.core.files import write_atomically
from cosim.core.result import csv_text

PLANTS = ("paper", "fouled", "random-4")
DAY = 86400.0
"""Length of a log in s."""
SEED = 760_000
"""Noise of the logs."""
INDEX = ("file", "plant", "regime", "seed", "sampling_time [s]", "rows", "J", "J_optimal")


def log_text(run, units):
    """A run as a plant's owner would log it: time, states, actions and stage cost, with units."""
    scenario = run.scenario
    names = [*scenario.plant.states, *scenario.plant.actions]
    header = ["time [s]"]
    columns = [run["time"]]
    for name in names:
        header.append(f"{name} [{units[name]}]")
        columns.append(run[name])
    header.append("stage_cost")
    columns.append(run["stage_cost"])
    rows = []
    for values in zip(*columns, strict=True):
        # Sensors have no sixteen digits.
        rows.append([f"{value:.8g}" for value in values])
    return csv_text(header, rows)


def write_data_sets(folder, plants=PLANTS, regimes=REGIMES):
    """Write the logs and their index; the index' rows."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in plants:
        scenario = Scenario.load(name)
        samples = round(DAY / scenario.sampling_time)
        with FmuPlant(scenario) as plant:
            judge = Judge(scenario, plant, "model-based")
            for regime in regimes:
                run = simulate(plant, judge.in_charge(regime, SEED), samples, SEED)
                file = f"{name}-{regime}.csv"
                write_atomically(folder / file, log_text(run, plant.units))
                numbers = (scenario.sampling_time, samples, run.means()["J"], judge.optimal)
                rows.append([file, name, regime, str(SEED), *(f"{x:.8g}" for x in numbers)])
    write_atomically(folder / "index.csv", csv_text(INDEX, rows))
    return rows


def main():
    parser = argparse.ArgumentParser("python -m benchmarks.data_sets", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the files")
    for row in write_data_sets(parser.parse_args().out):
        print(*row)


if __name__ == "__main__":
    main()
