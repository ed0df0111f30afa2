"""Whether what a log predicts is true: `python -m benchmarks.logged_data`.

Logs of two days each, of `pi`, `lqr` and `cautious` on `paper` and `fouled`. The rule learns from
each of them alone; then the plant itself says what θ costs, on noise that no log met. A row is a
log: the predicted differences of J with their 95 % intervals, and the true ones.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.measuring import clock
from controllers import compile_functions
from controllers.factories import nmpc
from cosim import FmuPlant, Scenario, build_controller, simulate
from cosim.cli.output import output
from cosim.core.files import temporary_folder
from cosim.core.simulation import indicators_of
from cosim.core.statistics import mean
from learning import train_from_data

SCENARIOS = ("paper", "fouled")
LOGGED = ("pi", "lqr", "cautious")
LOGS = 2
"""Logs of each controller on each scenario."""
LENGTH = 2880
"""Samples of a log: two days of minutes."""
HELD_OUT = 500_000
"""First seed of the noise on which the plant says what is true."""
SEEDS, STEPS = 40, 2500
HEADER = (
    "scenario",
    "logged",
    "seed",
    "verdict",
    "θ less start",
    "true",
    "held",
    "θ less log",
    "true",
    "held",
)


def true_costs(plant, controller):
    """J of a controller on the held-out seeds, (SEEDS,)."""
    compile_functions(controller, SEEDS * STEPS)
    seeds = range(HELD_OUT, HELD_OUT + SEEDS)
    return indicators_of(plant, controller, seeds, STEPS)["J"]


def holds(predicted, true):
    """Whether a predicted interval holds the true difference, within the error of the latter."""
    if predicted.interval is None:
        return False
    low, high = predicted.interval
    true_low, true_high = true.interval
    return low <= true_high and true_low <= high


def calibrate(algorithm, start, logs, scenarios=SCENARIOS, controllers=LOGGED):
    """Rows of all logs, each a dictionary."""
    rows = []
    for name in scenarios:
        scenario = Scenario.load(name)
        with FmuPlant(scenario) as plant, temporary_folder("cosim-logs-") as folder:
            start_costs = true_costs(plant, build_controller(start, scenario))
            for logged in controllers:
                controller = build_controller(logged, scenario)
                logged_costs = true_costs(plant, controller)
                for seed in range(logs):
                    file = Path(folder) / f"{logged}-{seed}.csv"
                    simulate(plant, controller, LENGTH, seed).write_csv(file)
                    answer = train_from_data(algorithm, file, scenario, start=start, seed=seed)
                    costs = start_costs
                    # θ that is the start's costs what that does.
                    if not np.array_equal(answer.learned.theta, answer.start.theta):
                        costs = true_costs(plant, nmpc(scenario, answer.learned))
                    against_start = mean(costs - start_costs)
                    against_logged = mean(costs - logged_costs)
                    rows.append(
                        {
                            "scenario": name,
                            "logged": logged,
                            "seed": seed,
                            "verdict": answer.verdict,
                            "against_start": answer.against_start,
                            "true_against_start": against_start,
                            "start_held": holds(answer.against_start, against_start),
                            "against_logged": answer.against_logged,
                            "true_against_logged": against_logged,
                            "logged_held": holds(answer.against_logged, against_logged),
                        }
                    )
    return rows


def _text(estimate):
    """An estimate with its interval, in whole units."""
    if estimate.interval is None:
        return f"{estimate.value:.0f}"
    low, high = estimate.interval
    return f"{estimate.value:.0f} [{low:.0f}, {high:.0f}]"


def main():
    parser = argparse.ArgumentParser("python -m benchmarks.logged_data", description=__doc__)
    parser.add_argument("--algorithm", "-a", default="model-based")
    parser.add_argument("--start", default="cautious")
    parser.add_argument("--scenarios", default=",".join(SCENARIOS))
    parser.add_argument("--controllers", default=",".join(LOGGED))
    parser.add_argument("--logs", type=int, default=LOGS, help="logs of each controller")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    begin = clock()
    scenarios = chosen.scenarios.split(",")
    controllers = chosen.controllers.split(",")
    rows = calibrate(chosen.algorithm, chosen.start, chosen.logs, scenarios, controllers)
    seconds = clock() - begin
    with output(chosen.json) as out_:
        lines = []
        for row in rows:
            lines.append(
                (
                    row["scenario"],
                    row["logged"],
                    str(row["seed"]),
                    row["verdict"],
                    _text(row["against_start"]),
                    _text(row["true_against_start"]),
                    "yes" if row["start_held"] else "no",
                    _text(row["against_logged"]),
                    _text(row["true_against_logged"]),
                    "yes" if row["logged_held"] else "no",
                )
            )
        held = sum(row["start_held"] + row["logged_held"] for row in rows)
        title = (
            f"{chosen.algorithm} from logs: {held} of {2 * len(rows)} intervals hold, "
            f"{seconds:.0f} s of processor time"
        )
        out_.table(title, HEADER, lines)
        out_.json({"held": held, "intervals": 2 * len(rows), "rows": rows})


if __name__ == "__main__":
    main()
