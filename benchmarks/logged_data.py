"""Whether what a log predicts is true: `python -m benchmarks.logged_data --out FOLDER`.

A log is a week of one plant under one regime. A rule learns from it alone; then the plant itself
says what θ costs, on noise that no log met. Each log is a row of FOLDER/logs.csv, appended once it
is judged, seed by seed over all plants: the command goes on where it was ended, and its first rows
are a fair sample. FOLDER/table.md sums the rows up.

The regimes are `pi`, `lqr`, `cautious`, and `steps`: `cautious` with an operator's steps on top.
"""

import argparse
import csv
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from controllers import compile_functions
from controllers.errors import OptimumError
from cosim import FmuPlant, Scenario, build_controller, simulate
from cosim.core.files import temporary_folder, write_atomically
from cosim.core.logged_data import LoggedDataError
from cosim.core.protocols import Decision
from cosim.core.simulation import measure
from cosim.core.statistics import mean
from learning import train_from_data

RANDOM_PLANTS = [f"random-{seed}" for seed in range(16)]
COLOURED_PLANTS = [f"random-coloured-{seed}" for seed in range(16)]
PLANTS = (RANDOM_PLANTS + COLOURED_PLANTS)[1:30:3]
"""Every third of the 32 random plants: ten of them."""
REGIMES = ("pi", "lqr", "cautious", "steps")
EXCITED = ("cautious", "steps")
"""Regimes in which something moves the inputs about the states that matter."""
FIRST_SEED, LOGS = 740_000, 5
"""Noise of the logs, and their number for each plant and regime."""
WEEK = 7 * 86400.0
"""Length of a log in s."""
STEP_SHARE, STEP_SECONDS = 0.05, 1200.0
"""An operator's step: up to this share of the range of each input, held for this long."""
HELD_OUT = 7_300_000
"""First seed of the noise on which the plant says what is true."""
SEEDS, SAMPLES, BURN_IN = 40, 2500, 500
START = "cautious"
ROUNDING = 1e-6
"""Of a difference of costs."""
COLUMNS = (
    "plant",
    "regime",
    "seed",
    "transitions",
    "verdict",
    "status",
    "J_logged",
    # Predicted differences of J with the ends of their intervals, then what the plant says.
    "less_start",
    "less_start_low",
    "less_start_high",
    "true_less_start",
    "true_less_start_low",
    "true_less_start_high",
    "less_log",
    "less_log_low",
    "less_log_high",
    "true_less_log",
    "true_less_log_low",
    "true_less_log_high",
    # What follows the verdict: the learned θ or the start's.
    "J",
    "J_optimal",
)
JUDGES = {}
"""The plants of this process, by name."""


class OperatorSteps:
    """A controller with an operator's steps on top of its actions.

    Args:
        controller: acts before the steps are added.
        scenario: has ranges and sampling time.
        seed: of the steps.
    """

    name = "steps"

    def __init__(self, controller, scenario, seed):
        self._controller = controller
        self._lower = scenario.action_lower
        self._upper = scenario.action_upper
        self._held = round(STEP_SECONDS / scenario.sampling_time)
        self._seed = seed
        self.reset()

    def reset(self):
        """Begin the same steps anew."""
        self._controller.reset()
        self._rng = np.random.default_rng(self._seed)
        self._number = 0
        self._step = np.zeros_like(self._lower)

    def prepare(self):
        """As the controller does."""
        self._controller.prepare()

    def feedback(self, s, a=None):
        """The controller's action and the present step, within the actuators' bounds."""
        assert a is None
        if self._number % self._held == 0:
            reach = STEP_SHARE * (self._upper - self._lower)
            self._step = self._rng.uniform(-reach, reach)
        self._number += 1
        action = self._controller.feedback(s).action + self._step
        return Decision(np.clip(action, self._lower, self._upper))


@dataclass
class Judge:
    """The plant that says what is true, with what it has said of controllers that recur."""

    scenario: Scenario
    plant: FmuPlant
    algorithm: str

    def __post_init__(self):
        self._start = build_controller(START, self.scenario)
        self.start_costs = self.costs(self._start)
        self._regime_costs = {START: self.start_costs}
        try:
            self.optimal = self.costs(build_controller("optimal", self.scenario)).mean()
        except OptimumError:
            # No grid holds the values of several disturbances with a memory.
            self.optimal = np.nan

    def costs(self, controller):
        """J of a controller on the held-out seeds, (SEEDS,)."""
        compile_functions(controller, SEEDS * (SAMPLES + BURN_IN))
        costs = []
        for seed in range(HELD_OUT, HELD_OUT + SEEDS):
            values, _ = measure(self.plant, controller, seed, SAMPLES, BURN_IN)
            costs.append(values["J"])
        return np.array(costs)

    def in_charge(self, regime, seed):
        """What is in charge in a regime."""
        if regime == START:
            return self._start
        if regime == "steps":
            return OperatorSteps(self._start, self.scenario, seed)
        return build_controller(regime, self.scenario)

    def row(self, regime, seed, folder):
        """Log a week, learn from it and ask the plant; the row of `COLUMNS`."""
        controller = self.in_charge(regime, seed)
        if regime not in self._regime_costs:
            self._regime_costs[regime] = self.costs(controller)
        file = folder / "log.csv"
        samples = round(WEEK / self.scenario.sampling_time)
        simulate(self.plant, controller, samples, seed).write_csv(file)
        start = self._start.parameters.save(folder / "start.toml")
        try:
            answer = train_from_data(self.algorithm, file, self.scenario, start=start, seed=seed)
        except LoggedDataError as error:
            # Every one of these logs is sound. Nothing is predicted, and the start stays in charge.
            return self._refused(regime, seed, str(error))
        costs = self.start_costs
        # θ that is the start's costs what that does.
        if not np.array_equal(answer.learned.theta, answer.start.theta):
            learned = answer.learned.save(folder / "learned.toml")
            costs = self.costs(build_controller(str(learned), self.scenario))
        followed = costs if answer.verdict == "better" else self.start_costs
        row = [
            self.scenario.name,
            regime,
            seed,
            len(answer.data),
            answer.verdict,
            answer.status,
            answer.logged_cost,
        ]
        truths = (mean(costs - self.start_costs), mean(costs - self._regime_costs[regime]))
        predictions = (answer.against_start, answer.against_logged)
        for estimate, truth in zip(predictions, truths, strict=True):
            row += [estimate.value, *(estimate.interval or (-np.inf, np.inf))]
            row += [truth.value, *truth.interval]
        return [*row, followed.mean(), self.optimal]

    def _refused(self, regime, seed, reason):
        """The row of a log that is refused."""
        truth = mean(self.start_costs - self._regime_costs[regime])
        nothing = [np.nan] * 3
        row = [self.scenario.name, regime, seed, 0, "refused", reason.replace(",", ";"), np.nan]
        row += [*nothing, 0.0, 0.0, 0.0, *nothing, truth.value, *truth.interval]
        return [*row, self.start_costs.mean(), self.optimal]


def row_of(algorithm, name, regime, seed):
    """A log's row, by a plant that this process keeps for the rows to come."""
    if name not in JUDGES:
        scenario = Scenario.load(name)
        JUDGES[name] = Judge(scenario, FmuPlant(scenario), algorithm)
    with temporary_folder("cosim-logs-") as folder:
        return JUDGES[name].row(regime, seed, Path(folder))


def calibrate(algorithm, plants, regimes, seeds, path, jobs):
    """Append the rows that a file of logs lacks, seed by seed, by so many processes."""
    done = set()
    if path.exists():
        for row in rows_of(path):
            done.add((row["plant"], row["regime"], int(row["seed"])))
    else:
        write_atomically(path, ",".join(COLUMNS) + "\n")
    with ExitStack() as stack:
        # All rows of a plant are of one process, which sets it up once.
        processes = []
        for _ in range(jobs):
            processes.append(stack.enter_context(ProcessPoolExecutor(1)))
        pending = []
        for seed, name, regime in product(seeds, plants, regimes):
            if (name, regime, seed) in done:
                continue
            process = processes[plants.index(name) % jobs]
            pending.append(process.submit(row_of, algorithm, name, regime, seed))
        for row in pending:
            append_row(path, row.result())


def append_row(path, row):
    """Append a row of `COLUMNS` to a file."""
    cells = [f"{x:.8g}" if isinstance(x, float) else str(x) for x in row]
    with path.open("a", encoding="utf-8") as file:
        file.write(",".join(cells) + "\n")


def rows_of(path):
    """The rows of a file of logs: numbers where a column has them."""
    words = ("plant", "regime", "verdict", "status")
    rows = []
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            rows.append({k: v if k in words else float(v) for k, v in row.items()})
    return rows


def holds(row, name):
    """Whether the true difference lies in a predicted interval, but for rounding."""
    low = row[f"{name}_low"] - ROUNDING
    high = row[f"{name}_high"] + ROUNDING
    return low <= row[f"true_{name}"] <= high


def nearly_holds(row, name):
    """Whether it does within its own error, since the plant's noise is finite, too."""
    reaches_low = row[f"true_{name}_high"] >= row[f"{name}_low"]
    reaches_high = row[f"true_{name}_low"] <= row[f"{name}_high"]
    return reaches_low and reaches_high


def gives_interval(row, name):
    """Whether the row predicts an interval: a refused log gives none, nor does a lost rollout."""
    return bool(np.isfinite(row[f"{name}_low"]) and np.isfinite(row[f"{name}_high"]))


def percentage(flags):
    """The share of flags that are true, in words; empty of none."""
    return f"{100 * np.mean(flags):.1f} %" if flags else ""


def table(rows):
    """Markdown: a line for each regime, and one for all."""
    lines = [
        "| logged by | logs | refused | intervals | of which hold | within the truth's error | "
        "`better` | costs more than what was logged | regret %, median | largest |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for regime in (*REGIMES, "all"):
        chosen = [row for row in rows if regime in (row["regime"], "all")]
        if not chosen:
            continue
        refused = sum(row["verdict"] == "refused" for row in chosen)
        both = []
        for row, name in product(chosen, ("less_start", "less_log")):
            if gives_interval(row, name):
                both.append((row, name))
        share = percentage([holds(*pair) for pair in both])
        near = percentage([nearly_holds(*pair) for pair in both])
        better = sum(row["verdict"] == "better" for row in chosen)
        # The same noise judges both: the start costs what the learned θ does, less its difference.
        worse = 0
        regrets = []
        for row in chosen:
            learned = row["verdict"] == "better"
            against_log = row["true_less_log"]
            if not learned:
                against_log -= row["true_less_start"]
            worse += against_log > 0
            if np.isfinite(row["J_optimal"]):
                regrets.append(100 * (row["J"] / row["J_optimal"] - 1))
        regret = f"{np.median(regrets):.2f} | {max(regrets):.2f}" if regrets else " | "
        lines.append(
            f"| `{regime}` | {len(chosen)} | {refused} | {len(both)} | {share} | {near} | "
            f"{better} | {100 * worse / len(chosen):.1f} % | {regret} |"
        )
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser("python -m benchmarks.logged_data", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of logs.csv and table.md")
    parser.add_argument("--algorithm", "-a", default="model-based")
    parser.add_argument("--plants", default=",".join(PLANTS))
    parser.add_argument("--regimes", default=",".join(REGIMES))
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--logs", type=int, default=LOGS, help="of each plant and regime")
    parser.add_argument("--jobs", type=int, default=1, help="processes that share the plants")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    path = chosen.out / "logs.csv"
    seeds = range(chosen.first_seed, chosen.first_seed + chosen.logs)
    plants = chosen.plants.split(",")
    regimes = chosen.regimes.split(",")
    calibrate(chosen.algorithm, plants, regimes, seeds, path, chosen.jobs)
    text = table(rows_of(path))
    write_atomically(chosen.out / "table.md", text)
    print(text, end="")


if __name__ == "__main__":
    main()
