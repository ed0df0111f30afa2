"""How the dynamic programme is solved, and how finely the plant is integrated for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from controllers.dynamic_programming.bellman import Accuracy
from controllers.dynamic_programming.elementwise import Elementwise
from controllers.dynamic_programming.plant import PlantProblem
from controllers.errors import OptimumError
from controllers.model import discretise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """How the problem is solved.

    `criterion`: mean cost per sample, or cost discounted by the problem's γ. `level` 0 is a first
    grid over all states, each further level resolves the closed loop's support (all but `tail` of
    the samples at each end) with `cells`·2^level cells a state; cells beyond it grow by `growth`
    each. `nodes` and `penalty_nodes` per disturbance, the influential ones first; empty: 7 and
    20 for the first two, 2 and 4 for the third, 2 and 2 for the others. `integration_tolerance` on
    the sampled model, relative; `tolerance` on the distance of the gain's bounds, relative, to
    be met within `rounds` policy iterations a grid.
    """

    criterion: Literal["average", "discounted"] = "average"
    level: int = 1
    cells: int = 12
    growth: float = 1.35
    tail: float = 1e-7
    nodes: tuple[int, ...] = ()
    penalty_nodes: tuple[int, ...] = ()
    integration_tolerance: float = 1e-6
    tolerance: float = 1e-4
    rounds: int = 40

    def __post_init__(self) -> None:
        """Check the ranges."""
        positive = (self.tail, self.integration_tolerance, self.tolerance)
        if (
            self.criterion not in {"average", "discounted"}
            or not 0 <= self.level <= 6
            or min(self.cells, self.rounds) < 1
            or not self.growth > 1
            or min(positive) <= 0
        ):
            raise OptimumError(
                f"{self}: criterion must be average or discounted, level 0 to 6, growth above 1 "
                "and the other numbers positive"
            )

    def accuracy(self, plant: PlantProblem) -> Accuracy:
        """Integrator and quadrature for a problem."""
        count = len(plant.law.nominal)
        return Accuracy(
            accurate_substeps(plant, self.integration_tolerance),
            self.nodes or (7, 7, *(2,) * count)[:count],
            self.penalty_nodes or (20, 20, 4, *(2,) * count)[:count],
        )


def accurate_substeps(plant: PlantProblem, tolerance: float) -> int:
    """Least power of two of RK4 substeps whose doubling moves no next state by more than allowed.

    Allowed is `tolerance`·(1 + |x|), tried at 2000 points: states within the first quarter of the
    bounds' box around the reference, actions in their box, disturbances of the law. Raises
    OptimumError where 128 substeps do not do.
    """
    problem, generator = plant.problem, np.random.default_rng(0)
    reach = 0.25 * (problem.state_upper - problem.state_lower)
    x = generator.uniform(
        np.maximum(problem.state_lower, problem.reference_state - reach),
        np.minimum(problem.state_upper, problem.reference_state + reach),
        (2000, problem.n_states),
    )
    u = generator.uniform(problem.action_lower, problem.action_upper, (2000, problem.n_actions))
    d = plant.law.draw(generator, 2000)
    before: Array | None = None
    for substeps in 2 ** np.arange(8):
        step = Elementwise(discretise(problem.model, problem.sampling_time, int(substeps)))
        # A step that is too long may overflow; then the next one is tried.
        with np.errstate(all="ignore"):
            entries = step(x.T, u.T, d.T, plant.parameters)
            x_next = np.stack([np.broadcast_to(entry, 2000) for entry in entries], axis=1)
            moved = np.inf if before is None else np.abs(x_next - before)
        if np.all(moved <= tolerance * (1 + np.abs(x))):
            return int(substeps)
        before = x_next
    raise OptimumError(
        f"model '{problem.model.name}': 128 RK4 substeps a sample do not integrate it to "
        f"{tolerance:g}; shorten the sampling time"
    )
