"""`cosim evaluate`: controllers × seeds on common random numbers."""

from __future__ import annotations

import shlex
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.cli.options import (
    JobsOption,
    JsonOption,
    OutOption,
    ScenarioOption,
    SchedulerOption,
    StepsOption,
    count,
)
from cosim.cli.output import Output, again, dump, open_folder, output, resumable


def evaluate(
    controllers: Annotated[
        str,
        typer.Option(
            "--controllers",
            "-c",
            help="Comma-separated: naive, tuned, converged, optimal, a parameters file or "
            "module:factory; NAME=… gives one another name.",
        ),
    ] = "naive",
    scenario: ScenarioOption = "paper",
    seeds: Annotated[int, count("--seeds", most=1_000_000, text="Number of seeds.")] = 10,
    first_seed: Annotated[int, typer.Option("--first-seed", min=0, help="The first seed.")] = 0,
    steps: StepsOption = 1000,
    out: OutOption = Path("cosim-evaluation"),
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    json: JsonOption = False,
) -> None:
    """Compare controllers on the same disturbances, seed by seed.

    Writes evaluation.csv (a row per controller and seed), evaluation.png, summary.json, timing.csv
    and scenario.toml. Run again with the same --out to go on after an interruption.
    """
    with output(json) as out_:
        from cosim.cli.compose import announce
        from cosim.evaluation import evaluate as run
        from cosim.evaluation.parallel import cores
        from cosim.files import write_atomically
        from cosim.kpis import comes_to_rest
        from cosim.lookup import build_controller
        from cosim.scenario import Scenario
        from learning.evaluation import stored_optimum

        task = Scenario.load(scenario)
        named = named_controllers(controllers)
        options = {"scenario": scenario, "controllers": controllers, "seeds": seeds}
        options |= {"first-seed": first_seed} if first_seed else {}
        folder = open_folder(out).absolute()
        announce(task, out_)
        yardstick = stored_optimum(task)
        optimum = None if yardstick is None else partial(build_controller, yardstick)
        extra = seeds if yardstick is not None and yardstick not in named else 0
        units = len(named) * (seeds + comes_to_rest(task)) + extra
        label = f"{', '.join(named)} on {task.name}"
        with resumable(again), out_.progress(label, units) as progress:
            evaluation = run(
                task,
                {name: partial(build_controller, spec) for name, spec in named.items()},
                range(first_seed, first_seed + seeds),
                steps,
                optimum=optimum,
                folder=folder,
                jobs=jobs or cores(),
                scheduler=scheduler,
                progress=progress,
                command=_command(options | {"steps": steps}),
            )
        summary = evaluation.summary()
        evaluation.write(folder)
        write_atomically(folder / "scenario.toml", task.to_toml())
        write_atomically(folder / "summary.json", dump(summary))
        show(summary, out_)
        out_.note(f"files are in {folder.resolve()}")
        out_.json(summary)


def named_controllers(text: str) -> dict[str, str]:
    """Read `A,B,NAME=SPEC`: what to build, by the name to show; raises EvaluationError."""
    from cosim.errors import EvaluationError

    named: dict[str, str] = {}
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, spec = item.partition("=")
        name, spec = (name.strip(), spec.strip()) if equals else (item, item)
        if not name or not spec:
            raise EvaluationError(f"--controllers: '{item}' is not NAME=CONTROLLER")
        if name in named:
            raise EvaluationError(f"--controllers names '{name}' twice; write NAME=… for one")
        named[name] = spec
    if not named:
        raise EvaluationError("--controllers is empty")
    return named


def _command(options: dict[str, Any]) -> str:
    """The command without what has no bearing on the table: --out, --jobs, --scheduler."""
    words = ["cosim", "evaluate"]
    for name, value in options.items():
        words += [f"--{name}", str(value)]
    return shlex.join(words)


def show(summary: dict[str, Any], output: Output) -> None:
    """Print the table of controllers and the paired comparisons."""
    from cosim.statistics import shown

    title = "{scenario}, {steps} samples × {count} seeds".format(
        **summary, count=len(summary["seeds"])
    )
    controllers = summary["controllers"].items()
    output.table(
        title,
        (
            "controller",
            "economic cost",
            "violation",
            "violating %",
            "J",
            "regret %",
            "gap closed %",
        ),
        [
            (
                name,
                shown(row["economic_cost"], digits=6),
                f"{row['mean_violation']:.5f}",
                f"{100 * row['violating_share']:.2f}",
                shown(row["J"], digits=6),
                percent(row["regret"]) if "regret" in row else "",
                percent(row["gap_closed"], digits=4) if "gap_closed" in row else "",
            )
            for name, row in controllers
        ],
    )
    if summary["optimum"] is not None:
        output.note(
            f"regret = (J − J*)/|J*|, paired over seeds, 95 %; J* on these seeds is "
            f"{shown(summary['optimal_J'], digits=6)}"
        )
    settling = {name: row["settling_time"] for name, row in controllers}
    settles = any(map(isfinite, settling.values()))
    output.table(
        "behaviour",
        (
            "controller",
            "input effort",
            *(["settling time s"] if settles else []),
            "failures",
            "median step µs",
        ),
        [
            (
                name,
                f"{row['input_effort']:.4f}",
                *([_seconds(settling[name])] if settles else []),
                str(row["failures"]),
                f"{_step_time(summary['timing'][name]):.1f}",
            )
            for name, row in controllers
        ],
    )
    if not summary["comparisons"]:
        return
    output.table(
        "paired comparisons (95 % t interval over seeds)",
        ("controller against reference", "ΔJ", "gain in J %"),
        [
            (
                f"{row['controller']} − {row['reference']}",
                interval(row["differences"]["J"]),
                percent(row["gain_in_J"]),
            )
            for row in summary["comparisons"]
        ],
    )


def _seconds(time: float) -> str:
    return f"{time:.0f}" if isfinite(time) else "not settled"


def _step_time(timing: dict[str, Any]) -> float:
    return float(timing["prepare_median_us"] + timing["feedback_median_us"])


def interval(estimate: dict[str, Any], scale: float = 1.0, digits: int = 3) -> str:
    """An estimate of a summary with its t interval; nothing where it is undefined."""
    from cosim.statistics import shown

    if not isfinite(estimate["value"]):
        return ""
    return shown(estimate["value"], estimate["t"], scale, digits)


def percent(estimate: dict[str, Any], digits: int = 3) -> str:
    """An estimate in per cent."""
    return interval(estimate, 100.0, digits)
