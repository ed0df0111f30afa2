"""Validation: of the θ that a run hands over, keep the one that did best on noise of its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cosim.protocols import Controller, Plant
from cosim.simulation import simulate

Vector = NDArray[np.float64]


class Validation:
    """The incumbent, which a candidate replaces only if its mean cost is lower on the same noise.

    A candidate is run greedily for `steps` samples from the scenario's initial state, on the noise
    of `seed`, which is the same for all (common random numbers) and none that the run is judged on.
    `plant` is an episode's plant, `controller(theta)` the greedy controller at θ. `samples` counts
    the plant samples that this took; `accepted` how often the incumbent was replaced.

    The first incumbent is the start, so that a good start is not lost to a worse result.
    """

    def __init__(
        self, plant: Plant, controller: Callable[[Vector], Controller], seed: int, steps: int
    ) -> None:
        self._plant, self._controller, self._seed, self._steps = plant, controller, seed, steps
        self.theta: Vector | None = None
        """The incumbent, (n_θ,); None before the first candidate."""
        self.cost = float("nan")
        """Mean cost per sample of the incumbent in its validation run, J."""
        self.samples = 0
        self.accepted = 0

    def consider(self, theta: Vector) -> tuple[bool, float]:
        """Whether θ (n_θ,) is the incumbent now, and its J; the incumbent is not run again."""
        if self.theta is not None and np.array_equal(theta, self.theta):
            return False, self.cost
        controller = self._controller(theta)
        cost = float(
            simulate(self._plant, controller, self._steps, self._seed, residuals=False).summary()[
                "J"
            ]
        )
        self.samples += self._steps
        first = self.theta is None
        if not (first or cost < self.cost):
            return False, cost
        self.theta, self.cost = theta.copy(), cost
        self.accepted += not first
        return True, cost

    def state(self) -> dict[str, Vector]:
        """Arrays from which `restore` goes on."""
        assert self.theta is not None
        counts = np.array([self.cost, self.samples, self.accepted])
        return {"theta": self.theta, "counts": counts}

    def restore(self, state: dict[str, Vector]) -> None:
        """Take back what `state` gave."""
        self.theta = state["theta"]
        self.cost, samples, accepted = (float(value) for value in state["counts"])
        self.samples, self.accepted = int(samples), int(accepted)
