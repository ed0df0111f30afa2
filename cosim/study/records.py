"""A study's records: what a case is, and what one run of it gave."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FINISHED, EVALUATED = "finished", "evaluated"
CURVE = ("samples", "J", "greedy_J", "td_error")
"""Columns of a learning curve: `J` is the mean over the training samples of a row."""


@dataclass(frozen=True)
class CaseResult:
    """A case as the tables know it: its `name`, and the `group` of the panel that shows it.

    `target` is the algorithm if it is `trained`, else the controller; `scenarios` are those that it
    runs on. For a controller `samples` is 0, and `start`, `nmpc` and `settings` are empty.
    """

    name: str
    group: str
    target: str
    trained: bool
    samples: int
    start: str
    nmpc: str
    settings: Mapping[str, Any]
    scenarios: Sequence[str]


@dataclass(frozen=True)
class RunResult:
    """One run of a `case` on a `scenario`, finished: a controller, or a training and its last θ.

    `seed` is the training seed, None for a controller; `status` is `evaluated`, `finished` or
    `diverged: …`. `samples` are those of training, `plant_samples` all that the
    plant gave for it. `seeds` (S,) are the
    noise seeds, `steps` the samples on each, `indicators` (S,) each by name. `curve` (K,) each by
    name, empty for a controller; `greedy_J` is a controller's J on the noise of the curves.
    """

    scenario: str
    case: str
    seed: int | None
    status: str
    samples: int
    plant_samples: int
    seeds: tuple[int, ...]
    steps: int
    indicators: Mapping[str, Array]
    curve: Mapping[str, Array]
    greedy_J: float = float("nan")

    @property
    def key(self) -> tuple[str, str, int | None]:
        """Scenario, case and training seed."""
        return self.scenario, self.case, self.seed

    @property
    def J(self) -> float:
        """Mean cost per sample; infinite where it is no number."""
        cost = float(np.mean(self.indicators["J"]))
        return cost if np.isfinite(cost) else float("inf")

    @property
    def finished(self) -> bool:
        """Whether it did not diverge."""
        return self.status in (FINISHED, EVALUATED)
