"""Readings of what the paper leaves open: sampling time, γ, disturbance law, penalty weight."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

from cosim.scenario import Scenario

# Variances (1, 2, 8, 5) of (X1, F1, T1, T200), a predecessor of the paper.
NORMAL = (1.0, 2.0**0.5, 8.0**0.5, 5.0**0.5)


@dataclass(frozen=True)
class Reading:
    """One way to read the paper; the defaults are those of the scenario `paper`.

    `sampling_time` in s; `penalty_weight` b_σ in cost per unit of violation.
    """

    sampling_time: float = 60.0
    discount: float = 0.99
    law: str = "uniform"
    penalty_weight: float = 1e5

    @property
    def name(self) -> str:
        """Name for files and tables."""
        return (
            f"{self.sampling_time:g}s-{self.discount:g}-{self.law}-{self.penalty_weight:.0e}"
        ).replace("e+0", "e")

    def scenario(self, paper: Scenario) -> Scenario:
        """The scenario `paper` in this reading."""
        changes: dict[str, Any] = {
            "name": self.name,
            "sampling_time": self.sampling_time,
            "discount": self.discount,
            "penalty": {"linear": [self.penalty_weight] * len(paper.plant.states)},
        }
        if self.law != paper.disturbance.law:
            changes["disturbance"] = {"law": self.law, "ranges": list(NORMAL)}
        return paper.replace(changes)

    def to_dict(self) -> dict[str, Any]:
        """The reading's fields."""
        return asdict(self)


OPEN = {
    "sampling_time": (60.0, 6.0),
    "discount": (0.99, 0.9),
    "law": ("uniform", "normal"),
    "penalty_weight": (1e5, 1e4, 1e3),
}


def readings(factorial: bool) -> list[Reading]:
    """Every combination of the open points' values, or those that differ from `paper` in one."""
    if factorial:
        return [Reading(*values) for values in product(*OPEN.values())]  # type: ignore[arg-type]
    base = Reading()
    others = [
        replace(base, **{name: value})  # type: ignore[arg-type]
        for name, values in OPEN.items()
        for value in values[1:]
    ]
    return [base, *others]
