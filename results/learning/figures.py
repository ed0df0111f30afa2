"""Learning curves of the sweep, from the stored tables.

    python results/learning/figures.py

Writes learning-SCENARIO.png/.svg: the greedy J above J* against samples, a panel for each
algorithm. J* is the optimal controller's J on the very noise of the greedy evaluations. A run that
diverged is held at the J that it ended with.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cases import CASES
from numpy.typing import NDArray
from stored import SCENARIOS, rows

from cosim import FmuPlant, Scenario
from cosim.figures import plot_learning_curves
from cosim.lookup import build_controller
from learning.evaluation import Evaluation, held_out

Array = NDArray[np.float64]
HERE = Path(__file__).parent
SEEDS, STEPS = 4, 500  # the defaults of `cosim train`, with which the sweep was made


def level(scenario: Scenario, name: str) -> float:
    """J of a baseline on the noise of the greedy evaluations."""
    with FmuPlant(scenario) as plant:
        evaluation = Evaluation(plant, held_out(SEEDS), STEPS)
        return evaluation.means(build_controller(name, scenario))["J"]


def curves(rows: list[dict[str, str]]) -> tuple[Array, Array]:
    """Samples (K,) and greedy J (S, K) of a case's runs, each held at its end."""
    seeds = sorted({int(row["training_seed"]) for row in rows})
    runs = [[row for row in rows if int(row["training_seed"]) == seed] for seed in seeds]
    grid = np.array([float(row["samples"]) for row in max(runs, key=len)])
    values = np.full((len(runs), len(grid)), np.nan)
    for run, line in zip(runs, values, strict=True):
        line[: len(run)] = [float(row["greedy_J"]) for row in run]
        line[len(run) :] = line[len(run) - 1]
    return grid, values


def held(samples: Array, values: Array, end: float) -> tuple[Array, Array]:
    """Curves (K,) and (S, K) with their last values held until `end`."""
    return np.append(samples, end), np.hstack([values, values[:, -1:]])


def main() -> None:
    """Draw a figure for each scenario."""
    for name in SCENARIOS:
        scenario, points = Scenario.load(name), rows(HERE / "curves.csv", name)
        runs = rows(HERE / "runs.csv", name)
        ended = [run["case"] for run in runs if run["status"] == "diverged"]
        optimum = level(scenario, "optimal")
        panels: dict[str, dict[str, tuple[Array, Array]]] = {}
        for case, settings in CASES.items():
            mine = [point for point in points if point["case"] == case]
            if not mine:
                continue
            samples, values = curves(mine)
            variant = case.removeprefix(f"{settings.algorithm}-")
            diverged = f", {ended.count(case)} diverged" if case in ended else ""
            panel = panels.setdefault(settings.algorithm, {})
            panel[f"{variant}{diverged}"] = (samples, values - optimum)
        for panel in panels.values():
            end = max(samples[-1] for samples, _ in panel.values())
            panel |= {
                name: held(*curve, end) for name, curve in panel.items() if "diverged" in name
            }
        for suffix in ("png", "svg"):
            plot_learning_curves(
                panels,
                HERE / f"learning-{name}.{suffix}",
                ylabel="greedy J − J*",
                references={"naive": level(scenario, "naive") - optimum},
                logarithmic=True,
            )


if __name__ == "__main__":
    main()
