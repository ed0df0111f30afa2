"""The training loop: samples, log, greedy evaluation, checkpoints, early stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from controllers.storage import write_atomically
from cosim.errors import CapabilityError
from cosim.plant import FmuPlant
from cosim.protocols import Controller
from learning import checkpoint
from learning.checkpoint import Checkpoint
from learning.definiteness import certificate
from learning.errors import ConfigurationError, DivergenceError
from learning.evaluation import Judge
from learning.learner import Learner
from learning.log import COLUMNS, LogRow, Totals, to_csv
from learning.protocols import Algorithm
from learning.training_run import TrainingRecorder, TrainingResult, TrainingRun

Progress = Callable[[int, LogRow], None]
"""Gets the samples done and the last row of the log."""


class TrainingLoop:
    """One run of one algorithm on one plant.

    `plant` and `evaluation_plant` are two plants of the run's scenario. `optimum` is a controller
    whose J on the held-out runs is J*; without it regret and gap closed are NaN. With `out`,
    learning.csv, parameters.toml and checkpoint.npz are kept there as the run goes on; a plant
    that cannot serialise its state leaves no checkpoint, and `without_checkpoint` says so.
    """

    def __init__(
        self,
        run: TrainingRun,
        algorithm: type[Algorithm],
        plant: FmuPlant,
        evaluation_plant: FmuPlant,
        *,
        optimum: Controller | None = None,
        out: Path | None = None,
        recorder: TrainingRecorder | None = None,
    ) -> None:
        self._run, self._plant, self._out, self._recorder = run, plant, out, recorder
        self._learner = Learner(run, algorithm, plant)
        self._good = self._learner.start
        self._judge = Judge(run, cast("Any", evaluation_plant), self._good, optimum)
        self._rows: list[LogRow] = []
        self._totals = Totals()
        self.without_checkpoint: str | None = None
        """Why this run leaves no checkpoint, if it does not."""

    def go(self, *, resume: bool = False, progress: Progress | None = None) -> TrainingResult:
        """Train to the end or to divergence.

        With `resume` the run goes on from its checkpoint, to the same digits as if it had never
        stopped; raises CheckpointError where there is none that fits.
        """
        if resume:
            self._resume()
        else:
            self._learner.begin()
            self._checkpoint()
        if self._recorder is not None:
            self._recorder.start(self._run, self._good)
            for row in self._rows:
                self._record(row)
        try:
            status = self._loop(progress)
        finally:
            if self._recorder is not None:
                self._recorder.close()
        verdict = self._judge.verdict(self._good.theta)
        return TrainingResult(self._good, self._rows, verdict.summary(), status)

    def _loop(self, progress: Progress | None) -> str:
        run, learner = self._run, self._learner
        while (number := learner.interaction.number) < run.samples:
            try:
                cost, update = learner.advance()
            except DivergenceError as error:
                return f"diverged: {error} at sample {number + 1}"
            number += 1
            self._totals.cost += cost
            if update is not None:
                self._totals.add(update)
            if number % run.log_every and number < run.samples:
                continue
            row = self._row(number)
            self._rows.append(row)
            if self._recorder is not None:
                self._record(row)
            if trouble := self._trouble(row):
                return trouble
            if not isnan(row["greedy_J"]):
                self._good = learner.controller.parameters
            if number % run.checkpoint_every == 0 or number == run.samples:
                self._checkpoint()
            if progress is not None:
                progress(number, row)
        return "finished"

    def _row(self, number: int) -> LogRow:
        """A line of the log: what happened since the last one, and now and then an evaluation."""
        run, interaction = self._run, self._learner.interaction
        blocks, theta = self._good.blocks, self._learner.controller.theta
        row: LogRow = dict.fromkeys(COLUMNS, float("nan"))
        row |= self._totals.means(number - (self._rows[-1]["samples"] if self._rows else 0))
        row |= {
            "samples": number,
            # The least certificate of the updates since the last row, whichever step gave it.
            "smallest_eigenvalue": min(
                self._totals.smallest_eigenvalue, certificate(blocks, theta).smallest
            ),
            "failures": interaction.failures,
            "explored": interaction.explored,
            "saturated": interaction.saturated,
        }
        if number % run.evaluate_every == 0 or number == run.samples:
            row |= self._judge.verdict(theta).row()
        row |= {f"theta {label}": float(v) for label, v in zip(blocks.labels, theta, strict=True)}
        self._totals = Totals()
        return row

    def _trouble(self, row: LogRow) -> str | None:
        """Why the run must stop, or None."""
        where = f"at sample {int(row['samples'])}; the θ kept is the last one that evaluated well"
        if not np.isfinite(self._learner.controller.theta).all():
            return f"diverged: θ is not finite {where}"
        greedy, limit = row["greedy_J"], self._judge.limit
        if greedy > limit:
            return f"diverged: greedy J = {greedy:.1f} exceeds {limit:.1f} {where}"
        return None

    def _record(self, row: LogRow) -> None:
        assert self._recorder is not None
        blocks = self._good.blocks
        theta = np.array([row[f"theta {label}"] for label in blocks.labels])
        self._recorder.record(row, self._good.with_theta(theta), self._judge.controller(theta))

    def _checkpoint(self) -> None:
        """Write the state to disk and start the solver afresh, as a resumed run will."""
        learner = self._learner
        learner.interaction.restart()
        if self._out is None:
            return
        write_atomically(self._out / "learning.csv", to_csv(self._rows))
        self._good.save(self._out / "parameters.toml")
        try:
            plant = self._plant.serialise(self._plant.snapshot())
        except CapabilityError as error:
            self.without_checkpoint = str(error)
            return
        numbers, arrays = learner.interaction.state()
        columns = list(self._rows[0]) if self._rows else []
        stored = {f"interaction {name}": value for name, value in arrays.items()}
        stored |= {f"algorithm {name}": value for name, value in learner.algorithm.state().items()}
        stored |= {
            "theta": learner.controller.theta,
            "good": self._good.theta,
            "plant": np.frombuffer(plant, dtype=np.uint8),
            "rows": np.array([[row[name] for name in columns] for row in self._rows]),
        }
        state = {
            "interaction": numbers,
            "totals": asdict(self._totals),
            "generator": checkpoint.generator_state(learner.rng),
            "columns": columns,
        }
        checkpoint.save(
            self._out / "checkpoint.npz", Checkpoint(self._run.identity(), state, stored)
        )

    def _resume(self) -> None:
        if self._out is None:
            raise ConfigurationError("a run without a folder cannot be resumed")
        found = checkpoint.load(self._out / "checkpoint.npz", self._run.identity())
        learner, state, arrays = self._learner, found.state, found.arrays
        checkpoint.restore_generator(learner.rng, state["generator"])
        self._rows = [
            dict(zip(state["columns"], (float(v) for v in row), strict=True))
            for row in arrays["rows"]
        ]
        self._totals = Totals(**state["totals"])
        learner.controller.theta = arrays["theta"]
        self._good = self._good.with_theta(arrays["good"])
        self._plant.restore(self._plant.deserialise(arrays["plant"].tobytes()))
        learner.algorithm.restore(_group(arrays, "algorithm"))
        learner.interaction.resume(state["interaction"], _group(arrays, "interaction"))


def _group(arrays: dict[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    start = f"{prefix} "
    return {
        name.removeprefix(start): values
        for name, values in arrays.items()
        if name.startswith(start)
    }
