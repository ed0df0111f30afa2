"""`train`: one training from Python or the command line, and what came of it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from cosim.files import write_atomically
from cosim.lookup import build_controller
from cosim.scenario import Scenario
from cosim.statistics import shown
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.log import to_csv
from learning.optimum import stored_optimum
from learning.protocols import LearnableController
from learning.starting_point import build_controller as build_learnt
from learning.training_loop import Progress, training_loop
from learning.training_run import TrainingRecorder, TrainingResult, TrainingRun, prepare

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
FIGURE = "learning.png"


@dataclass(frozen=True)
class Training:
    """A training that has ended: its `run`, the `result`, and how long it took, `wall_seconds`."""

    run: TrainingRun
    result: TrainingResult
    wall_seconds: float = field(compare=False)

    @property
    def parameters(self) -> Parameters:
        """θ that it ended with."""
        return self.result.parameters

    @property
    def status(self) -> str:
        """`finished`, or `diverged: …`."""
        return self.result.status

    @property
    def J(self) -> float:
        """Mean of economic cost and penalty per sample of the greedy policy, on held-out noise."""
        return float(self.result.evaluation["J"])

    @property
    def regret(self) -> float:
        """(J − J*)/|J*| on that noise, NaN where J* is not known."""
        found = self.result.evaluation["regret"]
        return float("nan") if found is None else float(found)

    def controller(self) -> LearnableController:
        """A fresh controller that has this θ."""
        return build_learnt(self.run.controller, self.run.scenario, self.parameters)

    def log(self) -> dict[str, Array]:
        """The columns of the training's log, (K,) each, NaN where not measured."""
        rows = self.result.rows
        return {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ())}

    def theta(self) -> dict[str, Array]:
        """Increments of θ since the start by block, (K, entries) each."""
        blocks, start = self.parameters.blocks, self.result.start
        moved = np.array([row.parameters.theta - start.theta for row in self.result.rows])
        return {name: moved[:, where] for name, where in blocks.slices.items()}

    def figure(self) -> Figure:
        """Cost, violations, TD error and θ over the samples; LearningError without a log."""
        from cosim.figures.training import training_figure  # noqa: PLC0415 - matplotlib

        if not self.result.rows:
            raise ConfigurationError("this training's log has no row: there is nothing to draw")
        blocks, run = self.parameters.blocks, self.run
        scale = {name: blocks.scale[where] for name, where in blocks.slices.items()}
        greedy, end = shown(self.J, digits=6), self.status.partition(":")[0]
        return training_figure(
            self.log(),
            {name: values / scale[name] for name, values in self.theta().items()},
            self.result.baselines,
            start=self.result.start_J,
            title=f"{run.algorithm} on {run.scenario.name} from {Path(run.start).stem}, seed "
            f"{run.seed}: {end}, J = {greedy}",
        )

    def plot(self, path: str | Path) -> Path:
        """Draw `figure` to a PNG or SVG file; raises FigureError where it cannot be written."""
        from cosim.figures.style import save  # noqa: PLC0415 - matplotlib

        return save(self.figure(), path)

    def save(self, folder: str | Path) -> Path:
        """Write parameters.toml, learning.csv, learning.png and scenario.toml; the folder."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / "learning.csv", to_csv(self.result.rows))
        self.parameters.save(folder / "parameters.toml")
        write_atomically(folder / "scenario.toml", self.run.scenario.to_toml())
        if self.result.rows:
            self.plot(folder / FIGURE)
        return folder

    def summary(self) -> dict[str, Any]:
        """The training as a JSON document: settings, the greedy policy's figures, how it ended."""
        run, result = self.run, self.result
        last: Mapping[str, float] = result.rows[-1] if result.rows else {}
        return {
            "version": version("rti-cosim"),
            "algorithm": run.algorithm,
            "scenario": run.scenario.name,
            "scenario_hash": run.scenario.hash,
            "controller": run.controller,
            "start": run.start,
            "samples": int(last.get("samples", 0)),
            "plant_samples": result.plant_samples,
            "validation": _validation(run, result),
            "seed": run.seed,
            "status": result.status,
            "hyperparameters": run.configuration.model_dump(mode="json"),
            "parameters_hash": result.parameters.hash,
            "evaluation_seeds": run.evaluation_seeds,
            "evaluation_steps": run.evaluation_steps,
            **result.evaluation,
            "smallest_eigenvalue": last.get("smallest_eigenvalue"),
            "td_error": last.get("td_error"),
            "late_movement": result.late_movement,
            "training_failures": last.get("failures"),
            "weakly_active": last.get("weakly_active"),
            "licq_failed": last.get("licq_failed"),
        }


def _validation(run: TrainingRun, result: TrainingResult) -> dict[str, int] | None:
    """How θ was chosen among those of the run, None where it is simply the last one."""
    if not run.validate_every:
        return None
    return {
        "validate_every": run.validate_every,
        "validation_samples": run.validation_samples,
        "samples": result.validated,
        "accepted": int(result.rows[-1]["accepted"]) if result.rows else 0,
    }


def train(
    algorithm: str,
    scenario: Scenario | str | Path = "paper",
    samples: int | None = None,
    *,
    seed: int = 0,
    start: str | Path = "naive",
    settings: Mapping[str, Any] | Configuration | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    optimum: str | None = None,
    recorder: TrainingRecorder | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> Training:
    """Train a controller's θ on a scenario's plant.

    Raises AlgorithmLookupError, ConfigurationError, ScenarioError, PlantError, CheckpointError,
    each in one line, before the work where it can be known before.

    Parameters
    ----------
    algorithm : a registered name (`learning.registry.algorithms`) or `module:Class`.
    scenario : a scenario, a preset's name or a TOML file.
    samples : plant samples; None is what the algorithm says, else 50 000.
    seed : seed of noise and exploration.
    start : where θ starts: naive, tuned or a parameters file.
    settings : hyperparameters by name; the algorithm's Configuration documents them.
    out : folder that the run's checkpoints are kept in; None keeps none. `Training.save` writes
        the rest.
    resume : go on from the checkpoint in `out`.
    optimum : name of the controller whose J is J*; None is `optimal` where its solution is stored.
    recorder : gets every row of the log, for a recording.
    progress : called with the samples done and the last row of the log.
    options : further fields of `TrainingRun`, `evaluate_every=1000` say.
    """
    if not isinstance(scenario, Scenario):
        scenario = Scenario.load(scenario)
    fields = {"seed": seed, "start": str(start), **options}
    run = prepare(algorithm, scenario, samples, settings, fields)
    return carry_out(
        run, out=out, resume=resume, optimum=optimum, recorder=recorder, progress=progress
    )


def carry_out(
    run: TrainingRun,
    *,
    out: str | Path | None = None,
    resume: bool = False,
    optimum: str | None = None,
    recorder: TrainingRecorder | None = None,
    progress: Progress | None = None,
) -> Training:
    """Train as `run` says; the other arguments and the errors are those of `train`."""
    begin = time.perf_counter()
    optimum = optimum or stored_optimum(run.scenario)
    yardstick = build_controller(optimum, run.scenario) if optimum else None
    folder = None if out is None else Path(out)
    with training_loop(run, optimum=yardstick, out=folder, recorder=recorder) as loop:
        result = loop.go(resume=resume, progress=progress)
    return Training(run, result, time.perf_counter() - begin)
