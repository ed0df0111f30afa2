"""What a training run is, what comes of it, and who may watch."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from controllers.parameters import Parameters
from cosim.lookup import import_from_here
from cosim.protocols import Controller
from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.log import LogRow
from learning.registry import load_algorithm

PLANT, EXPLORATION, ALGORITHM, VALIDATION = range(4)
"""Children of the run's seed sequence, by what they are for."""


SAMPLES = 50_000
"""Of a run where neither user nor algorithm says how many."""


@dataclass(frozen=True)
class TrainingRun:
    """What identifies a training run; a checkpoint goes on only in the very same one.

    The `algorithm` by name, its `configuration`, the `scenario`, the kind of `controller` (`rti` or
    `converged`) that learns from `samples` samples with this `seed` of noise and exploration.
    `log_every`, `evaluate_every`, `checkpoint_every` in samples; `evaluation_seeds` held-out runs
    of `evaluation_steps` samples. A greedy J that is worse than that of the naive θ and that of
    the start by more than (`divergence` − 1) of its magnitude, twice in a row or at the end, is
    divergence and ends the run.

    `start` is where θ starts: `naive`, `tuned` or the path of a parameters file. With
    `validate_every` the θ handed over is validated that often, in samples, by a greedy run of
    `validation_samples` samples, and the run ends with the best of them (`Validation`).

    After `rest_after` samples, if given, the rule rests: θ stays and nothing explores, while the
    samples go on to be counted.

    The configuration is completed by what the scenario states (`Configuration.for_scenario`).
    """

    algorithm: str
    scenario: Scenario
    samples: int
    seed: int
    configuration: Configuration
    controller: str = "rti"
    log_every: int = 1000
    evaluate_every: int = 5000
    checkpoint_every: int = 5000
    evaluation_seeds: int = 4
    evaluation_steps: int = 500
    divergence: float = 1.5
    start: str = "naive"
    validate_every: int = 0
    validation_samples: int = 1000
    rest_after: int | None = None

    def __post_init__(self) -> None:
        """Complete the configuration; raise ConfigurationError on counts that make no run."""
        completed = self.configuration.for_scenario(self.scenario)
        object.__setattr__(self, "configuration", completed)
        for name in (
            "samples",
            "log_every",
            "evaluate_every",
            "checkpoint_every",
            "validation_samples",
        ):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.rest_after is not None and self.rest_after < 1:
            raise ConfigurationError(f"rest_after must be at least 1, not {self.rest_after}")
        for name in ("evaluate_every", "checkpoint_every", "validate_every"):
            if getattr(self, name) % self.log_every:
                raise ConfigurationError(
                    f"{name} = {getattr(self, name)} must be a multiple of log_every = "
                    f"{self.log_every}"
                )

    def identity(self) -> dict[str, Any]:
        """The run as JSON-ready values."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        values["scenario"] = self.scenario.hash
        values["configuration"] = self.configuration.model_dump(mode="json")
        if (file := Path(self.start)).is_file():
            values["start"] = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
        return values

    def spawned(self, purpose: int) -> np.random.SeedSequence:
        """Child of the run's seed sequence for a purpose, `ALGORITHM` or `VALIDATION` say."""
        return np.random.SeedSequence(self.seed).spawn(purpose + 1)[purpose]


def prepare(
    algorithm: str,
    scenario: Scenario,
    samples: int | None,
    settings: Mapping[str, Any] | Configuration | None,
    options: Mapping[str, Any],
) -> TrainingRun:
    """The run of an algorithm by name, checked; `options` are the other fields of `TrainingRun`.

    Raises AlgorithmLookupError; ConfigurationError on settings or options that make no run.
    """
    import_from_here()
    found = load_algorithm(algorithm)
    if not isinstance(settings, Configuration):
        settings = found.Configuration.from_dict(dict(settings or {}))
    try:
        return TrainingRun(
            algorithm=algorithm,
            scenario=scenario,
            samples=getattr(found, "budget", SAMPLES) if samples is None else samples,
            configuration=settings,
            **options,
        )
    except TypeError as error:
        raise ConfigurationError(f"training: {error}") from None


class TrainingRecorder(Protocol):
    """Takes a training run row by row; `cosim.recording.TrainingRecorder` is one."""

    def start(self, run: TrainingRun, parameters: Parameters) -> None:
        """Open the record."""

    def record(self, row: LogRow, parameters: Parameters, controller: Controller) -> None:
        """Append a row of the log with θ as it is."""

    def close(self) -> None:
        """Finish the record."""


@dataclass(frozen=True)
class TrainingResult:
    """What came of a run: θ, the log's `rows`, the greedy evaluation of θ, and how it ended.

    `parameters` are what the run would hand over: the algorithm's last ones, or the best validated
    ones where there was validation. `evaluation` is a `Verdict.summary`; `status` is `finished` or
    `diverged: …`, which changes nothing of what θ is; `plant_samples` counts those of training
    and validation, `validated` those of the latter; `functions` says whether the controller's were
    `interpreted` or `compiled` at the end; `late_movement` how far θ still went in the last fifth
    of the run, as a share of its way from the start; `start` is θ there and `start_J` its
    greedy J, `baselines` that of `naive` and `optimal` on the same noise. `without_checkpoint` says
    why it left no checkpoint, if it was to leave one.
    """

    parameters: Parameters
    rows: list[LogRow]
    evaluation: dict[str, Any]
    status: str
    plant_samples: int
    validated: int
    start: Parameters
    start_J: float
    baselines: Mapping[str, float]
    functions: str | None = None
    late_movement: float = float("nan")
    without_checkpoint: str | None = None


def late_movement(start: Parameters, rows: Sequence[LogRow]) -> float:
    """‖θ_K − θ_0.8K‖/‖θ_K − θ_0‖ in scaled entries: the criterion of convergence, below 0.05.

    θ_0.8K is that of the last row within the first four fifths of the samples. NaN where θ never
    moved or the log has no such row.
    """
    early = [row for row in rows if row["samples"] <= 0.8 * rows[-1]["samples"]]
    if not early:
        return float("nan")
    last, scale = rows[-1].parameters.theta, start.blocks.scale
    way = float(np.linalg.norm((last - start.theta) / scale))
    moved = float(np.linalg.norm((last - early[-1].parameters.theta) / scale))
    return moved / way if way > 0 else float("nan")
