"""How far J* depends on the grid and on the quadrature, and what its policy costs in simulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from controllers.dynamic_programming.certificate import Certificate, Figure
from controllers.dynamic_programming.plant import PlantProblem
from controllers.dynamic_programming.settings import Settings
from controllers.dynamic_programming.simulation import simulate_policy
from controllers.dynamic_programming.solution import Optimum, Progress, refine

STABLE = 1e-3
_MOST_GRIDS = 3


@dataclass(frozen=True)
class Row:
    """A solution of the study; `change` is that of J* against what it refines, relative."""

    what: str
    optimum: Optimum
    change: float | None = None

    @property
    def stable(self) -> bool:
        """Whether refining changed J* by no more than 0.1 %."""
        return self.change is None or self.change <= STABLE


def study(
    plant: PlantProblem,
    settings: Settings,
    optimum: Optimum,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> list[Row]:
    """Refine a solution of `settings` until J* is stable to 0.1 %, then its quadrature once.

    The grid is halved at least once and at most three times; the last row has the finer
    quadrature and integrator on the first grid. `stable` of the last two rows is the verdict.
    """
    rows = [Row("solution", optimum)]
    for level in range(settings.level + 1, settings.level + 1 + _MOST_GRIDS):
        before = rows[-1].optimum
        after = refine(plant, settings, before, level=level, progress=progress)
        rows.append(Row("grid twice as fine", after, _change(before, after)))
        if rows[-1].stable:
            break
    finer = optimum.accuracy.finer()
    after = refine(plant, settings, optimum, accuracy=finer, progress=progress)
    return [*rows, Row("quadrature finer", after, _change(optimum, after))]


def certify(
    plant: PlantProblem, rows: Sequence[Row], *, paths: int = 2000, steps: int = 5000
) -> Optimum:
    """The first refinement of a study, with its certificate.

    It is what is kept, since it is nearer to J* than the solution that the study began with. The
    simulation is that of its policy, by `simulate_policy`.
    """
    solution, refinement = rows[0].optimum, rows[1].optimum
    found = simulate_policy(plant, refinement, paths=paths, steps=steps)
    figures = (
        Figure("solution", solution.gain, solution.lower, solution.upper),
        Figure("refinement", refinement.gain, refinement.lower, refinement.upper),
        Figure(
            "simulation", found.mean, found.mean - found.half_width, found.mean + found.half_width
        ),
    )
    return replace(refinement, certificate=Certificate(figures))


def _change(before: Optimum, after: Optimum) -> float:
    return abs(after.gain - before.gain) / abs(after.gain)
