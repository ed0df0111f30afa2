"""`cosim reproduce`: the paper's section Simulations in one command."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from cosim.cli.evaluate import JobsOption
from cosim.cli.output import JsonOption, Output, dump, open_folder, output

if TYPE_CHECKING:
    from cosim.cli.training import Training
    from cosim.evaluation import Evaluation
    from cosim.protocols import Controller
    from cosim.reproduction.budget import Budget
    from cosim.reproduction.readings import Reading
    from cosim.scenario import Scenario


class BudgetName(enum.StrEnum):
    """The budgets, for the command line."""

    quick = "quick"
    full = "full"


def reproduce(
    budget: Annotated[
        BudgetName,
        typer.Option(
            "--budget",
            help="Time on 2 cores: quick within 5 minutes; full within 3 hours, with more seeds "
            "and samples, batch Q-learning, all readings of the paper and J* at each.",
        ),
    ] = BudgetName.quick,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path(
        "cosim-reproduction"
    ),
    jobs: JobsOption = None,
    json: JsonOption = False,
) -> None:
    """Train, compare with (a) naive and (b) tuned, with converged NMPC and with the optimum.

    Writes report.md; comparison.csv (the paper's table, with intervals), converged.csv, map.csv
    (the paper's open points), evaluation.csv, summary.json, timing.csv and the paper's figure for
    each learner. Run again with the same --out to go on after an interruption.
    """
    with output(json) as out_:
        from cosim.cli.training import train, trainings
        from cosim.evaluation.parallel import cores, run_all
        from cosim.reproduction.budget import BUDGETS

        folder, sizes, workers = open_folder(out).resolve(), BUDGETS[budget.value], jobs or cores()
        tasks = trainings(sizes, folder)
        status: dict[str, str] = {}
        with out_.progress(f"{len(tasks)} trainings", len(tasks)) as progress:

            def done(key: str, outcome: str) -> None:
                status[key] = outcome
                progress(len(status))

            run_all(train, tasks.items(), done, jobs=workers)
        learned = {key: task.folder / "parameters.toml" for key, task in tasks.items()}
        evaluation = _evaluate(sizes, learned, folder, workers, out_)
        readings = _map(sizes, learned, folder, workers, out_)
        summary = _write(sizes, folder, tasks, status, evaluation, readings)
        _show(summary, out_)
        out_.note(f"report and tables are in {folder}")
        out_.json(summary)


def _evaluate(
    sizes: Budget, learned: Mapping[str, Path], folder: Path, jobs: int, output: Output
) -> Evaluation:
    """Baselines, converged NMPC, the optimum and every learned θ on the scenario `paper`."""
    from cosim.cli.training import trained

    factories: dict[str, Any] = {name: _factory(name) for name in ("naive", "tuned", "converged")}
    factories |= {
        name: _factory(str(learned[name]))
        for learner in sizes.learners
        for name in trained(learner, sizes.training_seeds)
    }
    best = trained(sizes.mapper, 1)[0]
    factories[f"{best}-converged"] = partial(converged_with, str(learned[best]))
    factories["optimal"] = _factory("optimal")
    return _run("paper", factories, sizes, folder, jobs, output)


def _map(
    sizes: Budget, learned: Mapping[str, Path], folder: Path, jobs: int, output: Output
) -> list[tuple[Reading, Evaluation]]:
    from cosim.cli.training import mapped
    from cosim.reproduction.readings import readings
    from cosim.scenario import Scenario

    paper = Scenario.load("paper")
    evaluations = []
    for reading in readings(sizes.factorial):
        factories: dict[str, Any] = {name: _factory(name) for name in ("naive", "tuned")}
        factories |= {
            name: _factory(str(learned[key])) for name, key in mapped(sizes, reading).items()
        }
        if sizes.factorial:
            factories["optimal"] = _factory("optimal")
        scenario = reading.scenario(paper)
        evaluations.append((reading, _run(scenario, factories, sizes, folder, jobs, output)))
    return evaluations


def _run(
    scenario: Scenario | str,
    factories: dict[str, Any],
    sizes: Budget,
    folder: Path,
    jobs: int,
    output: Output,
) -> Evaluation:
    from cosim.evaluation import evaluate
    from cosim.reproduction.budget import FIRST_SEED

    name = scenario if isinstance(scenario, str) else scenario.name
    units = len(factories) * (sizes.noise_seeds + 1)
    with output.progress(f"evaluation, {name}", units) as progress:
        return evaluate(
            scenario,
            factories,
            range(FIRST_SEED, FIRST_SEED + sizes.noise_seeds),
            sizes.steps,
            folder=folder,
            jobs=jobs,
            progress=progress,
            command=f"cosim reproduce --budget {sizes.name}",
        )


def _factory(name: str) -> Any:
    from cosim.lookup import build_controller

    return partial(build_controller, name)


def converged_with(path: str, scenario: Scenario) -> Controller:
    """NMPC solved to convergence with θ from a file."""
    from controllers.converged import ConvergedNmpc
    from controllers.parameters import Parameters
    from controllers.problem import Problem

    problem = Problem.from_scenario(cast("Any", scenario))
    backend = scenario.controller.backend
    return ConvergedNmpc(problem, Parameters.load(path, problem), backend=backend)


def _write(
    sizes: Budget,
    folder: Path,
    tasks: Mapping[str, Training],
    status: Mapping[str, str],
    evaluation: Evaluation,
    readings: Sequence[tuple[Reading, Evaluation]],
) -> dict[str, Any]:
    from cosim.cli.training import figure, trained
    from cosim.files import write_atomically
    from cosim.reproduction.comparison import Table, against_converged, rows
    from cosim.reproduction.report import report

    groups = {learner.name: trained(learner, sizes.training_seeds) for learner in sizes.learners}
    comparison, map_ = Table(), Table()
    comparison.add(rows(evaluation, groups))
    on_map = {sizes.mapper.name: trained(sizes.mapper, sizes.map_seeds)}
    for reading, there in readings:
        map_.add(rows(there, on_map), reading.to_dict())
    best = groups[sizes.mapper.name][0]
    pairs = {"naive": "converged", best: f"{best}-converged"}
    converged = against_converged(evaluation, pairs)
    evaluation.write(folder)
    write_atomically(folder / "comparison.csv", comparison.to_csv())
    write_atomically(folder / "map.csv", map_.to_csv())
    write_atomically(folder / "converged.csv", converged.to_csv())
    figures = [figure(tasks[group[0]], folder) for group in groups.values()]
    described = evaluation.summary()
    summary = {
        "budget": sizes.name,
        "comparison": comparison.records,
        "converged": converged.records,
        "map": map_.records,
        "trainings": {
            key: {"command": task.command(), "status": status[key]} for key, task in tasks.items()
        },
        "controllers": described["controllers"],
        "timing": described["timing"],
    }
    write_atomically(folder / "report.md", report(summary, figures))
    write_atomically(folder / "summary.json", dump(summary))
    return summary


def _show(summary: dict[str, Any], output: Output) -> None:
    from cosim.reproduction.report import TABLES, timing_lines

    for title, lines in (*TABLES, ("time per step", timing_lines)):
        header, *body = lines(summary)
        output.table(title, header, body)
