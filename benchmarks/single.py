"""Errors of the plain C in single precision: python -m benchmarks.single.

In what `cosim export --format c` writes `float` takes the place of `double`, all else stays. What
it does is compared with the C as written; docs/how-to/microcontroller.md has the table.
"""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from controllers.factories import tuned
from cosim import FmuPlant, Scenario, simulate
from cosim.cli.controller_fmu import rti_controller, write_c
from cosim.text_tables import markdown_table

LITERAL = re.compile(r"(?<![\w.])(\d+\.\d*(?:e[-+]?\d+)?|\d+e[-+]?\d+)(?![\w.])")
CHANGES = (
    (LITERAL, r"\1f"),
    (re.compile(r"\bdouble\b"), "float"),
    (re.compile(r"\b(sqrt|fabs)\b"), r"\1f"),
    (re.compile(r"%lf"), "%f"),
    (re.compile(r"(_MEMORY = \d+)"), r"\1 * 2"),  # the counters are not smaller
)


def single(folder, target):
    target.mkdir()
    for path in folder.glob("*.[ch]"):
        text = path.read_text()
        for pattern, by in CHANGES:
            text = pattern.sub(by, text)
        (target / path.name).write_text(text)
    return target


def actions_and_status(folder, states):
    command = [os.environ.get("CC", "cc"), "-std=c99", "-O2", "-w", "-ffp-contract=off"]
    files = [folder / name for name in ("nmpc.c", "main.c")]
    subprocess.run([*command, *files, "-o", folder / "run", "-lm"], check=True)
    lines = "\n".join(" ".join(map(repr, s)) for s in states.tolist())
    printed = subprocess.check_output([folder / "run"], input=lines, text=True).splitlines()
    found = np.array([line.split()[:3] for line in printed], dtype=float)
    return found[:, :2], found[:, 2]


if __name__ == "__main__":
    paper = Scenario.load("paper")
    with FmuPlant(paper) as plant:
        run = simulate(plant, tuned(paper), 2000, 4)
    drawn = np.random.default_rng(0).uniform((15, 35), (40, 80), (20_000, 2))
    with tempfile.TemporaryDirectory() as name:
        written = Path(name, "nmpc")
        write_c(rti_controller("tuned", paper), paper, written)
        # A controller that starts anew at each state: what came before would count, too.
        main = (written / "main.c").read_text()
        main = main.replace("const int status", "nmpc_init(&controller);\n        const int status")
        (written / "main.c").write_text(main)
        floats = single(written, Path(name, "single"))
        rows = []
        for title, states in (("a closed loop of `paper`", run.states), ("random", drawn)):
            exact, _ = actions_and_status(written, states)
            found, status = actions_and_status(floats, states)
            errors = np.abs(found - exact).max(axis=1)[status == 0]
            held = f"{np.mean(status != 0):.1%}"
            rows.append(
                (title, str(len(states)), held, f"{np.median(errors):.1g}", f"{errors.max():.1g}")
            )
    print(markdown_table(("states", "samples", "held", "error, median", "error, largest"), rows))
