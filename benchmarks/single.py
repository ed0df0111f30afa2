"""Errors of the plain C in single precision: python -m benchmarks.single.

What `cosim export --format c --single` writes is compared with the C in double precision;
benchmarks/performance.md has the table.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from controllers.factories import tuned
from cosim import FmuPlant, Scenario, simulate
from cosim.cli.controller_fmu import rti_controller, write_c
from cosim.core.result import markdown_table


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
        folders = [Path(name, precision, "nmpc") for precision in ("double", "single")]
        for folder in folders:
            folder.parent.mkdir()
            write_c(rti_controller("tuned", paper), paper, folder, folder is folders[1])
            # A controller that starts anew at each state: what came before would count, too.
            main = (folder / "main.c").read_text()
            anew = "nmpc_init(&controller);\n        const int status"
            (folder / "main.c").write_text(main.replace("const int status", anew))
        doubles, floats = folders
        rows = []
        for title, states in (("a closed loop of `paper`", run.states), ("random", drawn)):
            exact, _ = actions_and_status(doubles, states)
            found, status = actions_and_status(floats, states)
            errors = np.abs(found - exact).max(axis=1)[status == 0]
            held = f"{np.mean(status != 0):.1%}"
            rows.append(
                (title, str(len(states)), held, f"{np.median(errors):.1g}", f"{errors.max():.1g}")
            )
    print(markdown_table(("states", "samples", "held", "error, median", "error, largest"), rows))
