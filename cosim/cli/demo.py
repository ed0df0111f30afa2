"""`cosim demo`: a training, and its θ beside naive, tuned and optimal control, in seconds."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

import cosim
from cosim.cli import output as cli

SCENARIO = "fouled"
LEARNED = "learned"
BACKED_OFF = "tuned + back-off"
BACK_OFF_SAMPLES = 8000
COMPARED_RUNS = 10
"""Runs of the comparison; the first is drawn and recorded."""


def demo(
    samples: Annotated[int, typer.Option(min=1000, max=1_000_000)] = 20_000,
    steps: cli.StepsOption = 500,
    seed: cli.SeedOption = 0,
    out: cli.OutOption = Path("cosim-demo"),
    json: cli.JsonOption = False,
) -> None:
    """Let a controller whose model is wrong learn from its plant, and compare it.

    The condenser of the evaporator is fouled and no controller is told. Writes
    evaluation.csv, evaluation.png, timing.csv, summary.json, before-after.png, demo.rrd, and of the
    training learning.csv, learning.png, training.rrd, parameters.toml and scenario.toml.

    Args:
        samples: Plant samples of learning.
    """
    with cli.output(json) as out_:
        from cosim.cli.evaluate import show_evaluation
        from cosim.core.files import staged, temporary_folder
        from cosim.core.training_options import HELD_OUT
        from cosim.core.trajectory import RunSignals
        from cosim.figures.style import save
        from cosim.figures.trajectory import overlay_figure
        from cosim.recording import record_overlay, record_training

        scenario = cosim.Scenario.load(SCENARIO)
        folder = cli.open_folder(out)
        out_.note(scenario.description)
        trained = {}
        # The search of a back-off takes no more samples, however long the other learns.
        for name, rule, number in (
            (BACKED_OFF, "backoff", BACK_OFF_SAMPLES),
            (LEARNED, "q-learning", samples),
        ):
            # Ten points of the learning curve.
            every = max(1, number // 10)
            trained[name] = cosim.train(
                rule,
                SCENARIO,
                number,
                seed=seed,
                start="tuned",
                log_every=every,
                evaluate_every=every,
                checkpoint_every=every,
                progress=out_.live,
            )
        # Noise that no training met.
        first = 2 * HELD_OUT + seed
        runs = {}
        signals = {}
        with temporary_folder("cosim-demo-") as work, cosim.FmuPlant(scenario) as plant:
            # In the order of the table.
            named = {"naive": "naive", BACKED_OFF: "", LEARNED: "", "optimal": "optimal"}
            for name, training in trained.items():
                file = work / f"{training.run.algorithm}.toml"
                named[name] = str(training.parameters.save(file))
            seeds = range(first, first + COMPARED_RUNS)
            evaluation = cosim.evaluate(scenario, named, seeds, steps, progress=out_.live)
            for name in ("naive", LEARNED, "optimal"):
                controller = cosim.build_controller(named[name], scenario)
                run = cosim.simulate(plant, controller, steps, first)
                runs[name] = run
                signals[name] = RunSignals(name, run.signals, run.status, scenario.limits)
        summary = evaluation.summary() | {"training": trained[LEARNED].summary()}
        with staged(folder) as stage:
            evaluation.write_files(stage)
            save(overlay_figure(runs), stage / "before-after.png")
            trained[LEARNED].write_files(stage)
            record_overlay(stage / "demo.rrd", signals, scenario.description)
            record_training(stage / "training.rrd", trained[LEARNED])
            cli.write_summary(stage, summary)
        show_evaluation(summary, out_)
        # `make demo` activates no environment.
        command = "cosim" if shutil.which("cosim") else f"{sys.executable} -m cosim"
        out_.note(
            f"pictures   {folder / 'before-after.png'}, {folder / 'learning.png'}\n"
            f"recordings {folder / 'demo.rrd'}, {folder / 'training.rrd'}\n"
            f"learned θ   {folder / 'parameters.toml'} (a controller in every command)\n"
            f"look at the recording with: {command} view {folder / 'demo.rrd'}"
        )
        out_.json(summary)
