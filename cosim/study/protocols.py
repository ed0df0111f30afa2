"""What the engine asks of whoever trains: `cosim` knows learning only by this."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Protocol

from cosim.errors import StudyError
from cosim.protocols import Controller
from cosim.scenario import Scenario

GROUP = "cosim.trainers"


@dataclass(frozen=True)
class Training:
    """One training, complete: equal trainings give equal θ, wherever and in however many pieces.

    `samples` of the `scenario`'s plant with this `seed` of noise and exploration; `settings` are
    the `algorithm`'s hyperparameters; `start` is `naive`, `tuned` or a parameters file; `nmpc`
    (`rti` or `converged`) carries θ. The log has a row every `log_every` samples, a greedy
    evaluation every `evaluate_every`, on `evaluation_seeds` × `evaluation_steps` held-out samples;
    a training can be handed over every `checkpoint_every`. `options` go to the training loop as
    they are.
    """

    algorithm: str
    scenario: Scenario
    samples: int
    seed: int
    settings: Mapping[str, Any]
    start: str
    nmpc: str
    log_every: int
    evaluate_every: int
    checkpoint_every: int
    evaluation_seeds: int
    evaluation_steps: int
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Progress:
    """Where a training stands after `samples` samples and `wall_seconds` (of the last piece).

    While it goes on, `status` is empty and `checkpoint` is what it goes on from. At its end
    `status` is `finished` or `diverged: …`, `log` the whole learning.csv, `parameters` the θ that
    it ends with as text, `plant_samples` all the samples that the plant gave for it. `functions`
    says how the controller's were computed at the piece's end, None where that is not known.
    """

    samples: int
    status: str = ""
    checkpoint: bytes = b""
    log: str = ""
    parameters: str = ""
    plant_samples: int = 0
    wall_seconds: float = 0.0
    functions: str | None = None

    @property
    def ended(self) -> bool:
        """Whether there is nothing left to train."""
        return bool(self.status)


class Trainer(Protocol):
    """Trains, and knows what controllers there are; instances are sent to workers (pickled)."""

    def check(self, training: Training) -> None:
        """Raise an error of one line if this training cannot begin."""

    def takes_list(self, algorithm: str, setting: str) -> bool:
        """Whether a hyperparameter is a list itself; raises if there is no such algorithm."""

    def advance(self, training: Training, checkpoint: bytes, seconds: float) -> Progress:
        """Train from a checkpoint (b"": the start) to the first one after `seconds`, or the end."""

    def policy(self, training: Training, parameters: str) -> Controller:
        """The greedy controller of a training's θ."""

    def scales(self, training: Training) -> Mapping[str, float]:
        """Typical size of a change of each entry of a training's θ, by its column of the log.

        Asked for by studies with a table `[theta]` only.
        """

    def controller(self, name: str, scenario: Scenario) -> Controller:
        """A controller by name, parameters file or `module:factory`."""

    def optimum(self, scenario: Scenario) -> str | None:
        """Name of the controller whose J is J*, None if the scenario has no stored optimum."""

    def sources(self, target: str) -> Mapping[str, str]:
        """Hashes, by name, of the foreign files that an algorithm or a controller is made of."""


def registered_trainer() -> Trainer:
    """The trainer of the entry-point group `cosim.trainers`; raises StudyError without one."""
    points = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    if not points:
        raise StudyError(
            f"no trainer is registered in the entry-point group '{GROUP}'; install rti-cosim whole"
        )
    trainer: Trainer = points[0].load()()
    return trainer
