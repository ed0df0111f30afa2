"""`cosim demo`: two rules learn on a plant unlike their model; a table of what that gains."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

import cosim
from cosim.cli import output as cli
from cosim.cli.evaluate import PairsOption, show_evaluation

if TYPE_CHECKING:
    from controllers import RtiNmpc
    from cosim.core.trajectory import RunSignals
    from learning.training import Training

SCENARIO = "fouled"
START = "cautious"
"""The untrained controller from which both rules start."""
UNTRAINED = ("naive", "backed-off", START)
LEARNING_RULES = ("q-learning", "model-based")
BEST = "model-based"
"""The rule whose controller is drawn and recorded."""
DAY_SAMPLES = 1440
"""Samples of a day: one a minute."""
COMPARED_RUNS = 10
"""Runs of the comparison; of the first the beginning is drawn and recorded."""
DRAWN = 300
"""Samples that are drawn: of more, lines of four controllers cover each other."""


def demo(
    samples: Annotated[int, typer.Option("--samples", "-n", min=100, max=1_000_000)] = DAY_SAMPLES,
    steps: Annotated[int, cli.count("--steps")] = 1000,
    seed: cli.SeedOption = 0,
    pairs: PairsOption = False,
    out: cli.OutOption = Path("cosim-demo"),
    overwrite: cli.OverwriteOption = False,
    json: cli.JsonOption = False,
) -> None:
    """Let two rules learn on a plant unlike their model, and compare what they learned.

    The condenser of the evaporator is fouled, and no controller knows. Three controllers are not
    trained. Two rules start from one of them, cautious, and learn on the plant. The last
    controller is the optimum, which knows the plant.

    Writes evaluation.csv, evaluation.png, before-after.png, timing.csv, scenario.toml and
    summary.json. The folder of each rule holds its parameters.toml, learning.csv and learning.png.
    With the viewer of recordings installed it writes demo.rrd and each rule's training.rrd too.

    Args:
        samples: Plant samples of learning; default: a day.
        steps: Samples of each run of the comparison.
    """
    with cli.output(json) as out_:
        from cosim.core.files import staged, temporary_folder
        from cosim.core.run_files import RUN_FILES
        from cosim.core.training_options import HELD_OUT
        from cosim.core.trajectory import RunSignals
        from cosim.figures.style import save
        from cosim.figures.trajectory import overlay_figure

        scenario = cosim.Scenario.load(SCENARIO)
        folder = cli.open_folder(out, overwrite)
        out_.note(scenario.description)
        # Noise that no training met.
        first = 2 * HELD_OUT + seed
        runs = {}
        signals = {}
        with temporary_folder("cosim-demo-") as work, cosim.FmuPlant(scenario) as plant:
            # In the order of the table. Their θ as files: to find it takes longer than to run it.
            named = {}
            for name in UNTRAINED:
                untrained = cast("RtiNmpc", cosim.build_controller(name, scenario))
                named[name] = str(untrained.parameters.save(work / f"{name}.toml"))
            trained = _train_rules(named[START], samples, seed, out_)
            for name, training in trained.items():
                named[name] = str(training.parameters.save(work / f"{name}.toml"))
            named["optimal"] = "optimal"
            seeds = range(first, first + COMPARED_RUNS)
            evaluation = cosim.evaluate(scenario, named, seeds, steps, progress=out_.live)
            for name in ("naive", START, BEST, "optimal"):
                controller = cosim.build_controller(named[name], scenario)
                run = cosim.simulate(plant, controller, min(steps, DRAWN), first)
                runs[name] = run
                signals[name] = RunSignals(name, run.signals, run.status, scenario.limits)
        summary: dict[str, Any] = evaluation.summary()
        summary["training"] = {name: training.summary() for name, training in trained.items()}
        with staged(folder, RUN_FILES) as stage:
            evaluation.write_files(stage)
            save(overlay_figure(runs), stage / "before-after.png")
            for name, training in trained.items():
                (stage / name).mkdir()
                training.write_files(stage / name)
            has_viewer = find_spec("rerun") is not None
            if has_viewer:
                _record(stage, signals, scenario, trained)
            cli.write_summary(stage, summary)
        data = dict.fromkeys(UNTRAINED, "none")
        for name in LEARNING_RULES:
            data[name] = f"{samples} samples"
        data["optimal"] = "the plant"
        show_evaluation(summary, out_, pairs, data)
        for name in LEARNING_RULES:
            out_.note(_gain(summary, name, samples))
        # `make demo` activates no environment.
        command = "cosim" if shutil.which("cosim") else f"{sys.executable} -m cosim"
        recording = f"{command} view {folder / 'demo.rrd'}"
        if not has_viewer:
            recording = "none without its viewer: pip install 'rti-cosim[view]'"
        out_.note(
            f"pictures   {folder / 'before-after.png'}, {folder / BEST / 'learning.png'}\n"
            f"learned θ  {folder / BEST / 'parameters.toml'} (a controller in every command)\n"
            f"recording  {recording}"
        )
        out_.json(summary)


def _record(
    folder: Path,
    signals: Mapping[str, RunSignals],
    scenario: cosim.Scenario,
    trained: Mapping[str, Training],
) -> None:
    """Write the recordings of the runs and of each training.

    Args:
        folder: of the demo's files.
        signals: of the runs, by controller.
        scenario: of them all.
        trained: training of each rule.
    """
    from cosim.recording import record_overlay, record_training

    record_overlay(folder / "demo.rrd", signals, scenario.description)
    for name, training in trained.items():
        record_training(folder / name / "training.rrd", training)


def _train_rules(start: str, samples: int, seed: int, output: cli.Output) -> dict[str, Training]:
    """Train each rule on the same noise.

    Args:
        start: file of the θ of `START`.
        samples: of the plant.
        seed: of its noise.
        output: of the command.
    """
    trained = {}
    # Twelve rows of the log, and three points of the learning curve.
    log_every = max(1, samples // 12)
    evaluate_every = 4 * log_every
    for rule in LEARNING_RULES:
        training = cosim.train(
            rule,
            SCENARIO,
            samples,
            seed=seed,
            start=start,
            log_every=log_every,
            evaluate_every=evaluate_every,
            # No folder is given, and nothing is resumed.
            checkpoint_every=12 * log_every,
            progress=output.live,
        )
        # The file is not there afterwards: its θ is that of a controller with a name.
        run = replace(training.run, start=START)
        trained[rule] = replace(training, run=run)
    return trained


def _gain(summary: dict[str, Any], name: str, samples: int) -> str:
    """A sentence: whether a rule's θ costs less than its start on the runs of the comparison."""
    (pair,) = [
        comparison
        for comparison in summary["comparisons"]
        if (comparison["controller"], comparison["reference"]) == (name, START)
    ]
    gain = pair["gain_in_J"]
    low, high = gain["bootstrap"] or gain["interval"]
    # Less than the last decimal shown is rounding, whatever the interval.
    numbers = [round(100 * number, 2) for number in (gain["value"], low, high)]
    value, low, high = numbers
    learned = f"{name} after {samples} samples"
    # A quotient's interval may leave out zero where that of the difference has it.
    ends = pair["differences"]["J"]["interval"]
    if ends is not None and ends[0] <= 0 <= ends[1]:
        return f"{learned} cannot be told from {START}"
    if low > 0:
        return f"{learned} costs {value:.2f} % [{low:.2f}, {high:.2f}] less than {START}"
    if high < 0:
        return f"{learned} costs {-value:.2f} % [{-high:.2f}, {-low:.2f}] more than {START}"
    return f"{learned} cannot be told from {START}"
