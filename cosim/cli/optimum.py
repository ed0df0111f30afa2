"""`cosim optimum`: the best that any controller can do on a scenario."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli.output import JsonOption, Output, output
from cosim.cli.simulate import ScenarioOption

if TYPE_CHECKING:
    from controllers.dynamic_programming.solution import Progress
    from controllers.dynamic_programming.study import Row

UNSTABLE = 1


class Criterion(StrEnum):
    """What the policy minimises."""

    AVERAGE = "average"
    DISCOUNTED = "discounted"


# Bounds of J* itself, or of how far the optimal value may lie from the one found.
_BOUNDS = {
    Criterion.AVERAGE: ("J* above", "J* below"),
    Criterion.DISCOUNTED: ("(1-γ)(V*-V) above", "below"),
}


def optimum(
    scenario: ScenarioOption = "paper",
    criterion: Annotated[
        Criterion,
        typer.Option("--criterion", help="Mean cost per sample, or cost discounted by γ."),
    ] = Criterion.AVERAGE,
    refine: Annotated[
        bool,
        typer.Option("--refine", help="Refine grid and quadrature until J* is stable to 0.1 %."),
    ] = False,
    recompute: Annotated[
        bool, typer.Option("--recompute", help="Solve even if the policy is stored.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Mean cost per sample J* of the optimal policy, by dynamic programming, with its bounds.

    The policy is stored and serves as controller `optimal`. With --refine, exit code 1 if J* is
    not stable.
    """
    with output(json) as out_:
        rows, document = _solve(scenario, criterion, refine, recompute, out_)
        header = ("", "J", *_BOUNDS[criterion], "states", "nodes", "penalty nodes", "change")
        out_.table(
            f"optimum of {scenario}, {criterion} criterion", header, [_cells(row) for row in rows]
        )
        out_.json(document)
    if not document["stable"]:
        raise typer.Exit(UNSTABLE)


def _solve(
    name: str, criterion: Criterion, refine: bool, recompute: bool, out_: Output
) -> tuple[list[Row], dict[str, Any]]:

    from controllers.dynamic_programming import archive
    from controllers.dynamic_programming.plant import (
        plant_law,
        plant_parameters,
    )
    from controllers.dynamic_programming.settings import Settings
    from controllers.dynamic_programming.solution import solve
    from controllers.dynamic_programming.study import Row, study
    from controllers.problem import Problem
    from cosim.cli.compose import load_scenario

    scenario = load_scenario(name)
    problem = Problem.from_scenario(scenario)
    law, parameters = plant_law(scenario, problem), plant_parameters(scenario, problem)
    settings = Settings(criterion=criterion.value)
    key = archive.key(problem, law, parameters, settings)
    with _progress(out_) as show:
        solved = (archive.renew if recompute else archive.obtain)(
            key, lambda: solve(problem, law, settings, parameters=parameters, progress=show)
        )
        rows = [Row("solution", solved)]
        if refine:
            rows = study(problem, law, settings, solved, parameters=parameters, progress=show)
    stable = all(row.stable for row in rows[-2:])
    document = {
        "scenario": name,
        "criterion": criterion.value,
        "J": solved.gain,
        "lower": solved.lower,
        "upper": solved.upper,
        "edge_mass": solved.edge_mass,
        "file": str(archive.stored(key)),
        "stable": stable,
        "rows": [
            {
                "what": row.what,
                "J": row.optimum.gain,
                "lower": row.optimum.lower,
                "upper": row.optimum.upper,
                "states": row.optimum.grid.shape,
                "accuracy": asdict(row.optimum.accuracy),
                "change": row.change,
            }
            for row in rows
        ],
    }
    return rows, document


def _cells(row: Row) -> tuple[str, ...]:
    found = row.optimum
    return (
        row.what,
        f"{found.gain:.4f}",
        f"{found.lower:.4f}",
        f"{found.upper:.4f}",
        "×".join(map(str, found.grid.shape)),
        "×".join(map(str, found.accuracy.nodes)),
        "×".join(map(str, found.accuracy.penalty_nodes)),
        "" if row.change is None else f"{100 * row.change:.5f} %",
    )


@contextmanager
def _progress(out_: Output) -> Iterator[Callable[[Progress], None]]:
    """Show the round and the closing bounds on standard error."""
    from rich.progress import Progress as Bar
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    console = out_.console()
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    hidden = out_.as_json or not console.is_terminal
    with Bar(*columns, console=console, disable=hidden) as bar:
        task = bar.add_task("dynamic programming", total=None)

        def show(progress: Progress) -> None:
            bar.update(
                task,
                description=(
                    f"grid {progress.level} ({progress.states} states), round {progress.round}: "
                    f"{progress.lower:.1f} ≤ J* ≤ {progress.upper:.1f}"
                ),
            )

        yield show
