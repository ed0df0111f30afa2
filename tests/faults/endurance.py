"""Endurance: a long learning run, or an evaluation of very many units; memory, time, failures.

    python tests/faults/endurance.py --samples 1000000 [--record] [--rule-alone]
    python tests/faults/endurance.py --units 1000000 [--jobs 2]

The first one trains on one plant and looks at every tenth of the run; the second one evaluates a
controller that does nothing on as many seeds of one sample, looks after one, ten and a hundred per
cent, writes the tables, and reads the finished units once more.

Exit code 1 where memory grew by more than --megabytes after the first tenth, the last part cost
more than --drift times the first one's CPU time, a sample failed to be solved, or a unit was lost.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import os
import resource
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim import Scenario, evaluate
from cosim.plugins import build_controller
from learning.q_learning import QLearning
from learning.search import Search
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


def endure(
    samples: int, folder: Path, *, record: bool = False, alone: bool = False
) -> dict[str, object]:
    """Train for `samples` samples with checkpoints; figures of each tenth of the run.

    Each tenth ends with an evaluation and a checkpoint, so what happens once happens in the first.
    Recorded, the log has a row for each thousandth of the run.
    """
    tenth = samples // TENTHS
    every = tenth // 100 if record else tenth
    scenario = Scenario.load("paper")
    run = TrainingRun(
        algorithm="q-learning" if alone else "search",
        scenario=scenario,
        samples=tenth * TENTHS,
        seed=0,
        configuration=QLearning.Configuration()
        if alone
        else Search.Configuration(rule="q-learning"),
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

    # What is loaded once is loaded first: SciPy's LAPACK comes with the first dπ/dθ, which a search
    # asks for when learning no longer pays.
    build_controller("naive", scenario).feedback(scenario.initial_state).policy_jacobian  # noqa: B018
    look(0, None)
    result = run_training(run, folder, progress=look)
    held = [row for row in result.rows if row["samples"] % tenth == 0]
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


@dataclass(frozen=True)
class Answer:
    """The reference action, which costs nothing to find."""

    action: NDArray[np.float64]
    value: float = 0.0
    status: str = "solved"
    residual: float = 0.0
    predicted_states: None = None
    predicted_actions: None = None


class Hold:
    """A controller that does nothing: what an evaluation costs is the evaluation's own."""

    name = "hold"

    def __init__(self, scenario: Scenario) -> None:
        self._answer = Answer(scenario.reference_action)

    def reset(self) -> None:
        """Nothing to forget."""

    def prepare(self) -> None:
        """Nothing to prepare."""

    def feedback(self, s: NDArray[np.float64], a: None = None) -> Answer:
        """The same at every state."""
        return self._answer


def evaluate_units(units: int, folder: Path, *, jobs: int) -> dict[str, object]:
    """Evaluate as many seeds of one sample; memory and CPU time on the way and afterwards.

    CPU time is this process's and, where there are `jobs`, that of the workers that have ended.
    """
    looks = [units // 100, units // 10, units]
    seen: list[tuple[int, float, int]] = []

    def look(done: int) -> None:
        while len(seen) < len(looks) and done >= looks[len(seen)]:
            seen.append((done, sum(os.times()[:4]), resident()))

    begin = sum(os.times()[:4])
    table = evaluate("paper", {"hold": Hold}, units, 1, folder=folder, jobs=jobs, progress=look)
    table.write(folder)
    summary = table.summary()
    cpu_tables = sum(os.times()[:4])
    after = resident()
    evaluate("paper", {"hold": Hold}, units, 1, folder=folder)
    cpu_again = sum(os.times()[:4])
    (first, at_first, _), (_, _, at_tenth), (last, at_last, at_end) = seen
    per_unit = [1e6 * (at_first - begin) / first, 1e6 * (at_last - at_first) / (last - first)]
    with (folder / "evaluation.csv").open() as stream:
        rows = sum(1 for _ in stream) - 1
    return {
        "units": units,
        "status": "finished" if rows == units == last else "units were lost",
        "failures": summary["controllers"]["hold"]["failures"],
        "J": summary["controllers"]["hold"]["J"],
        "cpu_us_per_unit": per_unit,
        "cpu_seconds": at_last - begin,
        "cpu_seconds_of_tables": cpu_tables - at_last,
        "cpu_seconds_to_read_again": cpu_again - cpu_tables,
        "resident_mb": [value / 1e6 for _, _, value in seen],
        "resident_mb_after_the_tables": after / 1e6,
        "largest_resident_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "megabytes_on_disk": sum(p.stat().st_size for p in folder.rglob("*")) / 1e6,
        "files": len(list(folder.rglob("*"))),
        "growth_mb": (at_end - at_tenth) / 1e6,
        "last_over_first": per_unit[-1] / per_unit[0],
    }


def main() -> int:
    """Run, print the figures as JSON, judge them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--record", action="store_true", help="write a recording, too")
    parser.add_argument("--rule-alone", action="store_true", help="no search around the rule")
    parser.add_argument("--units", type=int, help="evaluate as many units in place of training")
    parser.add_argument("--jobs", type=int, default=1, help="processes that evaluate them")
    parser.add_argument("--megabytes", type=float, default=5.0)
    parser.add_argument("--drift", type=float, default=1.25)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if options.units is None:
            figures = endure(
                options.samples,
                Path(folder),
                record=options.record,
                alone=options.rule_alone,
            )
        else:
            figures = evaluate_units(options.units, Path(folder), jobs=options.jobs)
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
