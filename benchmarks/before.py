"""A sample of this version beside one of another version's sources, turn by turn in one run."""

import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

from benchmarks.measuring import figure

REPETITIONS = 20
KINDS = {
    "evaluate": ("closed-loop sample of evaluate", 1 / 0.25),
    "q_learning": ("V, Q, dQ/dθ and the FMU's step", 1 / 0.35),
    "actor_critic": ("π, V, dV/dθ, dπ/dθ and the FMU's step", 1 / 0.4),
    "value": ("prepare + feedback + dV/dθ", 1 / 0.45),
}
"""By kind of sample its name, and how many times as long the other version must take."""


def measure(scenario, steps, against):
    """Time `steps` samples of each kind in turn here and in the folder `against`."""
    trees = {"own": Path.cwd(), "other": Path(against).resolve()}
    seconds = {kind: {name: [] for name in trees} for kind in KINDS}
    with ExitStack() as stack:
        workers = {
            name: stack.enter_context(worker(tree, scenario.name)) for name, tree in trees.items()
        }
        for turn in range(REPETITIONS + 1):
            for kind, times in seconds.items():
                for name, process in workers.items():
                    print(kind, steps, file=process.stdin, flush=True)
                    spent = float(process.stdout.readline()) / steps
                    if turn:  # the first one warms up
                        times[name].append(spent)
        for process in workers.values():
            process.stdin.close()
    return [
        figure(KINDS[kind][0], times["own"], trees["other"].name, times["other"],
               at_least=KINDS[kind][1])
        for kind, times in seconds.items()
    ]  # fmt: skip


def worker(tree, scenario):
    """A process that takes samples with a folder's packages."""
    process = subprocess.Popen(
        [sys.executable, "-P", str(Path(__file__).with_name("turns.py"))],
        cwd=tree, env=os.environ | {"PYTHONPATH": str(tree), "COSIM_COMPILE": "now"},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    print(scenario, file=process.stdin, flush=True)
    return process
