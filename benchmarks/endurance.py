"""Endurance: a long learning run; memory, time, failures.

    python -m benchmarks.endurance --samples 1000000 [--log]

Trains on one plant and looks at every tenth of the run. Exit code 1 where memory grew by more than
--megabytes after the first tenth, the last tenth cost more than --drift times the first one's CPU
time, or a sample failed to be solved.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import sys
import tempfile
import time
from contextlib import suppress
from importlib import import_module
from itertools import pairwise
from pathlib import Path

from controllers.factories import build_controller
from cosim import Scenario
from learning.q_learning import QLearning
from learning.training import run_training
from learning.training_run import TrainingRun

TENTHS = 10
PAGE = os.sysconf("SC_PAGE_SIZE")


def resident() -> int:
    """Resident memory of this process in bytes, without what glibc's allocator only keeps free."""
    gc.collect()
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def endure(samples: int, folder: Path, *, log: bool = False) -> dict[str, object]:
    """Train for `samples` samples with checkpoints; figures of each tenth of the run.

    Each tenth ends with an evaluation and a checkpoint, so what happens once happens in the first.
    With `log`, the log has a row for each thousandth of the run.
    """
    tenth = samples // TENTHS
    every = tenth // 100 if log else tenth
    scenario = Scenario.load("paper")
    run = TrainingRun(
        algorithm="q-learning",
        scenario=scenario,
        samples=tenth * TENTHS,
        seed=0,
        configuration=QLearning.Configuration(),
        log_every=every,
        evaluate_every=tenth,
        checkpoint_every=tenth,
    )
    cpu, wall, memory, failures = [], [], [], []

    def look(samples: int, row: dict[str, float] | None) -> None:
        if samples % tenth:
            return
        cpu.append(time.process_time())
        wall.append(time.perf_counter())
        memory.append(resident())
        failures.append(0 if row is None else int(row["failures"]))

    # What is loaded once is loaded first: SciPy's LAPACK comes with the first dπ/dθ, its
    # statistics with the first comparison of two shifts.
    import_module("scipy.stats")
    build_controller("naive", scenario).feedback(scenario.initial_state).policy_jacobian  # noqa: B018
    look(0, None)
    result = run_training(run, folder, progress=look)
    held = [row for row in result.rows[1:] if row["samples"] % tenth == 0]
    per_sample = [1e6 * (b - a) / tenth for a, b in pairwise(cpu)]
    per_wall = [1e6 * (b - a) / tenth for a, b in pairwise(wall)]
    return {
        "samples": run.samples,
        "status": result.status,
        "failures": failures[-1],
        "J": [row["J"] for row in held],
        "greedy_J": result.evaluation["J"],
        "cpu_us_per_sample": per_sample,
        "wall_us_per_sample": per_wall,
        "resident_mb": [value / 1e6 for value in memory[1:]],
        "growth_mb": (memory[-1] - memory[1]) / 1e6,
        "last_over_first": per_sample[-1] / per_sample[0],
    }


def main() -> int:
    """Run, print the figures as JSON, judge them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--log", action="store_true", help="a row of the log for each thousandth")
    parser.add_argument("--megabytes", type=float, default=5.0)
    parser.add_argument("--drift", type=float, default=1.25)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = endure(options.samples, Path(folder), log=options.log)
    print(json.dumps(figures, indent=2))
    sound = (
        figures["status"] == "finished"
        and figures["failures"] == 0
        and float(str(figures["growth_mb"])) < options.megabytes
        and float(str(figures["last_over_first"])) < options.drift
    )
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
