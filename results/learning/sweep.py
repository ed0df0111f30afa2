"""Train and evaluate every case of `cases.py`; resumable.

    python results/learning/sweep.py --jobs 2 --scenarios paper fast-sampling

Each run has a folder OUT/SCENARIO/CASE/SEED with what `cosim train` writes and evaluation.csv: its
θ greedily on 50 held-out noise seeds × 1000 steps; each baseline a folder OUT/SCENARIO/NAME with
evaluation.csv. What has evaluation.csv is not run again; a training that has a checkpoint goes on
from there. `gather.py` stores the results, `tables.py` and `figures.py` show them.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import subprocess
import time
from pathlib import Path
from typing import Any, NamedTuple

from cases import CASES, NOISE_SEEDS, STEPS
from stored import BASELINES, FIGURES, SCENARIOS

from controllers.problem import Problem
from cosim import FmuPlant, Scenario
from cosim.cli.train import summarise
from cosim.evaluation.parallel import run_all
from cosim.files import write_atomically
from cosim.lookup import build_controller
from learning.evaluation import HeldOutRuns, held_out
from learning.log import to_csv
from learning.registry import load_algorithm
from learning.starting_point import build_controller as learnable
from learning.training_loop import TrainingLoop
from learning.training_run import TrainingRun


class Task(NamedTuple):
    """A training seed of a case or, without one, a baseline; `commit` says which code runs it."""

    out: Path
    scenario: str
    name: str
    seed: int | None
    commit: str

    @property
    def folder(self) -> Path:
        """Where the task's files are."""
        folder = self.out / self.scenario / self.name
        return folder if self.seed is None else folder / f"{self.seed:02d}"


def perform(task: Task) -> str:
    """Run a task unless it is there already; returns a line for the log."""
    if (task.folder / "evaluation.csv").exists():
        return f"{task.folder}: there already"
    task.folder.mkdir(parents=True, exist_ok=True)
    return baseline(task) if task.seed is None else train(task, task.seed)


def baseline(task: Task) -> str:
    """Evaluate a baseline."""
    scenario = Scenario.load(task.scenario)
    with FmuPlant(scenario) as plant:
        evaluate(task.folder, plant, build_controller(task.name, scenario))
    return f"{task.folder}: evaluated"


def train(task: Task, seed: int) -> str:
    """Train a case and evaluate the θ that it ends with."""
    scenario, case, folder = Scenario.load(task.scenario), CASES[task.name], task.folder
    algorithm = load_algorithm(case.algorithm)
    run = TrainingRun(
        algorithm=case.algorithm,
        scenario=scenario,
        samples=case.samples,
        seed=seed,
        configuration=algorithm.Configuration.from_dict(case.settings),
        log_every=min(500, case.samples // 20),
        evaluate_every=case.samples // 20,
        checkpoint_every=case.samples // 5,
    )
    begin = time.perf_counter(), time.process_time()
    with FmuPlant(scenario) as plant, FmuPlant(scenario) as other:
        training = TrainingLoop(run, algorithm, plant, other, out=folder)
        result = training.go(resume=(folder / "checkpoint.npz").exists())
        elapsed = time.perf_counter() - begin[0], time.process_time() - begin[1]
        summary = summarise(run, result) | {"commit": task.commit}
        summary["timing"] = {"wall_seconds": elapsed[0], "process_seconds": elapsed[1]}
        result.parameters.save(folder / "parameters.toml")
        write_atomically(folder / "learning.csv", to_csv(result.rows))
        write_atomically(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
        problem = Problem.from_scenario(scenario)
        evaluate(folder, other, learnable(run.controller, scenario, problem, result.parameters))
    return f"{folder}: J {summary['J']:.1f}, {result.status}, {elapsed[0]:.0f} s"


def evaluate(folder: Path, plant: FmuPlant, controller: Any) -> None:
    """Write a controller's figures on each held-out seed; the last file of a task."""
    seeds = held_out(NOISE_SEEDS)
    costs = HeldOutRuns(plant, seeds, STEPS).costs(controller)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("seed", *FIGURES))
    for row, seed in enumerate(seeds):
        writer.writerow((seed, *(repr(float(costs[name][row])) for name in FIGURES)))
    write_atomically(folder / "evaluation.csv", stream.getvalue())


def tasks(out: Path, scenarios: list[str], names: list[str]) -> dict[str, Task]:
    """All tasks in the order of their worth, by folder.

    Baselines first, then seed after seed: stopped early, the sweep has every case for fewer seeds.
    """
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=7"]
    commit = subprocess.run(
        describe, cwd=Path(__file__).parent, check=True, capture_output=True, text=True
    ).stdout.strip()
    made = [Task(out, scenario, name, None, commit) for scenario in scenarios for name in BASELINES]
    made += [
        Task(out, scenario, name, seed, commit)
        for seed in range(max(CASES[name].seeds for name in names))
        for scenario in scenarios
        for name in names
        if seed < CASES[name].seeds
    ]
    return {str(task.folder): task for task in made}


def main() -> None:
    """Run the sweep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/learning/runs"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), choices=SCENARIOS)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    arguments = parser.parse_args()
    work = tasks(arguments.out, arguments.scenarios, arguments.cases)
    done: list[str] = []

    def report(folder: str, line: str) -> None:
        done.append(folder)
        print(f"{len(done)}/{len(work)} {line}", flush=True)

    run_all(perform, work.items(), report, jobs=arguments.jobs)


if __name__ == "__main__":
    main()
