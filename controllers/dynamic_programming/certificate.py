"""What must agree before a mean cost is called J*: solution, refinement, simulation, search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from controllers.errors import OptimumError

TOLERANCE = 5e-4
AGREEING = ("solution", "refinement", "simulation")
SEARCH = "policy search"


@dataclass(frozen=True)
class Figure:
    """One way to J*: its value and the interval that it is known to."""

    name: str
    value: float
    lower: float
    upper: float

    def __post_init__(self) -> None:
        """Check that the interval holds the value, up to rounding."""
        slack = 1e-9 * abs(self.value)
        if not self.lower - slack <= self.value <= self.upper + slack:
            raise OptimumError(
                f"certificate: {self.name} = {self.value} is not between {self.lower} and "
                f"{self.upper}"
            )


@dataclass(frozen=True)
class Certificate:
    """The figures that were made for one solution.

    `solution`: the gain and its bounds on the grid; `refinement`: the same on the grid of the next
    level, which is what is kept; `simulation`: the mean cost of the refinement's policy on the
    plant's model, 95 %; `policy search`: the best θ that a search found, compared with that policy
    on the same noise.
    """

    figures: tuple[Figure, ...]

    def __getitem__(self, name: str) -> Figure | None:
        """Figure of this name, None where it was not made."""
        return next((figure for figure in self.figures if figure.name == name), None)

    @property
    def spread(self) -> float:
        """Distance of the farthest two values among solution, refinement, simulation; relative."""
        values = [figure.value for figure in self.figures if figure.name in AGREEING]
        return (max(values) - min(values)) / abs(min(values))

    def objection(self) -> str | None:
        """Why the solution is not to be called J*; None where there is nothing against it."""
        if missing := [name for name in AGREEING if self[name] is None]:
            return f"not made: {', '.join(missing)}"
        if self.spread > TOLERANCE:
            return (
                f"solution, refinement and simulation are {100 * self.spread:.3f} % apart, more "
                f"than {100 * TOLERANCE:g} %"
            )
        allowed = TOLERANCE * abs(self.figures[0].value)
        for figure in self.figures:
            if figure.name in AGREEING and figure.upper - figure.lower > 2 * allowed:
                return f"the interval of the {figure.name} is wider than {2 * allowed:.3g}"
        search, refinement = self[SEARCH], self["refinement"]
        if search is not None and refinement and search.upper < refinement.value - allowed:
            return (
                f"a policy search found {search.value:.2f}, more than {100 * TOLERANCE:g} % below "
                "the refinement"
            )
        return None

    def to_list(self) -> list[dict[str, Any]]:
        """The figures as JSON has them."""
        return [asdict(figure) for figure in self.figures]

    @classmethod
    def from_list(cls, figures: Sequence[dict[str, Any]]) -> Certificate:
        """Read back what `to_list` gave; raises OptimumError, KeyError or ValueError."""
        return cls(
            tuple(
                Figure(
                    str(figure["name"]),
                    float(figure["value"]),
                    float(figure["lower"]),
                    float(figure["upper"]),
                )
                for figure in figures
            )
        )
