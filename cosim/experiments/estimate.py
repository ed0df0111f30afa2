"""What a study will cost: a little of every case, timed here and now."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from cosim.experiments.plan import Plan, Run
from cosim.experiments.units import simulated

TRIED, SIMULATED = 1000, 200
"""Samples of a training, and of a closed loop, that are timed."""


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
            rates[case] = _seconds_per_sample(plan, first)
        simulation = "" if first.training is not None else case
        if simulation not in rates:
            rates[simulation] = _seconds_per_step(plan, first)
        evaluated = first.samples - trained
        # The evaluations during training are part of its samples' time.
        seconds = len(runs) * (trained * rates[case] + evaluated * rates[simulation])
        costs.append(
            Cost(scenario, case, len(runs), len(runs) * trained, len(runs) * evaluated, seconds)
        )
    return costs, sum(cost.seconds for cost in costs)


def _seconds_per_sample(plan: Plan, run: Run) -> float:
    if run.training is None:
        return 0.0
    samples = min(TRIED, run.training.samples)
    short = replace(
        run.training,
        samples=samples,
        log_every=samples,
        evaluate_every=samples,
        checkpoint_every=samples,
    )
    trainer = plan.definition.trainer
    nothing = replace(short, samples=1, log_every=1, evaluate_every=1, checkpoint_every=1)
    trainer.advance(nothing, b"", 1e9)
    begin = time.process_time()
    trainer.advance(nothing, b"", 1e9)
    middle = time.process_time()
    trainer.advance(short, b"", 1e9)
    learning = max(time.process_time() - middle - (middle - begin), 0.0) / samples
    points = run.training.samples / run.training.evaluate_every
    return learning + (middle - begin) * points / run.training.samples


def _seconds_per_step(plan: Plan, run: Run) -> float:
    scenario = plan.definition.scenarios[run.key.scenario]
    controller = plan.definition.trainer.controller(run.case.controller or "naive", scenario)
    begin = time.process_time()
    simulated(scenario, controller, SIMULATED, 0)
    return (time.process_time() - begin) / SIMULATED


__all__ = ["Cost", "estimate"]
