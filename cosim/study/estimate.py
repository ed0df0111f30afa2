"""What a study will cost: a little of every case, timed here and now."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from cosim.errors import StudyError
from cosim.kpis import measure
from cosim.plant import FmuPlant
from cosim.plugins import build_controller
from cosim.study.plan import Plan, Run, Training
from learning.training import run_training

TRIED, SIMULATED = (500, 1500), 200
"""Samples of two trainings, and of a closed loop, that are timed."""


@dataclass(frozen=True)
class Cost:
    """Runs and samples of a case on a scenario, and the seconds of one core that they take."""

    scenario: str
    case: str
    runs: int
    training_samples: int
    evaluation_samples: int
    seconds: float


def estimate(plan: Plan) -> tuple[list[Cost], float]:
    """Cost of each case on each scenario, and in all, from a short run of each case."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in plan.runs:
        groups.setdefault((run.key.scenario, run.key.case), []).append(run)
    rates: dict[str, float] = {}
    costs = []
    for (scenario, case), runs in groups.items():
        first = runs[0]
        trained = 0 if first.training is None else first.training.samples
        if case not in rates:
            try:
                rates[case] = _seconds_per_sample(first)
            except Exception as error:  # anything, from a user's algorithm
                raise StudyError(f"case '{case}': {type(error).__name__}: {error}") from error
        simulation = "" if first.training is not None else case
        if simulation not in rates:
            rates[simulation] = _seconds_per_step(plan, first)
        evaluated = first.samples - trained
        if first.training is not None:
            greedy = (
                first.training.options["evaluation_seeds"]
                * first.training.options["evaluation_steps"]
            )
            evaluated += greedy * (trained // first.training.options["evaluate_every"] + 1)
        seconds = len(runs) * (trained * rates[case] + evaluated * rates[simulation])
        costs.append(
            Cost(scenario, case, len(runs), len(runs) * trained, len(runs) * evaluated, seconds)
        )
    return costs, sum(cost.seconds for cost in costs)


def _seconds_per_sample(run: Run) -> float:
    """From the difference of two short trainings, so that building and evaluating do not count."""
    if run.training is None:
        return 0.0
    spent = {samples: _seconds(run.training, samples) for samples in TRIED}
    short, long = TRIED
    return max(spent[long] - spent[short], 0.0) / (long - short)


def _seconds(training: Training, samples: int) -> float:
    every = dict.fromkeys(("log_every", "evaluate_every", "checkpoint_every"), samples)
    own = {name: training.options[name] for name in ("seed", "start", "controller")}
    short = replace(training, samples=samples, options=own | every)
    begin = time.process_time()
    run_training(short.prepare())
    return time.process_time() - begin


def _seconds_per_step(plan: Plan, run: Run) -> float:
    scenario = plan.definition.scenarios[run.key.scenario]
    controller = build_controller(run.case.controller or "naive", scenario)
    begin = time.process_time()
    with FmuPlant(scenario) as plant:
        measure(plant, controller, 0, SIMULATED)
    return (time.process_time() - begin) / SIMULATED


__all__ = ["Cost", "estimate"]
