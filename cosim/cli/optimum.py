"""`cosim optimum`: the best that any controller can do on a scenario."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli.options import JsonOption, ScenarioOption
from cosim.cli.output import Output, output

if TYPE_CHECKING:
    from controllers.dynamic_programming.certificate import Certificate, Figure
    from controllers.dynamic_programming.solution import Optimum, Progress
    from controllers.dynamic_programming.study import Row
    from cosim.scenario import Scenario

UNSTABLE = 1


class Criterion(StrEnum):
    """What the policy minimises."""

    AVERAGE = "average"
    DISCOUNTED = "discounted"


# Bounds of J* itself, or of how far the optimal value may lie from the one found.
_BOUNDS = {
    Criterion.AVERAGE: ("J* ≥", "J* ≤"),
    Criterion.DISCOUNTED: ("(1-γ)(V*-V) ≥", "(1-γ)(V*-V) ≤"),
}


def optimum(
    scenario: ScenarioOption = "paper",
    criterion: Annotated[
        Criterion,
        typer.Option("--criterion", help="Mean cost per sample, or cost discounted by γ."),
    ] = Criterion.AVERAGE,
    refine: Annotated[
        bool,
        typer.Option(
            "--refine",
            help="Solve, refine grid and quadrature, simulate the policy; keep the certificate.",
        ),
    ] = False,
    against: Annotated[
        Path | None,
        typer.Option(
            "--against",
            help="With --refine: a policy search's θ, compared with the policy on the same noise.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    recompute: Annotated[
        bool, typer.Option("--recompute", help="Solve even if the policy is stored.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Mean cost per sample J* of the optimal policy, by dynamic programming, with its bounds.

    The policy is stored and serves as controller `optimal`. It is called J* where solution,
    refinement and long simulation agree within 0.05 % and no policy search is below; else
    it is a reference, printed with its spread. With --refine, exit code 1 where they do not agree.
    A plant that fouls has the quasi-static reference: J* along its heat transfer.
    """
    from controllers.quasi_static import Fouling
    from cosim.cli.compose import load_scenario

    with output(json) as out_:
        task = load_scenario(scenario)
        if Fouling.of(task) is not None:
            _quasi_static(task, out_)
            return
        rows, certificate, document = _solve(
            task, scenario, criterion, refine, against, recompute, out_
        )
        header = ("", "J", *_BOUNDS[criterion], "states", "nodes", "penalty nodes", "change")
        cells = [_cells(row) for row in rows]
        out_.table(f"{document['kind']} of {scenario}, {criterion} criterion", header, cells)
        if certificate is not None:
            figures = [_figure_cells(figure) for figure in certificate.figures]
            out_.table("certificate", ("", "J", "from", "to"), figures)
        if document["objection"] is not None:
            out_.note(f"not called J*: {document['objection']}")
        out_.json(document)
    if refine and not document["stable"]:
        raise typer.Exit(UNSTABLE)


def _quasi_static(task: Scenario, out_: Output) -> None:
    from controllers.quasi_static import QuasiStaticPolicy

    with _progress(out_) as show:
        policy = QuasiStaticPolicy.from_scenario(task, progress=show)
    out_.table(
        f"quasi-static reference of {task.name}: a reference, not a bound",
        ("UA2", "J*"),
        [(f"{value:.4f}", f"{gain:.4f}") for value, gain in policy.gains]
        + [("mean over a cycle", f"{policy.gain:.4f}")],
    )
    out_.json(
        {
            "scenario": task.name,
            "criterion": "average",
            "kind": "reference",
            "objection": "quasi-static: J* along UA2(t), no bound",
            "J": policy.gain,
            "table": [{"UA2": value, "J": gain} for value, gain in policy.gains],
        }
    )


def _solve(
    task: Scenario,
    name: str,
    criterion: Criterion,
    refine: bool,
    against: Path | None,
    recompute: bool,
    out_: Output,
) -> tuple[list[Row], Certificate | None, dict[str, Any]]:
    from controllers.dynamic_programming import archive
    from controllers.dynamic_programming.plant import PlantProblem
    from controllers.dynamic_programming.settings import Settings
    from controllers.dynamic_programming.solution import solve
    from controllers.dynamic_programming.study import Row
    from cosim.cli.optimum_study import held_against, refined

    plant = PlantProblem.from_scenario(task)
    settings = Settings(criterion=criterion.value)
    key = archive.key(plant, settings)
    with _progress(out_) as show:

        def make() -> Optimum:
            return solve(plant, settings, progress=show)

        if refine:
            archive.require_cache()
            rows, solved = refined(plant, settings, make(), show)
            if against is not None:
                solved = held_against(against, solved, plant, task)
            archive.keep(key, lambda: solved)
        else:
            solved = (
                archive.keep(key, make) if recompute else archive.obtain(key, plant.problem, make)
            )
            rows = [Row("stored" if solved.certificate else "solution", solved)]
    certificate = solved.certificate
    objection = "no certificate; make one with --refine"
    if criterion is Criterion.DISCOUNTED:
        objection = "its mean cost need not be the least"
    document = {
        "scenario": name,
        "criterion": criterion.value,
        "kind": "",
        "objection": certificate.objection() if certificate else objection,
        "J": solved.gain,
        "lower": solved.lower,
        "upper": solved.upper,
        "edge_mass": solved.edge_mass,
        "file": str(archive.stored(key)),
        "stable": all(row.stable for row in rows[-2:]),
        "certificate": certificate.to_list() if certificate else None,
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
    called = document["objection"] is None
    document["kind"] = "optimum" if called else "reference"
    document["stable"] = document["stable"] and (called or criterion is Criterion.DISCOUNTED)
    return rows, certificate, document


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


def _figure_cells(figure: Figure) -> tuple[str, ...]:
    return (figure.name, f"{figure.value:.2f}", f"{figure.lower:.2f}", f"{figure.upper:.2f}")


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
