"""Runs of a study sample by sample, and logs of its trainings, kept beside the tables and drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cosim.figures import (
    Portrait,
    overlay_figure,
    parameters_figure,
    plot_density,
    plot_phase_portraits,
    policy_on_grid,
    save,
    trajectory_figure,
)
from cosim.files import write_atomically
from cosim.protocols import Controller
from cosim.scenario import Scenario
from cosim.statistics import TD_WINDOW, td_error_mean
from cosim.study.document import TrajectoryTable
from cosim.study.plan import Plan, Run
from cosim.study.store import RunStore, safe
from cosim.study.tables import read_numbers
from cosim.trajectory import Trajectory, read_csv

Array = NDArray[np.float64]
Policy = Callable[[Array], Array]

TRAJECTORIES, LOGS, PARAMETERS, FIGURES = "trajectories", "logs", "parameters", "figures"
SUFFIXES = ("svg", "png")
THETA = "theta "
GRID = 13


def keep(plan: Plan, out: Path, stores: Mapping[str, RunStore]) -> None:
    """Put trajectories, logs and θ into folders of their own."""
    for run in plan.runs:
        store, case = stores[str(run.key)], safe(run.key.case)
        for table in run.traces:
            if (path := store.trajectory(table)) is not None:
                _copy(out / _folder(table, run.key.scenario) / f"{case}.csv", path.read_bytes())
        progress = store.progress()
        if _is_logged(plan, run) and progress.ended:
            _copy(out / LOGS / f"{_stem(run)}.csv", progress.log.encode())
            _copy(out / PARAMETERS / f"{_stem(run)}.toml", progress.parameters.encode())


def draw(plan: Plan, out: Path, stores: Mapping[str, RunStore]) -> list[str]:
    """Draw what `keep` put there; returns the figures' names."""
    (out / FIGURES).mkdir(parents=True, exist_ok=True)
    drawn = []
    for name, scenario in plan.definition.scenarios.items():
        for table in plan.definition.table.trajectory:
            runs = _kept(plan, table, name, out)
            if runs and table.figures:
                drawn += _draw(table, scenario, runs, out / FIGURES, plan, stores)
    for run in plan.runs:
        if _is_logged(plan, run) and (path := out / LOGS / f"{_stem(run)}.csv").is_file():
            drawn += _draw_log(path, out / FIGURES)
    return drawn


def _copy(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content)


def _folder(table: TrajectoryTable, scenario: str) -> Path:
    return Path(TRAJECTORIES, table.name, safe(scenario))


def _stem(run: Run) -> str:
    return f"{safe(run.key.scenario)}-{safe(run.key.case)}"


def _is_logged(plan: Plan, run: Run) -> bool:
    """Whether a run is the first training seed of a case whose log is kept."""
    seeds = run.case.training_seeds
    return bool(seeds) and run.key.seed == seeds[0] and run.key.case in plan.definition.table.logs


def _kept(
    plan: Plan, table: TrajectoryTable, scenario: str, out: Path
) -> dict[str, tuple[Run, Trajectory]]:
    """The runs of a trajectory on a scenario by case."""
    found = {}
    for run in plan.runs:
        path = out / _folder(table, scenario) / f"{safe(run.key.case)}.csv"
        if run.key.scenario == scenario and table in run.traces and path.is_file():
            trajectory = read_csv(path, plan.definition.scenarios[scenario])
            found[run.key.case] = (run, replace(trajectory, controller=run.key.case))
    return found


def _draw(
    table: TrajectoryTable,
    scenario: Scenario,
    runs: Mapping[str, tuple[Run, Trajectory]],
    folder: Path,
    plan: Plan,
    stores: Mapping[str, RunStore],
) -> list[str]:
    trajectories = {case: trajectory for case, (_, trajectory) in runs.items()}
    drawn = []
    for suffix in SUFFIXES:
        for figure in table.figures:
            stem = f"{figure}-{safe(scenario.name)}-{table.name}"
            path = folder / f"{stem}.{suffix}"
            if figure == "trajectory":
                for case, run in trajectories.items():
                    own = folder / f"{stem}-{safe(case)}.{suffix}"
                    save(trajectory_figure(run, scenario, beside=list(trajectories.values())), own)
                    drawn.append(own.stem)
                continue
            drawn.append(stem)
            if figure == "overlay":
                save(overlay_figure(trajectories), path)
            elif figure == "density":
                _density(trajectories, scenario, path)
            else:
                policies = {
                    case: _policy(plan, run, stores[str(run.key)])
                    for case, (run, _) in runs.items()
                }
                _phase(trajectories, policies, scenario, path)
    return list(dict.fromkeys(drawn))


def _density(runs: Mapping[str, Trajectory], scenario: Scenario, path: Path) -> None:
    """The first state against its lower bound."""
    name = scenario.plant.states[0]
    unit = next(iter(runs.values())).signals[name].unit
    samples = {case: run.states[:, 0] for case, run in runs.items()}
    plot_density(samples, float(scenario.state_lower[0]), name, unit, path)


def _phase(
    runs: Mapping[str, Trajectory], policies: Mapping[str, Policy], scenario: Scenario, path: Path
) -> None:
    visited = np.concatenate([run.states for run in runs.values()])
    low, high = np.quantile(visited, (0.001, 0.999), axis=0)
    x, y = (np.linspace(low[i], high[i], GRID) for i in range(2))
    portraits = [
        Portrait(case, run.states, policy_on_grid(policies[case], x, y))
        for case, run in runs.items()
    ]
    units = {name: signal.unit for name, signal in next(iter(runs.values())).signals.items()}
    plot_phase_portraits(portraits, x, y, scenario, path, units=units)


def _policy(plan: Plan, run: Run, store: RunStore) -> Policy:
    trainer, scenario = plan.definition.trainer, plan.definition.scenarios[run.key.scenario]
    controller: Controller = (
        trainer.controller(run.case.controller or "", scenario)
        if run.training is None
        else trainer.policy(run.training, store.progress().parameters)
    )

    def act(s: Array) -> Array:
        controller.reset()
        # One QP from a cold guess is not the policy: let a real-time iteration settle.
        for _ in range(5):
            controller.prepare()
            action = controller.feedback(s).action
        return action

    return act


def _draw_log(path: Path, folder: Path) -> list[str]:
    """Draw the paper's figure of a training: increments of θ, and the TD error."""
    log = read_numbers(path)
    blocks = increments(log)
    if not blocks:
        return []
    name = f"parameters-{path.stem}"
    td_error = td_error_mean(log["samples"], log["td_error"], log["updates"])
    drawn = parameters_figure(log["samples"], blocks, td_error, window=TD_WINDOW)
    for suffix in SUFFIXES:
        save(drawn, folder / f"{name}.{suffix}")
    return [name]


def increments(log: Mapping[str, Array]) -> dict[str, Array]:
    """θ less its first row by block, (K, entries), of a training's log."""
    blocks: dict[str, list[Array]] = {}
    for name, values in log.items():
        if name.startswith(THETA):
            block = name.removeprefix(THETA).partition("[")[0]
            blocks.setdefault(block, []).append(values - values[0])
    return {name: np.stack(columns, axis=1) for name, columns in blocks.items()}
