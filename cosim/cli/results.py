"""`cosim results`: check the stored results, or make them anew."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli.output import JsonOption, output

if TYPE_CHECKING:
    from cosim.results.figures import Policy

app = typer.Typer(help="Check the stored results, or make them anew.", no_args_is_help=True)

NamesArgument = Annotated[
    list[str] | None, typer.Argument(help="Experiments; default: all that apply.")
]
FolderOption = Annotated[
    Path, typer.Option("--results", help="Folder with experiments.toml and tolerances.toml.")
]
StoredOption = Annotated[
    Path | None,
    typer.Option(
        "--results",
        help="Folder with experiments.toml and tolerances.toml; default: ./results, else the "
        "installed ones.",
        show_default=False,
    ),
]
WORK = ".work"


@app.callback()
def results() -> None:
    """Check the stored results, or make them anew."""


@app.command()
def check(
    names: NamesArgument = None,
    folder: StoredOption = None,
    json: JsonOption = False,
) -> None:
    """Recompute the quick experiments and compare with the stored tables.

    Exit code 1 where a signal differs by more than its tolerance, with the first row that differs;
    2 where a stored table is missing or damaged. Writes nothing.
    """
    with output(json) as out_:
        import tempfile

        from cosim.cli.inner import run_command
        from cosim.results.check import differences, stored_table
        from cosim.results.experiments import (
            chosen,
            load_experiments,
            load_tolerances,
            stored_results,
        )
        from cosim.results.making import compute

        folder = folder or (Path("results") if Path("results").is_dir() else stored_results())
        experiments, tolerances = load_experiments(folder), load_tolerances(folder)
        wanted = chosen(experiments, names) if names else experiments
        stored = {name: stored_table(folder, name, item) for name, item in wanted.items()}
        found: dict[str, list[str]] = {}
        quick = [name for name, item in wanted.items() if item.quick or names]
        with tempfile.TemporaryDirectory(prefix="cosim-results-") as work:
            for name in quick:
                out_.note(f"{name} …")
                now, _ = compute(name, wanted[name], run_command, _root(folder), Path(work))
                found[name] = differences(name, stored[name], now, tolerances)
        rows = [(name, str(len(stored[name].rows)), _verdict(found.get(name))) for name in wanted]
        out_.table("stored results", ("experiment", "rows", "verdict"), rows)
        for lines in found.values():
            for line in lines:
                out_.note(line)
        out_.json({"same": not any(found.values()), "differences": found})
    if any(found.values()):
        raise typer.Exit(1)


@app.command()
def update(
    names: NamesArgument = None,
    folder: FolderOption = Path("results"),
    json: JsonOption = False,
) -> None:
    """Run experiments and store their tables, files, figures and the folder's README.

    What long runs have finished is kept in the folder's `.work`; run again to go on.
    """
    with output(json) as out_:
        from cosim.cli.inner import run_command
        from cosim.results.experiments import chosen, load_experiments
        from cosim.results.making import compute, store
        from cosim.results.readme import write_readme

        experiments = load_experiments(folder)
        wanted = chosen(experiments, names) if names else experiments
        for name, experiment in wanted.items():
            out_.note(f"{name} …")
            table, runs = compute(name, experiment, run_command, _root(folder), folder / WORK)
            store(folder, name, experiment, table, runs, _policy())
        write_readme(folder, experiments)
        out_.note(f"stored {', '.join(wanted)} in {folder.resolve()}")
        out_.json({"updated": list(wanted)})


def _root(folder: Path) -> Path:
    """Commands are run from the folder that holds the results, as a user would run them."""
    return folder.resolve().parent


def _verdict(lines: list[str] | None) -> str:
    if lines is None:
        return "stored, not recomputed"
    return "differs" if lines else "same"


def _policy() -> Policy:
    import json

    import numpy as np

    from cosim.lookup import build_controller
    from cosim.scenario import Scenario

    def policy(run: Path) -> Any:
        name = json.loads((run / "summary.json").read_text("utf-8"))["controller"]
        controller = build_controller(name, Scenario.load(run / "scenario.toml"))

        def act(s: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
            controller.reset()
            # One QP from a cold guess is not the policy: let a real-time iteration settle.
            for _ in range(5):
                controller.prepare()
                action = controller.feedback(s).action
            return action

        return act

    return policy
