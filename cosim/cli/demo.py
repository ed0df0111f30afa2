"""`cosim demo`: what the benchmark is about, in some seconds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cosim.cli.options import JsonOption, OutOption, SeedOption, StepsOption, count
from cosim.cli.output import Output, dump, open_folder, output

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from cosim.protocols import Controller
    from cosim.scenario import Scenario
    from cosim.trajectory import Trajectory
    from learning.log import LogRow
    from learning.training import Training

SCENARIO = "fouled"
LEARNT, BACKED_OFF, OPTIMAL = "learnt", "tuned + back-off", "optimal"
BACKOFF_SAMPLES = 8000
RUNS = 10
"""Runs of the comparison; the first is drawn and recorded."""


def demo(
    samples: Annotated[
        int, count("--samples", least=1000, most=1_000_000, text="Plant samples of learning.")
    ] = 20_000,
    steps: StepsOption = 500,
    seed: SeedOption = 0,
    out: OutOption = Path("cosim-demo"),
    json: JsonOption = False,
) -> None:
    """Let a controller whose model is wrong learn from its plant, and compare it.

    The condenser of the evaporator is fouled and no controller is told. Writes demo.csv,
    before-after.png, demo.rrd, summary.json, and of the training learning.csv, learning.png,
    training.rrd, parameters.toml and scenario.toml.
    """
    with output(json) as out_:
        from cosim.figures import overlay_figure, save
        from cosim.files import write_atomically
        from cosim.scenario import Scenario

        scenario = Scenario.load(SCENARIO)
        folder = open_folder(out)
        out_.note(scenario.description)
        backed_off = _train(scenario, "backoff", "tuned", BACKOFF_SAMPLES, seed, out_)
        settings = {"rule": "q-learning"}
        learnt = _train(scenario, "search", "naive", samples, seed, out_, settings)
        trained = {BACKED_OFF: backed_off, LEARNT: learnt}
        runs = _simulate(scenario, _controllers(scenario, trained), steps, seed, out_)
        rows = _table(runs, trained)
        _show(rows, scenario, steps, out_)
        shown = {name: runs[name][0] for name in ("naive", LEARNT, OPTIMAL)}
        save(overlay_figure(shown), folder / "before-after.png")
        learnt.save(folder)
        _record(folder, shown, learnt, rows)
        write_atomically(folder / "demo.csv", _csv(rows))
        summary: dict[str, Any] = {
            "scenario": scenario.name,
            "steps": steps,
            "seed": seed,
            "controllers": rows,
            "training": learnt.summary(),
        }
        write_atomically(folder / "summary.json", dump(summary))
        out_.note(
            f"pictures   {folder / 'before-after.png'}, {folder / 'learning.png'}\n"
            f"recordings {folder / 'demo.rrd'}, {folder / 'training.rrd'}   "
            f"(look at them with: cosim view {folder}/demo.rrd)\n"
            f"learnt θ   {folder / 'parameters.toml'}   (a controller's name in every command)"
        )
        out_.json(summary | {"out": str(out)})


def _train(
    scenario: Scenario,
    algorithm: str,
    start: str,
    samples: int,
    seed: int,
    output: Output,
    settings: Mapping[str, Any] = {},
) -> Training:
    from learning.training import train

    every = max(1, samples // 10)
    with output.progress(f"{algorithm} from {start}", samples) as progress:
        return train(
            algorithm,
            scenario,
            samples,
            settings=settings,
            seed=seed,
            start=start,
            progress=_remark(scenario, progress),
            log_every=every,
            evaluate_every=every,
            checkpoint_every=every,
        )


def _remark(scenario: Scenario, progress: Any) -> Callable[[int, LogRow], None]:
    """Behind the bar: regret, and how far θ keeps the states from their lower bounds."""
    from math import isnan

    def update(done: int, row: LogRow) -> None:
        bounds = zip(scenario.plant.states, row.parameters["x_l"], strict=True)
        kept = " ".join(f"{name} ≥ {bound:.2f}" for name, bound in bounds)
        regret = row["regret"]
        progress(done, kept if isnan(regret) else f"regret {100 * regret:.2f} %  θ: {kept}")

    return update


def _controllers(scenario: Scenario, trained: Mapping[str, Training]) -> dict[str, Controller]:
    from cosim.plugins import build_controller

    learnt: dict[str, Controller] = {name: one.controller() for name, one in trained.items()}
    return {
        "naive": build_controller("naive", scenario),
        **learnt,
        OPTIMAL: build_controller("optimal", scenario),
    }


def _simulate(
    scenario: Scenario,
    controllers: Mapping[str, Controller],
    steps: int,
    seed: int,
    output: Output,
) -> dict[str, list[Trajectory]]:
    """Run each controller `RUNS` times on the same disturbances, which no training met."""
    from cosim.plant import FmuPlant
    from cosim.simulation import simulate
    from learning.evaluation import HELD_OUT

    runs = {}
    with FmuPlant(scenario) as plant, output.progress("comparison", len(controllers)) as progress:
        for count, (name, controller) in enumerate(controllers.items(), 1):
            first = 2 * HELD_OUT + seed
            seeds = range(first, first + RUNS)
            runs[name] = [simulate(plant, controller, steps, number) for number in seeds]
            progress(count, name)
    return runs


def _table(
    runs: Mapping[str, list[Trajectory]], trained: Mapping[str, Training]
) -> list[dict[str, Any]]:
    """A row per controller: what it cost to learn and what it costs to run."""
    import numpy as np

    from cosim.statistics import regret

    figures = {name: [run.summary() for run in each] for name, each in runs.items()}
    costs = {name: np.array([run["J"] for run in each]) for name, each in figures.items()}
    rows = []
    for name, each in figures.items():
        beyond = regret(costs[name], costs[OPTIMAL])
        means = {
            key: float(np.mean([run[key] for run in each]))
            for key in ("J", "economic_cost", "violating_share")
        }
        rows.append(
            {
                "controller": name,
                "plant_samples": trained[name].plant_samples if name in trained else 0,
                "regret": beyond.value,
                "regret_interval": None if name == OPTIMAL else beyond.t,
                **means,
                "failures": sum(run["failures"] for run in each),
            }
        )
    return rows


def _show(rows: list[dict[str, Any]], scenario: Scenario, steps: int, output: Output) -> None:
    from cosim.statistics import shown

    output.table(
        f"{scenario.name}, {RUNS} runs of {steps} samples, the same disturbances for all",
        ("controller", "plant samples", "J", "regret %", "economic cost", "violating %"),
        [
            (
                row["controller"],
                str(row["plant_samples"]),
                f"{row['J']:.1f}",
                shown(row["regret"], row["regret_interval"], 100, 3),
                f"{row['economic_cost']:.1f}",
                f"{100 * row['violating_share']:.1f}",
            )
            for row in rows
        ],
    )


def _csv(rows: list[dict[str, Any]]) -> str:
    from cosim.text_tables import cell, csv_text

    columns = [name for name in rows[0] if name != "regret_interval"]
    return csv_text(columns, ([cell(row[name]) for name in columns] for row in rows))


def _record(
    folder: Path, runs: Mapping[str, Trajectory], learnt: Training, rows: list[dict[str, Any]]
) -> None:
    from cosim.cli.train import record_training
    from cosim.comparison import RunSignals
    from cosim.recording import record_overlay

    scenario = learnt.run.scenario
    lines = [
        f"| {row['controller']} | {row['J']:.1f} | {100 * row['regret']:.2f} | "
        f"{100 * row['violating_share']:.1f} |"
        for row in rows
    ]
    about = "\n".join(
        [
            f"# {learnt.run.algorithm} on {scenario.name}",
            "",
            scenario.description,
            "",
            "| controller | J | regret % | violating % |",
            "|---|---|---|---|",
            *lines,
        ]
    )
    signals = {
        name: RunSignals(name, run.signals, run.status, scenario.limits)
        for name, run in runs.items()
    }
    record_overlay(folder / "demo.rrd", signals, about)
    record_training(folder / "training.rrd", learnt)
