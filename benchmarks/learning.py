"""A sample of each learning rule, FMU included, with compiled and with interpreted functions."""

import os
from contextlib import ExitStack
from unittest.mock import patch

from benchmarks.measuring import clock, figure
from controllers import compile_functions
from cosim import FmuPlant
from learning.algorithm import load_algorithm
from learning.training_run import begin_training, make_run

ALGORITHMS = ("q-learning", "actor-critic", "batch-q-learning")
REPETITIONS = 20
"""Short turns and many: the clock rate of a shared machine changes within seconds."""
SETTLING = 1000
"""Samples before the clock starts: warm-up of the rule, caches, and the naive θ's worst QPs."""


def measure(scenario, steps):
    """Time `steps` samples of each rule in turn, compiled and interpreted, `REPETITIONS` times."""
    rows = []
    for name in ALGORITHMS:
        run = make_run(name, scenario, SETTLING + steps * REPETITIONS)
        seconds = {"now": [], "never": []}
        with ExitStack() as stack:
            loops = {}
            for mode in seconds:
                plant = stack.enter_context(FmuPlant(scenario))
                with patch.dict(os.environ, COSIM_COMPILE=mode):
                    loops[mode] = begin_training(run, load_algorithm(name), plant)
                    compile_functions(loops[mode].controller, run.samples)
                take(loops[mode], SETTLING)
            for _ in range(REPETITIONS):
                for mode, loop in loops.items():
                    seconds[mode].append(take(loop, steps) / steps)
        rows.append(figure(name, seconds["now"], "interpreter", seconds["never"]))
    return rows


def take(loop, samples):
    """Seconds of some samples."""
    start = clock()
    for _ in range(samples):
        loop.advance()
    return clock() - start
