"""`cosim demo`: what the benchmark is about, in some seconds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cosim.cli import output as cli

if TYPE_CHECKING:
    from learning.training import Training

SCENARIO = "fouled"
NAIVE, LEARNT, BACKED_OFF, OPTIMAL = "naive", "learnt", "tuned + back-off", "optimal"
BACKOFF_SAMPLES = 8000
RUNS = 10
"""Runs of the comparison; the first is drawn and recorded."""


def demo(
    samples: Annotated[
        int, cli.count("--samples", least=1000, most=1_000_000, text="Plant samples of learning.")
    ] = 20_000,
    steps: cli.StepsOption = 500,
    seed: cli.SeedOption = 0,
    out: cli.OutOption = Path("cosim-demo"),
    json: cli.JsonOption = False,
) -> None:
    """Let a controller whose model is wrong learn from its plant, and compare it.

    The condenser of the evaporator is fouled and no controller is told. Writes demo.csv,
    before-after.png, demo.rrd, summary.json, and of the training learning.csv, learning.png,
    training.rrd, parameters.toml and scenario.toml.
    """
    with cli.output(json) as out_:
        import pandas

        from cosim.cli.train import record_training
        from cosim.comparison import RunSignals
        from cosim.evaluation import evaluate
        from cosim.figures import overlay_figure, save
        from cosim.files import temporary_folder, write_atomically
        from cosim.plant import FmuPlant
        from cosim.plugins import build_controller
        from cosim.recording import record_overlay
        from cosim.scenario import Scenario
        from cosim.simulation import simulate
        from cosim.statistics import shown
        from cosim.text_tables import markdown_table
        from learning.training import HELD_OUT

        scenario = Scenario.load(SCENARIO)
        folder = cli.open_folder(out)
        out_.note(scenario.description)
        trained = {
            BACKED_OFF: _train("backoff", "tuned", BACKOFF_SAMPLES, seed, {}, out_),
            LEARNT: _train("search", "naive", samples, seed, {"rule": "q-learning"}, out_),
        }
        first = 2 * HELD_OUT + seed  # noise that no training met
        with temporary_folder("cosim-demo-") as work, FmuPlant(scenario) as plant:
            named = {NAIVE: NAIVE, BACKED_OFF: "", LEARNT: "", OPTIMAL: OPTIMAL}
            for name, training in trained.items():
                named[name] = str(training.parameters.save(work / f"{training.run.algorithm}.toml"))
            total = len(named) * RUNS * steps
            with out_.progress("samples of the comparison", total) as progress:
                seeds = range(first, first + RUNS)
                found = evaluate(scenario, named, seeds, steps, progress=progress)
            runs = {
                name: simulate(plant, build_controller(named[name], scenario), steps, first)
                for name in (NAIVE, LEARNT, OPTIMAL)
            }
        rows: list[dict[str, Any]] = [
            {
                "controller": name,
                "plant_samples": trained[name].plant_samples if name in trained else 0,
                **{key: row[key] for key in ("J", "economic_cost", "violating_share", "failures")},
                "regret": row["regret"]["value"],
                "regret_interval": None if name == OPTIMAL else row["regret"]["t"],
            }
            for name, row in found.summary()["controllers"].items()
        ]
        title = f"{SCENARIO}, {RUNS} runs of {steps} samples, the same disturbances for all"
        header = ("controller", "plant samples", "J", "regret %", "economic cost", "violating %")
        cells = [
            (
                row["controller"],
                str(row["plant_samples"]),
                f"{row['J']:.1f}",
                shown(row["regret"], row["regret_interval"], 100, 3),
                f"{row['economic_cost']:.1f}",
                f"{100 * row['violating_share']:.1f}",
            )
            for row in rows
        ]
        out_.table(title, header, cells)
        save(overlay_figure(runs), folder / "before-after.png")
        trained[LEARNT].save(folder)
        about = f"# {title}\n\n{scenario.description}\n\n{markdown_table(header, cells)}"
        signals = {
            name: RunSignals(name, run.signals, run.status, scenario.limits)
            for name, run in runs.items()
        }
        record_overlay(folder / "demo.rrd", signals, about)
        record_training(folder / "training.rrd", trained[LEARNT])
        flat = pandas.DataFrame(rows).drop(columns="regret_interval")
        write_atomically(folder / "demo.csv", flat.to_csv(index=False, lineterminator="\n"))
        out_.note(
            f"pictures   {folder / 'before-after.png'}, {folder / 'learning.png'}\n"
            f"recordings {folder / 'demo.rrd'}, {folder / 'training.rrd'}   "
            f"(look at them with: cosim view {folder / 'demo.rrd'})\n"
            f"learnt θ   {folder / 'parameters.toml'}   (a controller's name in every command)"
        )
        summary = {
            "scenario": SCENARIO,
            "steps": steps,
            "seed": seed,
            "controllers": rows,
            "training": trained[LEARNT].summary(),
        }
        out_.json(summary, folder)


def _train(
    algorithm: str, start: str, samples: int, seed: int, settings: dict[str, Any], out_: cli.Output
) -> Training:
    from cosim.cli.train import remark
    from learning.training import train

    every = max(1, samples // 10)
    with out_.progress(f"{algorithm} from {start}", samples) as progress:
        return train(
            algorithm,
            SCENARIO,
            samples,
            settings=settings,
            seed=seed,
            start=start,
            progress=remark(progress),
            log_every=every,
            evaluate_every=every,
            checkpoint_every=every,
        )
