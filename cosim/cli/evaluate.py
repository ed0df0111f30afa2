"""`cosim evaluate`: controllers × seeds on common random numbers."""

from __future__ import annotations

import shlex
from itertools import compress
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

import cosim
from cosim.cli import output as cli
from cosim.core.files import staged, write_atomically


def evaluate(
    controllers: Annotated[list[str], typer.Option("--controllers", "-c")] = ["naive"],  # noqa: B006
    scenario: cli.ScenarioOption = "paper",
    seeds: Annotated[int, typer.Option(min=1, max=1_000_000)] = 100,
    first_seed: Annotated[int, typer.Option(min=0)] = 0,
    steps: cli.StepsOption = 2500,
    out: cli.OutOption = Path("cosim-evaluation"),
    trajectories: Path | None = None,
    jobs: cli.JobsOption = None,
    scheduler: cli.SchedulerOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Compare controllers on the same disturbances, seed by seed.

    Writes evaluation.csv (a row per controller and seed), evaluation.png, summary.json, timing.csv
    and scenario.toml, together at the end. Every run is computed anew.

    Args:
        controllers: Comma-separated, or the option again: naive, tuned, backed-off, cautious,
            lqr, pi, converged, optimal, a parameters file or module:factory; NAME=… gives one
            another name.
        seeds: Number of seeds.
        first_seed: The first seed.
        trajectories: In place of controllers: judge a folder of loops that another tool ran, one
            CSV file a seed (run-7.csv) with the states and the actions applied.
    """
    with cli.output(json) as out_:
        from cosim.evaluation import EVALUATION_FILES, named_controllers

        task = cosim.Scenario.load(scenario)
        if trajectories is not None:
            _evaluate_trajectories(task, trajectories, cli.open_folder(out), out_)
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
        folder = cli.open_folder(out)
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
        with staged(folder, EVALUATION_FILES) as stage:
            evaluation.write_files(stage)
            cli.write_summary(stage, summary)
        show_evaluation(summary, out_)
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
    from cosim.evaluation import EVALUATION_FILES, judge

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
    # The files of another evaluation in the folder go: they are of other runs.
    with staged(folder, EVALUATION_FILES) as stage:
        text = table.to_csv(index=False)
        write_atomically(stage / "judged.csv", text)
        cli.write_summary(stage, summary)
    header = ("file", "seed", "steps", "J", "regret %")
    output.table("judged runs", header, rows)
    output.json(summary)


def show_evaluation(summary: dict[str, Any], output: cli.Output) -> None:
    """Print the table of controllers and the paired comparisons.

    Args:
        summary: `Evaluation.summary`.
        output: of the command.
    """
    from cosim.core.statistics import shown

    header = (
        "controller", "J", "regret %", "economic cost", "violating %", "failures", "step µs",
    )  # fmt: skip
    rows = []
    for name, row in summary["controllers"].items():
        timing = summary["timing"][name]
        # What the controller takes of a sample; the plant's time is no merit of it.
        step = timing["prepare_median_us"] + timing["feedback_median_us"]
        cells = (
            name,
            shown(row["J"], digits=6),
            _interval(row.get("regret"), 100.0),
            shown(row["economic_cost"], digits=6),
            f"{100 * row['violating_share']:.2f}",
            str(row["failures"]),
            f"{step:.0f}",
        )
        rows.append(cells)
    # A column that is known of no controller is left out.
    known = [any(column) for column in zip(*rows, strict=True)]
    titles = list(compress(header, known))
    lines = [list(compress(row, known)) for row in rows]
    n_seeds = len(summary["seeds"])
    title = f"{summary['scenario']}, {summary['steps']} samples × {n_seeds} seeds"
    output.table(title, titles, lines)
    if "remark" in summary:
        output.note(summary["remark"])
    if summary["optimum"] is not None:
        output.note(
            "regret = (J − J*)/|J*|, paired over seeds, 95 %; J* on these seeds is "
            f"{shown(summary['optimal_J'], digits=6)}"
        )
    pairs = []
    for comparison in summary["comparisons"]:
        pair = f"{comparison['controller']} − {comparison['reference']}"
        difference = _interval(comparison["differences"]["J"])
        gain = _interval(comparison["gain_in_J"], 100.0)
        pairs.append((pair, difference, gain))
    if pairs:
        output.table(
            "paired comparisons (95 % interval over seeds)",
            ("controller against reference", "ΔJ", "gain in J %"),
            pairs,
        )


def _interval(estimate: dict[str, Any] | None, scale: float = 1.0) -> str:
    """An estimate of a summary with its interval; empty where it is undefined."""
    from cosim.core.statistics import shown

    if estimate is None or not isfinite(estimate["value"]):
        return ""
    return shown(estimate["value"], estimate["interval"], scale, 3)
