"""`python -m benchmarks NAME`: a table of medians in µs and ratios, or JSON."""

import argparse
from importlib import import_module

from benchmarks.measuring import HEADER, cells
from cosim import Scenario
from cosim.cli.output import output

STEPS = {
    "plant": 5000,
    "controllers": 2000,
    "learning": 1000,
    "estimator": 2000,
    "preview": 2000,
    "export": 2000,
    "evaluation": 2000,
    "scaling": 20,
    "before": 2000,
    "rollouts": 100_000,
    "batches": 1000,
}
"""The benchmarks, and how many samples each takes at a time."""


def main():
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__)
    parser.add_argument("name", choices=STEPS)
    parser.add_argument("--scenario", "-s", default="paper")
    parser.add_argument("--steps", "--samples", "-n", type=int, help="samples at a time")
    parser.add_argument(
        "--against", help="`before`: folder of another version's sources, with its .venv"
    )
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    steps = STEPS[chosen.name] if chosen.steps is None else chosen.steps
    if steps < 1:
        parser.error(f"--steps must be at least 1, not {steps}")
    compared = chosen.name == "before"
    if compared and not chosen.against:
        parser.error(f"{chosen.name} needs --against")
    scenario = Scenario.load(chosen.scenario)
    with output(chosen.json) as out_:
        more = [chosen.against] if compared else []
        rows = import_module(f"benchmarks.{chosen.name}").measure(scenario, steps, *more)
        title = f"{chosen.name} on {scenario.name}, {steps} samples at a time"
        out_.table(title, HEADER, [cells(row) for row in rows])
        out_.json({"scenario": scenario.name, "steps": steps, "rows": rows})


if __name__ == "__main__":
    main()
