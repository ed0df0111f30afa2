"""A learner in a process of its own: it takes samples when it is told to and says what they took.

Run as a program, also on other versions of the packages, so it asks only for what all of them have:
the loop of a run, its `advance`, and the methods of plant, controller and rule.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from collections.abc import Iterable
from typing import Any, TextIO


class Stopwatch:
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


def serve(questions: Iterable[str], answers: TextIO) -> None:
    """Build what the first line describes, then answer one line of JSON to every line.

    The first line has `scenario`, `algorithm`, `samples` and `settings`, of which those that this
    version does not know are left out; its answer says how the functions are computed. `N` takes N
    samples and answers their CPU seconds; `profile N` the seconds by part of the loop.
    """
    lines = iter(questions)
    plant, learner = _learner(**json.loads(next(lines)))
    _say(answers, getattr(learner.controller, "functions", "interpreted"))
    for line in lines:
        word, _, count = line.strip().rpartition(" ")
        _say(answers, _profile(learner, plant, int(count)) if word else _take(learner, int(count)))


def _say(answers: TextIO, answer: Any) -> None:
    answers.write(json.dumps(answer) + "\n")
    answers.flush()


def _learner(scenario: str, algorithm: str, samples: int, settings: dict[str, Any]) -> Any:
    """A plant, and an algorithm in its loop with it, without log, evaluation and checkpoints."""
    from cosim import FmuPlant
    from learning.algorithm import load_algorithm
    from learning.loop import begin

    try:
        run = importlib.import_module("learning.training_run").TrainingRun
    except ImportError:
        run = importlib.import_module("learning.run").Run  # its name until 2026-11-20
    rule = load_algorithm(algorithm)
    known = {k: v for k, v in settings.items() if k in rule.Configuration.model_fields}
    plant = FmuPlant(scenario)
    configuration = rule.Configuration.from_dict(known)
    return plant, begin(run(algorithm, plant.scenario, samples, 0, configuration), rule, plant)


def _take(learner: Any, samples: int) -> float:
    begin = time.process_time()
    for _ in range(samples):
        learner.advance()
    return time.process_time() - begin


def _profile(learner: Any, plant: Any, samples: int) -> dict[str, float]:
    """CPU seconds by part; the timers cost about 1 µs a call."""
    watch = Stopwatch()
    watch.watch(plant, "step", "plant")
    watch.watch(learner.controller, "prepare", "prepare")
    watch.watch(learner.controller, "prepare_at", "prepare")
    watch.watch(learner.controller, "feedback", "feedback")
    watch.watch(learner.algorithm, "observe", "learning rule")
    total = _take(learner, samples)
    return watch.seconds | {"rest of the loop": total - sum(watch.seconds.values())}


if __name__ == "__main__":
    with os.fdopen(os.dup(1), "w") as own:
        os.dup2(2, 1)  # an FMU or a solver is native code that may print
        serve(sys.stdin, own)
