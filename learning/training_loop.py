"""The training loop: samples, log, greedy evaluation, checkpoints, early stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from itertools import islice
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from cosim.errors import CapabilityError, PlantError
from cosim.evaluation.statistics import shown
from cosim.plant import FmuPlant
from cosim.protocols import Controller, functions_of
from learning import checkpoint
from learning.checkpoint import Checkpoint
from learning.definiteness import certificate
from learning.drift import Drift
from learning.errors import CheckpointError, ConfigurationError, DivergenceError
from learning.evaluation import Judge
from learning.learner import Learner
from learning.log import COLUMNS, LogRow, Totals, to_csv
from learning.protocols import Algorithm
from learning.training_run import (
    VALIDATION,
    TrainingRecorder,
    TrainingResult,
    TrainingRun,
    late_movement,
)
from learning.validation import Validation
from rti_storage import write_atomically

Progress = Callable[[int, LogRow], None]
"""Gets the samples done and the last row of the log."""


class TrainingLoop:
    """One run of one algorithm on one plant.

    `plant` and `evaluation_plant` are two plants of the run's scenario. `optimum` is a controller
    whose J on the held-out runs is J*; without it regret and gap closed are NaN. With `out`,
    learning.csv, parameters.toml and checkpoint.npz are kept there as the run goes on; a plant
    that cannot serialise its state leaves no checkpoint, and `without_checkpoint` says so.

    The log of a plant that drifts has its present state too (`Drift`).

    Log, evaluations and files show the θ that the run would end with if it ended there.
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
        self._judge = Judge(run, evaluation_plant, self._learner.start, optimum)
        self._validation: Validation | None = None
        if run.validate_every:
            self._validation = Validation(
                evaluation_plant,
                self._judge.controller,
                int(run.spawned(VALIDATION).generate_state(1, np.uint64)[0]),
                run.validation_samples,
            )
        self._drift = Drift.of(run.scenario)
        self._rows: list[LogRow] = []
        self._totals = Totals()
        self.without_checkpoint: str | None = None
        """Why this run leaves no checkpoint, if it does not."""

    def go(self, *, resume: bool = False, progress: Progress | None = None) -> TrainingResult:
        """Train to the end or to divergence.

        With `resume` the run goes on from its checkpoint, to the same digits as if it had never
        stopped; raises CheckpointError where there is none that fits. A run that was to end sooner
        is given more samples where it would have begun in the same way.
        """
        if resume:
            self._resume()
        else:
            self._learner.begin()
            self._validate()
            self._checkpoint()
        if self._recorder is not None:
            self._recorder.start(self._run, self._learner.start)
            for row in self._rows:
                self._record(row)
        try:
            status = self._loop(progress)
        finally:
            if self._recorder is not None:
                self._recorder.close()
        verdict = self._judge.verdict(self._answer.theta)
        return TrainingResult(
            self._answer,
            self._rows,
            verdict.summary(),
            status,
            self._plant_samples,
            0 if self._validation is None else self._validation.samples,
            self._learner.start,
            self._judge.start_J,
            self._judge.baselines,
            functions_of(self._learner.controller),
            late_movement(self._learner.start, self._rows) if self._rows else float("nan"),
        )

    @property
    def _answer(self) -> Parameters:
        """The θ that the run would hand over now."""
        parameters = self._learner.parameters
        if self._validation is None or self._validation.theta is None:
            return parameters
        return parameters.with_theta(self._validation.theta)

    @property
    def _plant_samples(self) -> int:
        validated = 0 if self._validation is None else self._validation.samples
        return self._learner.interaction.number + validated

    def _validate(self) -> float:
        """Validate what the algorithm hands over; its J, NaN without validation."""
        if self._validation is None:
            return float("nan")
        accepted, cost = self._validation.consider(self._learner.parameters.theta)
        if hook := getattr(self._learner.algorithm, "validated", None):
            hook(accepted, self._validation.theta)
        return cost

    def _loop(self, progress: Progress | None) -> str:
        run, learner = self._run, self._learner
        while (number := learner.interaction.number) < run.samples:
            try:
                cost, update = learner.advance()
            except DivergenceError as error:
                self._append(self._row(number + 1, judged=True))
                return f"diverged: {error} at sample {number + 1}"
            number += 1
            self._totals.cost += cost
            self._totals.samples += 1
            if update is not None:
                self._totals.add(update)
            if number % run.log_every and number < run.samples:
                continue
            ends = number == run.samples
            row = self._row(number, judged=number % run.evaluate_every == 0 or ends)
            self._append(row)
            if trouble := self._trouble(row):
                return trouble
            if number % run.checkpoint_every == 0 or number == run.samples:
                self._checkpoint()
            if progress is not None:
                progress(number, row)
        return "finished"

    def _append(self, row: LogRow) -> None:
        self._rows.append(row)
        if self._recorder is not None:
            self._record(row)

    def _row(self, number: int, *, judged: bool) -> LogRow:
        """A line of the log: what happened since the last one, with an evaluation if `judged`."""
        run, interaction = self._run, self._learner.interaction
        every = run.validate_every
        validated = bool(every) and (number % every == 0 or number == run.samples)
        cost = self._validate() if validated else float("nan")
        answer = self._answer
        figures = dict.fromkeys(COLUMNS, float("nan"))
        figures |= self._totals.means()
        figures |= {
            "samples": number,
            # The least certificate of the updates since the last row, whichever step gave it.
            "smallest_eigenvalue": min(
                self._totals.smallest_eigenvalue, certificate(answer.blocks, answer.theta).smallest
            ),
            "failures": interaction.failures,
            "explored": interaction.explored,
            "saturated": interaction.saturated,
            "weakly_active": interaction.weakly_active,
            "licq_failed": interaction.licq_failed,
            "plant_samples": self._plant_samples,
            "validated_J": cost,
            "accepted": float("nan") if self._validation is None else self._validation.accepted,
        }
        if self._drift is not None:
            figures |= self._drift.row(self._plant.time)
        if judged:
            figures |= self._judge.verdict(answer.theta).row()
        self._totals = Totals()
        return LogRow(figures, answer)

    def _trouble(self, row: LogRow) -> str | None:
        """Why the run must stop, or None.

        One evaluation above the limit may be an excursion: two in a row end the run, or the last.
        """
        greedy, limit = row["greedy_J"], self._judge.limit
        if not greedy > limit:
            return None
        earlier = (last["greedy_J"] for last in islice(reversed(self._rows), 1, None))
        before = next((judged for judged in earlier if isfinite(judged)), limit)
        if before <= limit and row["samples"] < self._run.samples:
            return None
        where = f"at sample {int(row['samples'])}"
        return f"diverged: greedy J = {shown(greedy)} exceeds {shown(limit)} {where}"

    def _record(self, row: LogRow) -> None:
        assert self._recorder is not None
        self._recorder.record(row, row.parameters, self._judge.controller(row.parameters.theta))

    def _checkpoint(self) -> None:
        """Write the state to disk and start the solver afresh, as a resumed run will."""
        learner = self._learner
        learner.interaction.restart()
        if self._out is None:
            return
        write_atomically(self._out / "learning.csv", to_csv(self._rows))
        self._answer.save(self._out / "parameters.toml")
        try:
            plant = self._plant.serialise(self._plant.snapshot())
        except CapabilityError as error:
            self.without_checkpoint = str(error)
            return
        numbers, arrays = learner.interaction.state()
        columns = list(self._rows[0]) if self._rows else []
        stored = {f"interaction {name}": value for name, value in arrays.items()}
        stored |= {f"algorithm {name}": value for name, value in learner.algorithm.state().items()}
        if self._validation is not None:
            kept = self._validation.state()
            stored |= {f"validation {name}": value for name, value in kept.items()}
        stored |= {
            "theta": learner.controller.theta,
            "plant": np.frombuffer(plant, dtype=np.uint8),
            "rows": np.array([list(row.values()) for row in self._rows]),
            "row_thetas": np.array([row.parameters.theta for row in self._rows]),
        }
        state = {
            "interaction": numbers,
            "totals": asdict(self._totals),
            "generator": checkpoint.generator_state(learner.rng),
            "algorithm_generator": checkpoint.generator_state(learner.algorithm_rng),
            "columns": columns,
        }
        checkpoint.save(
            self._out / "checkpoint.npz", Checkpoint(self._run.identity(), state, stored)
        )

    def _resume(self) -> None:
        if self._out is None:
            raise ConfigurationError("a run without a folder cannot be resumed")
        path = self._out / "checkpoint.npz"
        found = checkpoint.load(path, self._run.identity(), but=("samples",))
        try:
            self._require_same_beginning(path, int(found.run["samples"]))
            self._restore(found)
        except (
            LookupError,
            TypeError,
            ValueError,
            ArithmeticError,
            AttributeError,
            PlantError,
        ) as e:
            raise CheckpointError(
                f"{path}: its content is not that of this run ({type(e).__name__}: {e}); start the "
                "run anew"
            ) from None

    def _restore(self, found: Checkpoint) -> None:
        """Take up a checkpoint's state; whatever does not fit raises some error."""
        learner, state, arrays = self._learner, found.state, found.arrays
        checkpoint.restore_generator(learner.rng, state["generator"])
        checkpoint.restore_generator(learner.algorithm_rng, state["algorithm_generator"])
        self._rows = [
            LogRow(
                dict(zip(state["columns"], map(float, figures), strict=True)),
                learner.start.with_theta(theta),
            )
            for figures, theta in zip(arrays["rows"], arrays["row_thetas"], strict=True)
        ]
        self._totals = Totals(**state["totals"])
        learner.controller.theta = arrays["theta"]
        if self._validation is not None:
            self._validation.restore(_group(arrays, "validation"))
        self._plant.restore(self._plant.deserialise(arrays["plant"].tobytes()))
        learner.algorithm.restore(_group(arrays, "algorithm"))
        learner.interaction.resume(state["interaction"], _group(arrays, "interaction"))

    def _require_same_beginning(self, path: Path, samples: int) -> None:
        """Raise CheckpointError where a run of `samples` samples was no part of this one."""
        run = self._run
        if samples == run.samples:
            return
        if samples > run.samples:
            raise CheckpointError(
                f"{path}: the checkpoint is of a run of {samples} samples; it cannot be made a "
                f"run of {run.samples}"
            )
        if schedules := run.configuration.depends_on_samples():
            raise CheckpointError(
                f"{path}: a run of {samples} samples cannot be given more, since "
                f"{', '.join(schedules)} would have gone another way from the first one: train "
                "anew, or in future without a schedule"
            )
        for name in ("evaluate_every", "checkpoint_every", "validate_every"):
            every = getattr(run, name)
            if every and samples % every:
                raise CheckpointError(
                    f"{path}: a run of {samples} samples cannot be given more, since it ended "
                    f"between two multiples of {name} = {every}, where a longer run does not stop"
                )


def _group(arrays: dict[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    start = f"{prefix} "
    return {
        name.removeprefix(start): values
        for name, values in arrays.items()
        if name.startswith(start)
    }
