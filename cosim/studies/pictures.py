"""Runs of a study sample by sample, and logs of its trainings: kept beside the tables and drawn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from cosim.figures.style import BOUND, DASHED, WIDTH, figure, label, palette, save_set, shown_case
from cosim.figures.training import parameters_figure
from cosim.figures.trajectory import overlay_figure, trajectory_figure
from cosim.files import write_atomically
from cosim.plugins import build_controller
from cosim.protocols import Array, Controller
from cosim.scenario import VIOLATING, Scenario
from cosim.statistics import TD_WINDOW, td_error_mean
from cosim.studies.document import TrajectoryTable
from cosim.studies.plan import Plan, Run, safe
from cosim.studies.report import FOLDER
from cosim.studies.store import LOG, PARAMETERS, read_table
from cosim.trajectory import Trajectory, read_csv

Policy = Callable[[Array], Array]
TRAJECTORIES, LOGS, KEPT = "trajectories", "logs", "parameters"
PREFIX = "theta "
GRID, BINS = 13, 80


def keep(plan: Plan, out: Path) -> None:
    """Copy the trajectories, logs and θ that the study keeps into folders of their own."""
    for run in plan.runs:
        files = {table.file: _trajectory(out, table, run) for table in run.traces}
        if _is_logged(plan, run):
            files[LOG] = out / LOGS / f"{_stem(run)}.csv"
            files[PARAMETERS] = out / KEPT / f"{_stem(run)}.toml"
        for name, target in files.items():
            if (source := out / run.key.folder / name).is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(target, source.read_bytes())


def draw(plan: Plan, out: Path) -> list[str]:
    """Draw the kept trajectories and logs into `out`/figures; returns the figures' names."""
    return save_set(_figures(plan, out), out / FOLDER)


def _trajectory(out: Path, table: TrajectoryTable, run: Run) -> Path:
    return out / TRAJECTORIES / table.name / safe(run.key.scenario) / f"{safe(run.key.case)}.csv"


def _stem(run: Run) -> str:
    return f"{safe(run.key.scenario)}-{safe(run.key.case)}"


def _is_logged(plan: Plan, run: Run) -> bool:
    """Whether a run is the first training seed of a case whose log is kept."""
    seeds = run.case.training_seeds
    return bool(seeds) and run.key.seed == seeds[0] and run.key.case in plan.definition.table.logs


def _figures(plan: Plan, out: Path) -> Iterator[tuple[str, Figure]]:
    """Names and figures of the tables `[[trajectory]]`, then of the logs."""
    for name, scenario in plan.definition.scenarios.items():
        for table in plan.definition.table.trajectory:
            runs = [run for run in plan.runs if run.key.scenario == name and table in run.traces]
            runs = [run for run in runs if _trajectory(out, table, run).is_file()]
            found = {
                case: replace(read_csv(_trajectory(out, table, run), scenario), controller=case)
                for run in runs
                for case in [run.key.case]
            }
            for kind in table.figures if found else ():
                stem = f"{kind}-{safe(name)}-{table.name}"
                if kind == "trajectory":
                    beside = list(found.values())
                    for case, one in found.items():
                        yield (
                            f"{stem}-{safe(case)}",
                            trajectory_figure(one, scenario, beside=beside),
                        )
                elif kind == "overlay":
                    yield stem, overlay_figure(found)
                elif kind == "density":
                    yield stem, density_figure(found, scenario)
                else:
                    policies = {run.key.case: _policy(plan, run, out) for run in runs}
                    yield stem, phase_figure(found, policies, scenario)
    for run in plan.runs:
        path = out / LOGS / f"{_stem(run)}.csv"
        if _is_logged(plan, run) and path.is_file():
            log = read_table(path)
            if blocks := increments(log):
                error = (log[name].to_numpy(float) for name in ("samples", "td_error", "updates"))
                drawn = parameters_figure(
                    log.samples.to_numpy(float), blocks, td_error_mean(*error), window=TD_WINDOW
                )
                yield f"parameters-{_stem(run)}", drawn


def increments(log: pd.DataFrame) -> dict[str, Array]:
    """θ less its first row by block, (K, entries), of a training's log."""
    theta = log[[name for name in log if name.startswith(PREFIX)]].astype(float)
    blocks = [str(name).removeprefix(PREFIX).partition("[")[0] for name in theta]
    moved = theta.to_numpy() - theta.to_numpy()[:1]
    return {
        block: moved[:, [i for i, other in enumerate(blocks) if other == block]]
        for block in dict.fromkeys(blocks)
    }


def density_figure(runs: Mapping[str, Trajectory], scenario: Scenario) -> Figure:
    """Density of the first state against its lower bound, a line for each controller.

    The bins are common and an edge lies on the bound, so that no bin mixes both sides; the axis
    leaves out the outermost 0.1 % of all samples. The legend gives the share that violates it.
    """
    name, bound = scenario.plant.states[0], float(scenario.state_lower[0])
    unit = next(iter(runs.values())).signals[name].unit
    samples = {case: run[name] for case, run in runs.items()}
    low, high = np.quantile(np.concatenate([*samples.values()]), (0.001, 0.999))
    low, high = min(float(low), bound), max(float(high), bound)
    # Not narrower than the smallest sample can fill (Freedman and Diaconis' rule).
    spans = [
        float(2 * np.subtract(*np.quantile(values, (0.75, 0.25))) / np.cbrt(len(values)))
        for values in samples.values()
    ]
    width = max((high - low) / BINS, *spans) or 1e-3 * max(abs(bound), 1.0)
    edges = bound + width * np.arange(
        -np.ceil((bound - low) / width) - 1, np.ceil((high - bound) / width) + 2
    )
    looks = palette(list(samples))
    with figure(2.9, 4.6) as drawn:
        axes = drawn.subplots()
        for case, values in samples.items():
            share = 100 * float(np.mean(bound - values > VIOLATING))
            heights = np.histogram(values, edges)[0] / (len(values) * width)
            color = looks[case].color
            axes.stairs(heights, edges, fill=True, alpha=0.12, color=color)
            text = f"{shown_case(case)}: {share:.1f} % below"
            axes.stairs(heights, edges, color=color, linewidth=1.2, label=text)
        axes.axvline(bound, color=BOUND, linewidth=1.1, linestyle=DASHED, label="bound")
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel(label(name, unit))
        inverse = f"1/({unit})" if "/" in unit else f"1/{unit}"
        axes.set_ylabel("density" if unit in ("", "1") else f"density [{inverse}]")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.2)
    return drawn


def phase_figure(
    runs: Mapping[str, Trajectory], policies: Mapping[str, Policy], scenario: Scenario
) -> Figure:
    """Phase portraits, a panel for each controller: where the state lives, and its policy there.

    Background: density of the visited states, logarithmic. Arrows: the policy as a vector field,
    (π(s) − u_s)/(u_u − u_l), right where the first input rises and up where the second does; an
    arrow's length goes with the root of its size. Red: bounds. Cross: operating point.
    """
    visited = np.concatenate([run.states for run in runs.values()])
    low, high = np.quantile(visited, (0.001, 0.999), axis=0)
    x, y = (np.linspace(low[i], high[i], GRID) for i in range(2))
    width = (scenario.action_upper - scenario.action_lower)[:2]
    fields = {
        case: np.array([[policy(np.array([xj, yi]))[:2] for xj in x] for yi in y])
        for case, policy in policies.items()
    }
    fields = {c: (field - scenario.reference_action[:2]) / width for c, field in fields.items()}
    longest = max(float(np.nanmax(np.hypot(f[..., 0], f[..., 1]))) for f in fields.values())
    columns = 2 if len(runs) == 4 else min(len(runs), 3)
    rows = -(-len(runs) // columns)
    half = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    extent = (x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1])
    signals = next(iter(runs.values())).signals
    with figure(7.0 / columns * rows + 0.4, WIDTH if columns > 1 else 4.2) as drawn:
        grid = drawn.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for axes in grid.flat[len(runs) :]:
            axes.set_visible(False)
        for axes, (case, run) in zip(grid.flat, runs.items(), strict=False):
            _states(axes, run.states[:, :2], extent)
            _arrows(axes, x, y, fields[case] / (longest or 1.0))
            axes.plot(*scenario.reference_state[:2], "+", color=BOUND, ms=9, mew=1.6, zorder=5)
            for line, i in ((axes.axvline, 0), (axes.axhline, 1)):
                for bound in (scenario.state_lower[i], scenario.state_upper[i]):
                    line(bound, color=BOUND, linewidth=1.0, linestyle=DASHED, zorder=3)
            axes.set_title(shown_case(case))
            axes.set_xlim(extent[:2])
            axes.set_ylim(extent[2:])
        states = [label(name, signals[name].unit) for name in scenario.plant.states[:2]]
        for axes in grid[-1]:
            axes.set_xlabel(states[0])
        for axes in grid[:, 0]:
            axes.set_ylabel(states[1])
        first, second = (label(name, "") for name in scenario.plant.actions[:2])
        drawn.supxlabel(
            f"arrows: input less its operating point, right {first}, up {second}; the longest is "
            f"{100 * longest:.0f} % of the input range\ncolour: how often the state was there, "
            "logarithmic; red: bounds; cross: operating point",
            fontsize=7.0,
        )
    return drawn


def _arrows(axes: Axes, x: Array, y: Array, field: Array) -> None:
    size = np.hypot(field[..., 0], field[..., 1])
    shrink = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
    axes.quiver(
        *np.meshgrid(x, y), field[..., 0] * shrink, field[..., 1] * shrink, angles="uv",
        pivot="mid", scale=1.05 * max(len(x), len(y)), scale_units="width", width=0.004,
        color="#1A1A1A", zorder=4,
    )  # fmt: skip


def _states(axes: Axes, states: Array, extent: tuple[float, float, float, float]) -> None:
    left, right, bottom, top = extent
    inside = (states > (left, bottom)).all(axis=1) & (states < (right, top)).all(axis=1)
    cells = axes.hexbin(
        *states[inside].T, gridsize=40, extent=extent, mincnt=1, linewidths=0.1, zorder=1
    )
    counts = cells.get_array()
    if counts is not None and counts.size:
        # The upper part of the map is left out: arrows must stay legible on it.
        cells.set(cmap="YlGnBu", norm=LogNorm(0.7, 20.0 * float(counts.max())))


def _policy(plan: Plan, run: Run, out: Path) -> Policy:
    scenario = plan.definition.scenarios[run.key.scenario]
    controller: Controller = (
        build_controller(run.case.controller or "", scenario)
        if run.training is None
        else run.training.controller((out / run.key.folder / PARAMETERS).read_text("utf-8"))
    )

    def act(s: Array) -> Array:
        controller.reset()
        # One QP from a cold guess is not the policy: let a real-time iteration settle.
        for _ in range(5):
            controller.prepare()
            action = controller.feedback(s).action
        return action

    return act
