"""A plant that fouls: the optimum that goes with its present heat transfer, a reference."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from controllers.dynamic_programming.plant import StochasticScenario
from controllers.dynamic_programming.solution import Progress
from controllers.errors import OptimumError
from controllers.optimum import OptimalPolicy, OptimalSolution
from controllers.problem import load_model

Vector = NDArray[np.float64]
DAY = 86400.0
NODES = 6
# The evaporator's law of fouling, fmus/sources/fouling.h: parameters of the plant, none of x' = f.
FOULING = ("fouling_rate", "fouling_floor", "cleaning_period")


@dataclass(frozen=True)
class Fouling:
    """UA2(τ) = UA2 (floor + (1 − floor) e^(−rate·τ)), τ days since the last cleaning.

    `clean` is the heat transfer UA2 of the clean condenser, `rate` in 1/d, `floor` the share of UA2
    that fouling leaves in the end, `period` of the cleaning in d.
    """

    clean: float
    rate: float
    floor: float
    period: float

    @classmethod
    def of(cls, scenario: StochasticScenario) -> Fouling | None:
        """The law by which a scenario's condenser fouls, None where it does not."""
        given = scenario.plant.parameters
        rate, floor, period = (
            float(given.get(name, default))
            for name, default in zip(FOULING, (0.0, 0.7, 0.0), strict=True)
        )
        if rate == 0.0 or floor == 1.0:
            return None
        if not period > 0.0:
            raise OptimumError(
                "the quasi-static optimum needs a condenser that is cleaned: set "
                "plant.parameters.cleaning_period above 0"
            )
        model = load_model(scenario.plant.model or scenario.controller.model)
        nominal = {quantity.name: quantity.nominal for quantity in model.parameters}
        if "UA2" not in nominal:
            raise OptimumError(f"model '{model.name}' has no UA2 that could foul")
        return cls(float(given.get("UA2", nominal["UA2"])), rate, floor, period)

    def heat_transfer(self, days: ArrayLike) -> Vector:
        """UA2 at a number of days since the start, the clean condenser's at 0."""
        since = np.mod(days, self.period)
        return self.clean * (self.floor + (1.0 - self.floor) * np.exp(-self.rate * since))

    @property
    def nodes(self) -> list[float]:
        """The values of UA2 whose optima the reference is made of, increasing."""
        fouled = self.clean * (self.floor + (1 - self.floor) * np.exp(-self.rate * self.period))
        values: list[float] = np.linspace(fouled, self.clean, NODES).round(6).tolist()
        return values


class QuasiStaticPolicy:
    """π*(s; UA2(t)): between the optimal policies of fixed heat transfers, linear in UA2.

    It knows the law of fouling and the clock, which starts at a clean condenser with each `reset`
    and goes on by one sample with each `prepare`. A reference, not a bound: it looks at no
    change to come, and for a condenser that fouled infinitely slowly it would be the optimum.
    """

    name = "optimal"

    def __init__(
        self, fouling: Fouling, policies: Sequence[OptimalPolicy], sampling_time: float
    ) -> None:
        self.fouling = fouling
        self.policies = tuple(policies)
        self._nodes = fouling.nodes
        self._days_per_sample = sampling_time / DAY
        self._sample = -1

    @classmethod
    def from_scenario(
        cls,
        scenario: StochasticScenario,
        *,
        progress: Callable[[Progress], None] | None = None,
    ) -> QuasiStaticPolicy:
        """The policy of a scenario that fouls; solves what is not stored. Raises OptimumError."""
        fouling = _fouling(scenario)
        policies = [
            OptimalPolicy.from_scenario(scenario, overrides=_held(value), progress=progress)
            for value in fouling.nodes
        ]
        return cls(fouling, policies, scenario.sampling_time)

    @classmethod
    def stored(cls, scenario: StochasticScenario) -> QuasiStaticPolicy | None:
        """The policy of a scenario that fouls where all of its optima are stored, else None."""
        fouling = _fouling(scenario)
        policies = []
        for value in fouling.nodes:
            policy = OptimalPolicy.stored(scenario, overrides=_held(value))
            if policy is None:
                return None
            policies.append(policy)
        return cls(fouling, policies, scenario.sampling_time)

    @property
    def gains(self) -> list[tuple[float, float]]:
        """(UA2, J* at that UA2), by increasing UA2."""
        return list(zip(self._nodes, (policy.gain for policy in self.policies), strict=True))

    @property
    def gain(self) -> float:
        """Mean of J*(UA2(t)) over one cycle, J* between the nodes by monotone cubics."""
        x, weights = np.polynomial.legendre.leggauss(40)
        values = self.fouling.heat_transfer(0.5 * self.fouling.period * (x + 1.0))
        return float(self.gain_at(values) @ weights / 2.0)

    def gain_at(self, heat_transfer: ArrayLike) -> Vector:
        """J* of a condenser that stays at a heat transfer UA2, of any shape."""
        curve = PchipInterpolator(self._nodes, [policy.gain for policy in self.policies])
        found: Vector = curve(np.clip(heat_transfer, self._nodes[0], self._nodes[-1]))
        return found

    def reset(self) -> None:
        """Start the clock at a clean condenser."""
        self._sample = -1

    def prepare(self) -> None:
        """Advance the clock by one sample."""
        self._sample += 1

    def feedback(self, s: ArrayLike, a: ArrayLike | None = None) -> OptimalSolution:
        """Action and value at s (n,) for the present heat transfer; raises QpError as each does."""
        present = float(self.fouling.heat_transfer(max(self._sample, 0) * self._days_per_sample))
        upper = min(max(bisect_right(self._nodes, present), 1), len(self._nodes) - 1)
        low, high = self._nodes[upper - 1], self._nodes[upper]
        share = min(max((present - low) / (high - low), 0.0), 1.0)
        first, second = (self.policies[i].feedback(s, a) for i in (upper - 1, upper))
        return OptimalSolution(
            (1.0 - share) * first.action + share * second.action,
            (1.0 - share) * first.value + share * second.value,
            "clamped" if "clamped" in (first.status, second.status) else "solved",
        )


def _fouling(scenario: StochasticScenario) -> Fouling:
    fouling = Fouling.of(scenario)
    if fouling is None:
        raise OptimumError("the scenario's condenser does not foul: its optimum is OptimalPolicy's")
    return fouling


def _held(value: float) -> dict[str, float | None]:
    """Plant parameters of a condenser that stays as it is."""
    return {"UA2": value, **dict.fromkeys(FOULING)}
