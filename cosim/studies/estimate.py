"""Estimate of a study's cost: a little of every case, timed here and now."""

from __future__ import annotations

import time
from dataclasses import replace

import pandas as pd

from cosim.errors import StudyError
from cosim.kpis import measure
from cosim.plant import FmuPlant
from cosim.plugins import build_controller
from cosim.studies.plan import Plan, Run, Training
from learning.training import run_training

SHORT, LONG, SIMULATED = 500, 1500, 200
"""Samples of two trainings, and of a closed loop, that are timed."""


def estimate(plan: Plan) -> pd.DataFrame:
    """A row for each scenario and case: runs, training and evaluation samples, core seconds.

    Raises StudyError where a case fails.
    """
    rates: dict[str, float] = {}
    rows = []
    for run in plan.runs:
        training, case = run.training, run.key.case
        simulation = "" if training is not None else case
        try:
            if case not in rates and training is not None:
                # Building and evaluating are the same in both, and do not count.
                spent = _training(training, LONG) - _training(training, SHORT)
                rates[case] = max(spent, 0.0) / (LONG - SHORT)
            if simulation not in rates:
                rates[simulation] = _simulation(plan, run) / SIMULATED
        except Exception as error:  # anything, from a user's algorithm
            raise StudyError(f"case '{case}': {type(error).__name__}: {error}") from error
        trained = 0 if training is None else training.samples
        evaluated = run.samples - trained
        if training is not None:
            greedy = training.options["evaluation_seeds"] * training.options["evaluation_steps"]
            evaluated += greedy * (trained // training.options["evaluate_every"] + 1)
        seconds = evaluated * rates[simulation] + (trained * rates[case] if trained else 0.0)
        rows.append((run.key.scenario, case, 1, trained, evaluated, seconds))
    columns = ["scenario", "case", "runs", "training_samples", "evaluation_samples", "seconds"]
    frame = pd.DataFrame(rows, columns=columns)
    return frame.groupby(["scenario", "case"], sort=False, as_index=False).sum()


def _training(training: Training, samples: int) -> float:
    every = dict.fromkeys(("log_every", "evaluate_every", "checkpoint_every"), samples)
    own = {name: training.options[name] for name in ("seed", "start", "controller")}
    short = replace(training, samples=samples, options=own | every)
    begin = time.process_time()
    run_training(short.prepare())
    return time.process_time() - begin


def _simulation(plan: Plan, run: Run) -> float:
    scenario = plan.definition.scenarios[run.key.scenario]
    controller = build_controller(run.case.controller or "naive", scenario)
    begin = time.process_time()
    with FmuPlant(scenario) as plant:
        measure(plant, controller, 0, SIMULATED)
    return time.process_time() - begin
