"""Throughput of learning: samples a second on one core, the FMU included, and where time goes."""

from __future__ import annotations

import statistics
import time
from typing import Any

from cosim.plant import FmuPlant
from cosim.scenario import Scenario
from learning.learner import Learner
from learning.registry import load_algorithm
from learning.training_run import TrainingRun

ALGORITHMS = ("q-learning", "actor-critic", "batch-q-learning")
SETTLING = 1000
"""Samples before the clock starts: warm-up of the rule, caches, and the naive θ's worst QPs."""


class _Stopwatch:
    """CPU time spent in some methods, each without that of the watched methods it calls."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    def watch(self, target: Any, method: str, part: str) -> None:
        """Replace a method by one that is timed."""
        original = getattr(target, method)
        self.seconds.setdefault(part, 0.0)

        def timed(*arguments: Any, **named: Any) -> Any:
            self._inner.append(0.0)
            begin = time.process_time()
            try:
                return original(*arguments, **named)
            finally:
                elapsed = time.process_time() - begin
                self.seconds[part] += elapsed - self._inner.pop()
                self._inner[-1] += elapsed

        setattr(target, method, timed)


def _learner(plant: FmuPlant, name: str, samples: int) -> Learner:
    """An algorithm in its loop with a plant, without log, evaluation and checkpoints."""
    algorithm = load_algorithm(name)
    configuration = algorithm.Configuration.from_dict({})
    learner = Learner(
        TrainingRun(name, plant.scenario, samples, 0, configuration), algorithm, plant
    )
    learner.begin()
    return learner


def _advance(learner: Learner, samples: int) -> float:
    """CPU seconds of `samples` samples."""
    begin = time.process_time()
    for _ in range(samples):
        learner.advance()
    return time.process_time() - begin


def measure(scenario: Scenario, samples: int, repetitions: int = 5) -> dict[str, Any]:
    """Throughput of each shipped algorithm and the shares of its time.

    The clock is the process's CPU time, so that a shared machine does not spoil the figure; each
    repetition runs `samples` samples on from where the last one ended, with learning in progress.
    Shares are of a further, instrumented run, whose timers cost about 1 µs a call.
    """
    rows = []
    for name in ALGORITHMS:
        with FmuPlant(scenario) as plant:
            learner = _learner(plant, name, SETTLING + samples * (repetitions + 1))
            _advance(learner, SETTLING)
            seconds = [_advance(learner, samples) for _ in range(repetitions)]
            rates = sorted(samples / value for value in seconds)
            rows.append(
                {
                    "algorithm": name,
                    "median_samples_per_second": statistics.median(rates),
                    "lowest_samples_per_second": rates[0],
                    "highest_samples_per_second": rates[-1],
                    "microseconds_per_sample": _profile(learner, plant, samples),
                }
            )
    return {"scenario": scenario.name, "samples": samples, "repetitions": repetitions, "rows": rows}


def _profile(learner: Learner, plant: FmuPlant, samples: int) -> dict[str, float]:
    """Microseconds per sample by part of the loop."""
    watch = _Stopwatch()
    watch.watch(plant, "step", "plant")
    watch.watch(learner.controller, "prepare", "prepare")
    watch.watch(learner.controller, "prepare_at", "prepare")
    watch.watch(learner.controller, "feedback", "feedback")
    watch.watch(learner.algorithm, "observe", "learning rule")
    total = _advance(learner, samples)
    parts = dict(watch.seconds)
    parts["rest of the loop"] = total - sum(parts.values())
    return {name: 1e6 * value / samples for name, value in parts.items()}
