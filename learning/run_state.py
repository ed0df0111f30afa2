"""Where a training run stands: what a checkpoint carries, and which run may go on from it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from cosim.errors import PlantError
from cosim.plant import FmuPlant
from learning import checkpoint
from learning.checkpoint import Checkpoint, group, prefixed
from learning.errors import CheckpointError
from learning.learner import Learner
from learning.log import LogRow, Totals
from learning.training_run import TrainingRun
from learning.validation import Validation


@dataclass
class RunState:
    """A run's learner, plant and validation, the log's `rows`, and `totals` since the last one."""

    run: TrainingRun
    learner: Learner
    plant: FmuPlant
    validation: Validation | None
    rows: list[LogRow] = field(default_factory=list)
    totals: Totals = field(default_factory=Totals)

    def save(self, path: Path) -> None:
        """Write a checkpoint; raises CapabilityError where the plant cannot serialise its state."""
        learner = self.learner
        plant = self.plant.serialise(self.plant.snapshot())
        numbers, arrays = learner.interaction.state()
        stored = prefixed("interaction ", arrays)
        stored |= prefixed("algorithm ", learner.algorithm.state())
        if self.validation is not None:
            stored |= prefixed("validation ", self.validation.state())
        stored |= {
            "theta": learner.controller.theta,
            "plant": np.frombuffer(plant, dtype=np.uint8),
            "rows": np.array([list(row.values()) for row in self.rows]),
            "row_thetas": np.array([row.parameters.theta for row in self.rows]),
        }
        state = {
            "interaction": numbers,
            "totals": asdict(self.totals),
            "generator": checkpoint.generator_state(learner.rng),
            "algorithm_generator": checkpoint.generator_state(learner.algorithm_rng),
            "columns": list(self.rows[0]) if self.rows else [],
        }
        checkpoint.save(path, Checkpoint(self.run.identity(), state, stored))

    def load(self, path: Path) -> None:
        """Take up a checkpoint; raises CheckpointError where there is none that fits."""
        found = checkpoint.load(path, self.run.identity(), but=("samples",))
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
        learner, state, arrays = self.learner, found.state, found.arrays
        checkpoint.restore_generator(learner.rng, state["generator"])
        checkpoint.restore_generator(learner.algorithm_rng, state["algorithm_generator"])
        self.rows = [
            LogRow(
                dict(zip(state["columns"], figures, strict=True)),
                learner.start.with_theta(theta),
            )
            for figures, theta in zip(arrays["rows"], arrays["row_thetas"], strict=True)
        ]
        self.totals = Totals(**state["totals"])
        learner.controller.theta = arrays["theta"]
        if self.validation is not None:
            self.validation.restore(group(arrays, "validation "))
        self.plant.restore(self.plant.deserialise(arrays["plant"].tobytes()))
        learner.algorithm.restore(group(arrays, "algorithm "))
        learner.interaction.resume(state["interaction"], group(arrays, "interaction "))

    def _require_same_beginning(self, path: Path, samples: int) -> None:
        """Raise CheckpointError where a run of `samples` samples was no part of this one."""
        run = self.run
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
