"""Which figures an experiment shows, drawn from what its runs left."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.errors import ResultsError
from cosim.figures import (
    Portrait,
    plot_density,
    plot_learning_curves,
    plot_overlay,
    plot_pareto,
    plot_phase_portraits,
    plot_trajectory,
    policy_on_grid,
)
from cosim.reproduction.curves import read_log
from cosim.results.experiments import Experiment
from cosim.scenario import Scenario
from cosim.trajectory import Trajectory, read_csv

Array = NDArray[np.float64]
Policy = Callable[[Path], Callable[[Array], Array]]
"""Gives the policy s (n,) -> a (m,) of the controller that left a run's folder."""

SUFFIXES = ("png", "svg")
GRID = 13


def draw(experiment: Experiment, runs: Mapping[str, Path], target: Path, policy: Policy) -> None:
    """Draw an experiment's figures into its folder as PNG and SVG."""
    for figure in experiment.figures:
        for suffix in SUFFIXES:
            _FIGURES[figure](runs, target / f"{figure}.{suffix}", policy)


def _trajectories(runs: Mapping[str, Path]) -> dict[str, Trajectory]:
    return {
        label: replace(
            read_csv(run / "trajectory.csv", Scenario.load(run / "scenario.toml")),
            controller=label,
        )
        for label, run in runs.items()
    }


def _trajectory(runs: Mapping[str, Path], path: Path, _: Policy) -> None:
    found = _trajectories(runs)
    for label, run in found.items():
        target = path.with_name(f"trajectory-{label}{path.suffix}")
        plot_trajectory(run, run.scenario, target, beside=list(found.values()))


def _overlay(runs: Mapping[str, Path], path: Path, _: Policy) -> None:
    plot_overlay(_trajectories(runs), path)


def _density(runs: Mapping[str, Path], path: Path, _: Policy) -> None:
    """The first state against its lower bound."""
    found = _trajectories(runs)
    scenario = next(iter(found.values())).scenario
    name = scenario.plant.states[0]
    unit = next(iter(found.values())).signals[name].unit
    samples = {label: run.states[:, 0] for label, run in found.items()}
    plot_density(samples, float(scenario.state_lower[0]), name, unit, path)


def _phase(runs: Mapping[str, Path], path: Path, policy: Policy) -> None:
    found = _trajectories(runs)
    scenario = next(iter(found.values())).scenario
    visited = np.concatenate([run.states for run in found.values()])
    low, high = np.quantile(visited, (0.001, 0.999), axis=0)
    x, y = (np.linspace(low[i], high[i], GRID) for i in range(2))
    portraits = [
        Portrait(label, run.states, policy_on_grid(policy(runs[label]), x, y))
        for label, run in found.items()
    ]
    units = {name: signal.unit for name, signal in next(iter(found.values())).signals.items()}
    plot_phase_portraits(portraits, x, y, scenario, path, units=units)


def _columns(path: Path) -> dict[str, list[str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    if not rows:
        raise ResultsError(f"'{path}' has no rows")
    return {name: [row[name] for row in rows] for name in rows[0]}


def _pareto(runs: Mapping[str, Path], path: Path, _: Policy) -> None:
    points: dict[str, tuple[Array, Array]] = {}
    for label, run in runs.items():
        table = _columns(run / "evaluation.csv")
        violation, cost = (np.array(table[c], float) for c in ("mean_violation", "economic_cost"))
        for name in dict.fromkeys(table["controller"]):
            mine = np.array(table["controller"]) == name
            shown = name if len(runs) == 1 else f"{name} ({label})"
            points[shown] = (violation[mine], cost[mine])
    plot_pareto(points, path)


def _learning(runs: Mapping[str, Path], path: Path, _: Policy) -> None:
    """The greedy policy's J, where it was evaluated."""
    curves = {}
    for label, run in runs.items():
        log = read_log(run / "learning.csv")
        evaluated = ~np.isnan(log["greedy_J"])
        curves[label] = (log["samples"][evaluated], log["greedy_J"][evaluated])
    plot_learning_curves({"": curves}, path, ylabel="J per sample, greedy")


_FIGURES: dict[str, Callable[[Mapping[str, Path], Path, Policy], None]] = {
    "trajectory": _trajectory,
    "overlay": _overlay,
    "density": _density,
    "phase": _phase,
    "pareto": _pareto,
    "learning": _learning,
}
