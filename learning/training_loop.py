"""The training loop: samples, log, greedy evaluation, checkpoints, early stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from math import isfinite
from pathlib import Path

import numpy as np

from controllers.parameters import Parameters
from cosim.errors import CapabilityError
from cosim.files import write_atomically
from cosim.plant import FmuPlant
from cosim.protocols import Controller, functions_of
from cosim.statistics import shown
from learning.definiteness import certificate
from learning.drift import Drift
from learning.errors import ConfigurationError, DivergenceError
from learning.evaluation import Judge
from learning.learner import Learner
from learning.log import COLUMNS, LogRow, Totals, to_csv
from learning.protocols import Algorithm
from learning.registry import load_algorithm
from learning.run_state import RunState
from learning.training_run import (
    VALIDATION,
    TrainingRecorder,
    TrainingResult,
    TrainingRun,
    late_movement,
)
from learning.validation import Validation

CHECKPOINT = "checkpoint.npz"
Progress = Callable[[int, LogRow], None]
"""Gets the samples done and the last row of the log."""


class TrainingLoop:
    """One run of one algorithm on one plant.

    `plant` and `evaluation_plant` are two plants of the run's scenario. `optimum` is a controller
    whose J on the held-out runs is J*; without it regret and gap closed are NaN. With `out`,
    learning.csv, parameters.toml and checkpoint.npz are kept there as the run goes on; a plant
    that cannot serialise its state leaves no checkpoint, and the result says so.

    Log, evaluations and files show the θ that the run would end with if it ended there; the log of
    a plant that drifts has its present state too (`Drift`).
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
        learner = Learner(run, algorithm, plant)
        self._judge = Judge(run, evaluation_plant, learner.start, optimum)
        validation: Validation | None = None
        if run.validate_every:
            validation = Validation(
                evaluation_plant,
                self._judge.controller,
                int(run.spawned(VALIDATION).generate_state(1, np.uint64)[0]),
                run.validation_samples,
            )
        self._drift = Drift.of(run.scenario)
        self._state = RunState(run, learner, plant, validation)
        self._without_checkpoint: str | None = None

    def go(self, *, resume: bool = False, progress: Progress | None = None) -> TrainingResult:
        """Train to the end or to divergence.

        With `resume` the run goes on from its checkpoint, to the same digits as if it had never
        stopped; raises CheckpointError where there is none that fits. A run that was to end sooner
        is given more samples where it would have begun in the same way.
        """
        state, learner = self._state, self._state.learner
        if not resume:
            learner.begin()
            self._validate()
            self._checkpoint()
        elif self._out is None:
            raise ConfigurationError("a run without a folder cannot be resumed")
        else:
            state.load(self._out / CHECKPOINT)
        if self._recorder is not None:
            self._recorder.start(self._run, learner.start)
        for row in state.rows:
            self._record(row)
        try:
            status = self._loop(progress)
        finally:
            if self._recorder is not None:
                self._recorder.close()
        verdict = self._judge.verdict(self._answer.theta)
        return TrainingResult(
            parameters=self._answer,
            rows=state.rows,
            evaluation=verdict.summary(),
            status=status,
            plant_samples=self._plant_samples,
            validated=0 if state.validation is None else state.validation.samples,
            start=learner.start,
            start_J=self._judge.start_J,
            baselines=self._judge.baselines,
            functions=functions_of(learner.controller),
            late_movement=late_movement(learner.start, state.rows) if state.rows else float("nan"),
            without_checkpoint=self._without_checkpoint,
        )

    @property
    def _answer(self) -> Parameters:
        """The θ that the run would hand over now."""
        parameters, validation = self._state.learner.parameters, self._state.validation
        if validation is None or validation.theta is None:
            return parameters
        return parameters.with_theta(validation.theta)

    @property
    def _plant_samples(self) -> int:
        state = self._state
        validated = 0 if state.validation is None else state.validation.samples
        return state.learner.interaction.number + validated

    def _validate(self) -> float:
        """Validate what the algorithm hands over; its J, NaN without validation."""
        learner, validation = self._state.learner, self._state.validation
        if validation is None:
            return float("nan")
        accepted, cost = validation.consider(learner.parameters.theta)
        if hook := getattr(learner.algorithm, "validated", None):
            hook(accepted, validation.theta)
        return cost

    def _loop(self, progress: Progress | None) -> str:
        run, state, learner = self._run, self._state, self._state.learner
        while (number := learner.interaction.number) < run.samples:
            try:
                cost, update = learner.advance()
            except DivergenceError as error:
                self._append(self._row(number + 1, judged=True))
                return f"diverged: {error} at sample {number + 1}"
            number += 1
            state.totals.cost += cost
            state.totals.samples += 1
            if update is not None:
                state.totals.add(update)
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
        self._state.rows.append(row)
        self._record(row)

    def _row(self, number: int, *, judged: bool) -> LogRow:
        """A line of the log: what happened since the last one, with an evaluation if `judged`."""
        run, state, interaction = self._run, self._state, self._state.learner.interaction
        every = run.validate_every
        validated = bool(every) and (number % every == 0 or number == run.samples)
        cost = self._validate() if validated else float("nan")
        answer = self._answer
        figures = dict.fromkeys(COLUMNS, float("nan"))
        figures |= state.totals.means()
        figures |= {
            "samples": number,
            # The least certificate of the updates since the last row, whichever step gave it.
            "smallest_eigenvalue": min(
                state.totals.smallest_eigenvalue, certificate(answer.blocks, answer.theta).smallest
            ),
            "failures": interaction.failures,
            "explored": interaction.explored,
            "saturated": interaction.saturated,
            "weakly_active": interaction.weakly_active,
            "licq_failed": interaction.licq_failed,
            "plant_samples": self._plant_samples,
            "validated_J": cost,
            "accepted": float("nan") if state.validation is None else state.validation.accepted,
        }
        if self._drift is not None:
            figures |= self._drift.row(self._plant.time)
        if judged:
            figures |= self._judge.verdict(answer.theta).row()
        state.totals = Totals()
        return LogRow(figures, answer)

    def _trouble(self, row: LogRow) -> str | None:
        """Why the run must stop, or None.

        One evaluation above the limit may be an excursion: two in a row end the run, or the last.
        """
        greedy, limit = row["greedy_J"], self._judge.limit
        if not greedy > limit:
            return None
        earlier = (last["greedy_J"] for last in islice(reversed(self._state.rows), 1, None))
        before = next((judged for judged in earlier if isfinite(judged)), limit)
        if before <= limit and row["samples"] < self._run.samples:
            return None
        reason = f"greedy J = {shown(greedy)} exceeds {shown(limit)}"
        return f"diverged: {reason} at sample {int(row['samples'])}"

    def _record(self, row: LogRow) -> None:
        if self._recorder is not None:
            controller = self._judge.controller(row.parameters.theta)
            self._recorder.record(row, row.parameters, controller)

    def _checkpoint(self) -> None:
        """Write the state to disk and start the solver afresh, as a resumed run will."""
        self._state.learner.interaction.restart()
        if self._out is None:
            return
        write_atomically(self._out / "learning.csv", to_csv(self._state.rows))
        self._answer.save(self._out / "parameters.toml")
        try:
            self._state.save(self._out / CHECKPOINT)
        except CapabilityError as error:
            self._without_checkpoint = str(error)


@contextmanager
def training_loop(
    run: TrainingRun,
    *,
    optimum: Controller | None = None,
    out: Path | None = None,
    recorder: TrainingRecorder | None = None,
) -> Iterator[TrainingLoop]:
    """The loop of a run on plants of its own, which are closed in the end."""
    algorithm = load_algorithm(run.algorithm)
    with FmuPlant(run.scenario) as plant, FmuPlant(run.scenario) as evaluation_plant:
        yield TrainingLoop(
            run, algorithm, plant, evaluation_plant, optimum=optimum, out=out, recorder=recorder
        )
