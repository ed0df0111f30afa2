"""`cosim evaluate`: controllers × seeds on common random numbers."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

import cosim
from cosim.cli import output as cli
from cosim.core.errors import CosimError
from cosim.core.files import staged, write_atomically
from cosim.core.run_files import RUN_FILES

PairsOption = Annotated[
    bool, typer.Option("--pairs", help="Print the paired difference of each two controllers too.")
]


def evaluate(
    controllers: Annotated[list[str], typer.Option("--controllers", "-c")] = ["naive"],  # noqa: B006
    scenario: cli.ScenarioOption = "paper",
    seeds: Annotated[int, typer.Option(min=1, max=1_000_000)] = 100,
    first_seed: Annotated[int, typer.Option(min=0)] = 0,
    steps: cli.StepsOption = 2500,
    out: cli.OutOption = Path("cosim-evaluation"),
    trajectories: Path | None = None,
    pairs: PairsOption = False,
    jobs: cli.JobsOption = None,
    scheduler: cli.SchedulerOption = None,
    plot: Annotated[bool, typer.Option("--plot")] = False,
    overwrite: cli.OverwriteOption = False,
    json: cli.JsonOption = False,
) -> None:
    """Compare controllers on the same disturbances, seed by seed.

    Writes evaluation.csv (a row per controller and seed), summary.json, timing.csv, scenario.toml
    and, with --plot, evaluation.png, together at the end.

    Args:
        controllers: Comma-separated, or the option again: naive, tuned, backed-off, cautious,
            lqr, pi, converged, optimal, a parameters file or module:factory; NAME=… gives one
            another name.
        seeds: Number of seeds.
        first_seed: The first seed.
        trajectories: In place of controllers: evaluate the runs of another tool, a folder with a
            CSV file for each seed (run-7.csv) of states and applied actions.
        plot: Draw evaluation.png too.
    """
    with cli.output(json) as out_:
        from cosim.evaluation import PICTURE, named_controllers

        task = cosim.Scenario.load(scenario)
        if trajectories is not None:
            if plot:
                raise CosimError("--plot draws controllers, not the runs of --trajectories")
            folder = cli.open_folder(out, overwrite)
            _evaluate_trajectories(task, trajectories, folder, out_)
            return
        names = []
        for text in controllers:
            for name in text.split(","):
                if name.strip():
                    names.append(name)
        named = named_controllers(names)
        # The command that makes the same numbers anew, for whoever finds the files.
        words = ["cosim", "evaluate"]
        words += ["--scenario", scenario]
        words += ["--controllers", ",".join(names)]
        words += ["--seeds", str(seeds)]
        if first_seed > 0:
            words += ["--first-seed", str(first_seed)]
        words += ["--steps", str(steps)]
        folder = cli.open_folder(out, overwrite)
        out_.announce(task.plant.fmu)
        evaluation = cosim.evaluate(
            task,
            named,
            range(first_seed, first_seed + seeds),
            steps,
            jobs=jobs,
            scheduler=scheduler,
            progress=out_.live,
            command=shlex.join(words),
        )
        summary = evaluation.summary()
        # All files or none: a table and a summary in a folder are of one evaluation.
        with staged(folder, RUN_FILES) as stage:
            evaluation.write_tables(stage)
            if plot:
                evaluation.plot(stage / PICTURE)
            cli.write_summary(stage, summary)
        show_evaluation(summary, out_, pairs)
        out_.note(f"files are in {folder.resolve()}")
        out_.json(summary)


def _evaluate_trajectories(
    scenario: cosim.Scenario,
    trajectories: Path,
    folder: Path,
    output: cli.Output,
) -> None:
    """Recompute the costs of loops that another tool ran; print and write them."""
    from cosim.core.statistics import mean, regret, shown
    from cosim.evaluation import judge

    table = judge(scenario, trajectories)
    cost = table["J"].to_numpy()
    optimum = table["optimum"].to_numpy()
    violating_share = table["violating_share"].mean()
    rows = []
    for run in table.itertuples():
        row = (
            run.file,
            str(run.seed),
            str(run.steps),
            shown(run.J, digits=6),
            f"{100 * run.regret:.3f}",
        )
        rows.append(row)
    summary = {
        "scenario": scenario.name,
        "scenario_hash": scenario.hash,
        "seeds": table["seed"].tolist(),
        "J": mean(cost)._asdict(),
        "regret": regret(cost, optimum)._asdict(),
        "violating_share": float(violating_share),
    }
    # The files of another run in the folder go.
    with staged(folder, RUN_FILES) as stage:
        text = table.to_csv(index=False)
        write_atomically(stage / "judged.csv", text)
        cli.write_summary(stage, summary)
    header = ("file", "seed", "steps", "J", "regret %")
    output.table("judged runs", header, rows)
    output.json(summary)


def show_evaluation(
    summary: dict[str, Any],
    output: cli.Output,
    pairs: bool,
    data: Mapping[str, str] | None = None,
) -> None:
    """Print a row for each controller, within 80 columns.

    Args:
        summary: `Evaluation.summary`.
        output: of the command.
        pairs: whether each pair of controllers is compared in a second table.
        data: what each controller was made from, by its name; None leaves the column out.
    """
    from cosim.core.statistics import shown

    header = ["controller", "regret %", "J", "violating %"]
    rows = []
    for name, row in summary["controllers"].items():
        cells = [
            name,
            _interval(row.get("regret"), 100.0),
            shown(row["J"], digits=6),
            f"{100 * row['violating_share']:.2f}",
        ]
        rows.append(cells)
    n_failures = [row["failures"] for row in summary["controllers"].values()]
    if any(n_failures):
        header.append("failures")
        for cells, number in zip(rows, n_failures, strict=True):
            cells.append(str(number))
    if data is None:
        header.append("economic cost")
        for cells in rows:
            cost = summary["controllers"][cells[0]]["economic_cost"]
            cells.append(shown(cost, digits=6))
    else:
        # It takes the economic cost's room.
        header.insert(1, "data")
        for cells in rows:
            cells.insert(1, data[cells[0]])
    if summary["optimum"] is None:
        column = header.index("regret %")
        for cells in (header, *rows):
            del cells[column]
    n_seeds = len(summary["seeds"])
    title = f"{summary['scenario']}, {summary['steps']} samples × {n_seeds} seeds"
    output.table(title, header, rows)
    if "remark" in summary:
        output.legend(summary["remark"])
    if summary["optimum"] is not None:
        output.legend(
            "regret = (J − J*)/|J*| with its 95 % interval over the seeds; "
            f"J* = {shown(summary['optimal_J'], digits=6)}"
        )
    if pairs:
        _show_pairs(summary, output)


def _show_pairs(summary: dict[str, Any], output: cli.Output) -> None:
    """Print the paired difference of each two controllers."""
    from cosim.core.statistics import shown

    rows = []
    for comparison in summary["comparisons"]:
        difference = _interval(comparison["differences"]["J"])
        # Without an interval: a quotient's of few seeds may leave out zero where that of the
        # difference has it, and the two have the same sign.
        value = comparison["gain_in_J"]["value"]
        gain = shown(value, None, 100.0, 3) if isfinite(value) else ""
        rows.append((comparison["controller"], comparison["reference"], difference, gain))
    header = ("controller", "against", "difference in J", "gain in J %")
    output.table("paired over the seeds, with 95 % intervals of the difference", header, rows)


def _interval(estimate: dict[str, Any] | None, scale: float = 1.0) -> str:
    """An estimate of a summary with its interval; empty where it is undefined."""
    from cosim.core.statistics import shown_estimate

    if estimate is None or not isfinite(estimate["value"]):
        return ""
    # The cost of rare violations is skewed: the bootstrap's interval holds no impossible regret.
    interval = estimate.get("bootstrap") or estimate["interval"]
    return shown_estimate(estimate["value"], interval, scale)
