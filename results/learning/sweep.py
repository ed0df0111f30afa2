"""Train and evaluate every case of `cases.py`; resumable.

    python results/learning/sweep.py --jobs 2 --scenarios paper fast-sampling

Each run has a folder OUT/SCENARIO/CASE/SEED with what `cosim train` writes and evaluation.csv: its
θ greedily on 50 held-out noise seeds × 1000 steps. A run that has evaluation.csv is not run again;
one that has a checkpoint goes on from there. `tables.py` makes the tables and figures.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import time
from pathlib import Path
from typing import Any

from cases import CASES, Case
from joblib import Parallel, delayed

from controllers.problem import Problem
from controllers.storage import write_atomically
from cosim import FmuPlant, Scenario
from cosim.cli.train import summarise
from learning.evaluation import Evaluation, held_out
from learning.log import to_csv
from learning.registry import load_algorithm
from learning.run import Run
from learning.starting_point import build_controller
from learning.training import Training

STEPS = 1000
FIGURES = ("J", "economic_cost", "mean_violation", "violating_share", "failures")


def evaluate(plant: FmuPlant, controller: Any, seeds: int) -> str:
    """Figures of a controller on each held-out seed, as CSV."""
    costs = Evaluation(plant, held_out(seeds), STEPS).costs(controller)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("seed", *FIGURES))
    for row, seed in enumerate(held_out(seeds)):
        writer.writerow((seed, *(repr(float(costs[name][row])) for name in FIGURES)))
    return stream.getvalue()


def train(out: Path, scenario: Scenario, name: str, case: Case, seed: int) -> str:
    """One run to its evaluation; returns a line for the log."""
    folder = out / scenario.name / name / f"{seed:02d}"
    if (folder / "evaluation.csv").exists():
        return f"{folder}: there already"
    folder.mkdir(parents=True, exist_ok=True)
    algorithm = load_algorithm(case.algorithm)
    run = Run(
        algorithm=case.algorithm,
        scenario=scenario,
        samples=case.samples,
        seed=seed,
        configuration=algorithm.Configuration.from_dict(case.settings),
        controller=case.controller,
        log_every=min(500, case.samples // 20),
        evaluate_every=case.samples // 20,
        checkpoint_every=case.samples // 5,
        evaluation_seeds=4,
        evaluation_steps=500,
    )
    begin = time.perf_counter(), time.process_time()
    with FmuPlant(scenario) as plant, FmuPlant(scenario) as other:
        training = Training(run, algorithm, plant, other, out=folder)
        result = training.go(resume=(folder / "checkpoint.npz").exists())
        elapsed = time.perf_counter() - begin[0], time.process_time() - begin[1]
        problem = Problem.from_scenario(scenario)
        controller = build_controller(case.controller, scenario, problem, result.parameters)
        evaluation = evaluate(other, controller, case.noise_seeds)
    summary = summarise(run, result)
    summary["timing"] = {"wall_seconds": elapsed[0], "process_seconds": elapsed[1]}
    result.parameters.save(folder / "parameters.toml")
    write_atomically(folder / "learning.csv", to_csv(result.rows))
    write_atomically(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
    write_atomically(folder / "evaluation.csv", evaluation)
    return f"{folder}: J {summary['J']:.1f}, {result.status}, {elapsed[0]:.0f} s"


def main() -> None:
    """Run the sweep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/learning/runs"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--scenarios", nargs="+", default=["paper", "fast-sampling"])
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    arguments = parser.parse_args()
    # Seeds go round in the outer loop: stopped early, the sweep has every case for fewer seeds.
    work = [
        (Scenario.load(scenario), name, seed)
        for scenario in arguments.scenarios
        for seed in range(max(CASES[name].seeds for name in arguments.cases))
        for name in arguments.cases
        if seed < CASES[name].seeds
    ]
    lines = Parallel(n_jobs=arguments.jobs, return_as="generator_unordered")(
        delayed(train)(arguments.out, scenario, name, CASES[name], seed)
        for scenario, name, seed in work
    )
    for done, line in enumerate(lines, start=1):
        print(f"{done}/{len(work)} {line}", flush=True)


if __name__ == "__main__":
    main()
