"""Files that a study keeps beside its tables: trajectories, logs and θ, and their figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from cosim.core.errors import StudyError
from cosim.core.files import write_atomically
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.core.statistics import td_error_mean
from cosim.core.training_options import LOG, PARAMETERS
from cosim.core.trajectory import Trajectory, read_csv
from cosim.figures import style
from cosim.figures.states import Policy, density_figure, phase_figure
from cosim.figures.training import parameters_figure
from cosim.figures.trajectory import overlay_figure, trajectory_figure
from cosim.measurement import built
from cosim.studies.operation import THETA_PREFIX
from cosim.studies.plan import StudyPlan
from cosim.studies.report import FOLDER
from cosim.studies.run import Run, folder_name, read_table


def keep_files(plan: StudyPlan, out: Path) -> None:
    """Copy the files that a study keeps of its runs to where it keeps them.

    Args:
        plan: the study's plan, which names them.
        out: the study's folder.
    """
    for run in plan.runs:
        for name, kept in run.kept.items():
            source = out / run.folder / name
            # A run that is not finished may lack it.
            if not source.is_file():
                continue
            target = out / kept
            target.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(target, source.read_bytes())


def draw_kept(plan: StudyPlan, out: Path, formats: Sequence[str] = style.FORMATS) -> list[str]:
    """Draw the trajectories and logs that a study keeps.

    Args:
        plan: the study's plan, which names the kept files.
        out: the study's folder, or its stored one; the figures are written to `out`/figures.
        formats: of the files, as in `save_set`.

    Returns:
        Names of the figures.

    Raises:
        StudyError: if a phase portrait needs θ of a training that `out` does not hold.
    """
    drawn = chain(_trajectory_figures(plan, out), _training_figures(plan, out))
    return style.save_set(drawn, out / FOLDER, formats)


def _trajectory_figures(plan: StudyPlan, out: Path) -> Iterator[tuple[str, Figure]]:
    """Names and figures of the kept trajectories."""
    definition = plan.definition
    for name, scenario in definition.scenarios.items():
        for table in definition.table.trajectory:
            runs = _runs_with(table.file, name, plan, out)
            if not runs:
                continue
            trajectories = {}
            for case, run in runs.items():
                trajectory = read_csv(out / run.kept[table.file], scenario)
                # The study's name of it, which may be another than the controller's own.
                trajectories[case] = replace(trajectory, controller=case)
            for kind in table.figures:
                stem = f"{kind}-{folder_name(name)}-{table.name}"
                if kind == "trajectory":
                    for case, drawn in _single_figures(trajectories, scenario):
                        yield f"{stem}-{folder_name(case)}", drawn
                elif kind == "overlay":
                    yield stem, overlay_figure(trajectories, style.SCREEN)
                elif kind == "density":
                    yield stem, density_figure(trajectories, scenario)
                else:
                    policies = {case: _policy(run, out) for case, run in runs.items()}
                    yield stem, phase_figure(trajectories, policies, scenario)


def _single_figures(
    trajectories: Mapping[str, Trajectory],
    scenario: Scenario,
) -> Iterator[tuple[str, Figure]]:
    """A figure of each trajectory, by case."""
    # Their axes span all runs, so that the figures can be compared.
    beside = list(trajectories.values())
    for case, trajectory in trajectories.items():
        yield case, trajectory_figure(trajectory, scenario, beside=beside, width=style.SCREEN)


def _runs_with(file: str, scenario: str, plan: StudyPlan, out: Path) -> dict[str, Run]:
    """Runs on a scenario of which the study has kept a file, by case."""
    runs = {}
    for run in plan.runs:
        kept = run.kept.get(file)
        if run.scenario.name != scenario or kept is None:
            continue
        # Of an unfinished study some runs have no file yet.
        if (out / kept).is_file():
            runs[run.case] = run
    return runs


def _policy(run: Run, out: Path) -> Policy:
    """Policy of a run's controller; raises StudyError where its θ is gone."""
    theta = ""
    if run.training is not None:
        path = out / run.folder / PARAMETERS
        if not path.is_file():
            raise StudyError(
                f"the phase portrait of '{run.case}' needs its θ, and there is no '{path}'; "
                "run the study again"
            )
        theta = path.read_text("utf-8")
    controller = built(run.source(theta), run.scenario)

    def act(s: Array) -> Array:
        controller.reset()
        # One QP from a cold guess is not the policy: let a real-time iteration settle.
        for _ in range(5):
            controller.prepare()
            action = controller.feedback(s).action
        return action

    return act


def _training_figures(plan: StudyPlan, out: Path) -> Iterator[tuple[str, Figure]]:
    """Names and figures of the kept logs; a run in operation has none."""
    for run in plan.runs:
        kept = run.kept.get(LOG)
        if run.marks or kept is None:
            continue
        path = out / kept
        if not path.is_file():
            continue
        log = read_table(path)
        blocks = increments(log)
        # A log without θ has nothing to draw.
        if not blocks:
            continue
        samples = log["samples"].to_numpy(float)
        error_of_row = log["td_error"].to_numpy(float)
        updates = log["updates"].to_numpy(float)
        td_error = td_error_mean(samples, error_of_row, updates)
        drawn = parameters_figure(samples, blocks, td_error, width=style.SCREEN)
        yield f"parameters-{path.stem}", drawn


def increments(log: pd.DataFrame) -> dict[str, Array]:
    """θ less its first row by block, (K, entries), of a training's log of K rows."""
    theta = log.filter(like=THETA_PREFIX).astype(float)
    changes = theta - theta.iloc[0]
    # A column is called `theta BLOCK[i,j]`.
    entries = changes.columns.str.removeprefix(THETA_PREFIX)
    block_of_column = entries.str.split("[").str[0]
    by_block = {}
    for block in block_of_column.unique():
        is_of_block = block_of_column == block
        by_block[block] = changes.loc[:, is_of_block].to_numpy()
    return by_block
