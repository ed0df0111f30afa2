"""Greedy evaluation of θ on noise that training never sees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.protocols import Controller, Plant
from cosim.simulation import simulate

HELD_OUT = 1_000_000
"""First of the held-out seeds; training seeds stay below."""


@dataclass(frozen=True)
class Evaluation:
    """Runs of `steps` samples from the initial state, one for each held-out seed."""

    plant: Plant
    seeds: tuple[int, ...]
    steps: int

    def costs(
        self, controller: Controller, progress: Callable[[int], None] | None = None
    ) -> dict[str, NDArray[np.float64]]:
        """Summary figures of each run, (seeds,): J, economic_cost, mean_violation and so on."""
        summaries = []
        for done, seed in enumerate(self.seeds):
            summaries.append(simulate(self.plant, controller, self.steps, seed).summary())
            if progress is not None:
                progress(done + 1)
        names = ("economic_cost", "mean_violation", "violating_share", "J", "failures")
        return {name: np.array([float(s[name]) for s in summaries]) for name in names}

    def means(self, controller: Controller) -> dict[str, float]:
        """Mean of each figure over the seeds; `failures` is their sum."""
        costs = self.costs(controller)
        figures: dict[str, Any] = {name: float(values.mean()) for name, values in costs.items()}
        figures["failures"] = int(costs["failures"].sum())
        return figures


def held_out(count: int) -> tuple[int, ...]:
    """The first `count` held-out seeds."""
    return tuple(HELD_OUT + k for k in range(count))


def gap_closed(cost: float, naive: float, optimum: float) -> float:
    """(J_naive − J) / (J_naive − J*)."""
    return (naive - cost) / (naive - optimum)
