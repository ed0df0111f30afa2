"""What a training run is, what comes of it, and who may watch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from controllers.parameters import Parameters
from cosim.protocols import Controller
from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.log import LogRow


@dataclass(frozen=True)
class TrainingRun:
    """What identifies a training run; a checkpoint goes on only in the very same one.

    The `algorithm` by name, its `configuration`, the `scenario`, the kind of `controller` (`rti` or
    `converged`) that learns from `samples` samples with this `seed` of noise and exploration.
    `log_every`, `evaluate_every`, `checkpoint_every` in samples; `evaluation_seeds` held-out runs
    of `evaluation_steps` samples. A greedy J that is worse than the naive one's by more than
    (`divergence` − 1) of its magnitude ends the run.
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

    def __post_init__(self) -> None:
        """Raise ConfigurationError on counts that make no run."""
        for name in ("samples", "log_every", "evaluate_every", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("evaluate_every", "checkpoint_every"):
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
        return values


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

    `evaluation` is a `Verdict.summary`.

    `status` is `finished` or `diverged: …`; then `parameters` is the last θ that evaluated well.
    """

    parameters: Parameters
    rows: list[LogRow]
    evaluation: dict[str, Any]
    status: str
