"""Policy search: CMA-ES over the part of θ that the policy depends on, no gradient, no model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from cmaes import CMA
from pydantic import Field
from scipy.linalg import expm

from controllers.theta import Parameters
from cosim.protocols import Vector
from cosim.scenario import Scenario
from learning.algorithm import Transition, Update
from learning.baselines import GreedyConfiguration
from learning.configuration import Count, Positive
from learning.episodes import Episode, Planned, Told
from learning.step import HESSIANS, moved


class PolicySearchConfiguration(GreedyConfiguration):
    """Settings of the policy search."""

    population: Count = Field(13, description="candidates of a generation")
    episode: Count = Field(500, description="plant samples that judge a candidate")
    spread: Positive = Field(0.5, description="σ at the start, in the coordinates of the search")
    width: Positive = Field(
        0.02, description="unit of states and actions, as a share of the width of their bounds"
    )


class Coordinates:
    """θ about a start by coordinates z that have no unit: θ(0) is the start.

    A Hessian B = LLᵀ becomes L exp(Z) Lᵀ, positive definite for every symmetric Z; its linear term
    b − 2B·δ; c_f, x_l and x_u move by δ. δ is in units of the bounds' width (of the reference where
    one is infinite), a tenth of that for c_f. Initial cost and slack weights stay.
    """

    def __init__(self, start: Parameters, scenario: Scenario, width: float) -> None:
        self._start = start
        span = scenario.state_upper - scenario.state_lower
        span = np.where(np.isfinite(span), span, np.abs(scenario.reference_state))
        states = width * np.where(span > 0, span, 1.0)
        both = np.concatenate([states, scenario.action_upper - scenario.action_lower])
        both[states.size :] *= width
        self._factors = {name: np.linalg.cholesky(start[name]) for name in HESSIANS}
        self._units = {
            "B_Vf": np.ones(start.blocks.block("B_Vf").size),
            "b_Vf": states,
            "B_l": np.ones(start.blocks.block("B_l").size),
            "b_l": both,
            "c_f": 0.1 * states,
            "x_l": states,
            "x_u": states,
        }
        self.size = sum(unit.size for unit in self._units.values())

    def theta(self, z: Vector) -> Parameters:
        """θ at z, (size,); x_l is kept below x_u."""
        start, values, place = self._start, {}, 0
        for name, unit in self._units.items():
            moved, place = unit * z[place : place + unit.size], place + unit.size
            if name in HESSIANS:
                symmetric = start.blocks.block(name).unpack(moved)
                matrix = self._factors[name] @ expm(symmetric) @ self._factors[name].T
                values[name] = (matrix + matrix.T) / 2
            elif name.startswith("b_"):
                values[name] = start[name] - 2 * start["B_" + name[2:]] @ moved
            else:
                values[name] = start[name] + moved
        crossed = values["x_l"] >= values["x_u"]
        for name in ("x_l", "x_u"):
            values[name] = np.where(crossed, start[name], values[name])
        return start.replace(values)


class PolicySearch(Planned):
    """CMA-ES (Hansen) on the mean cost of stretches of operation, one for each candidate.

    A stretch begins where the last one ended; its first samples, as many as the horizon has, settle
    and do not count. The mean of the search distribution is what the run hands over; the part of a
    generation that the budget leaves over changes nothing.
    """

    Configuration = PolicySearchConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        start, width = self.controller.parameters, self.configuration.width
        self._coordinates = Coordinates(start, self.scenario, width)
        self.theta = self._coordinates.theta(np.zeros(self._coordinates.size)).theta
        settling = min(self.scenario.controller.horizon, self.configuration.episode - 1)
        self._settling = 0 if self.asks_for == "simulator" else settling
        self.follow(self._generations())

    def _generations(self) -> Iterator[Episode]:
        settings, count = self.configuration, self.configuration.population
        search = CMA(
            mean=np.zeros(self._coordinates.size),
            sigma=settings.spread,
            population_size=count,
            seed=int(self.rng.integers(2**31)),
        )
        while True:
            population = [search.ask() for _ in range(count)]
            noise, judged = int(self.rng.integers(2**63)), []
            for z in population:
                theta = self._coordinates.theta(z).theta
                yield (stretch := Episode(theta, settings.episode, noise))
                judged.append((z, stretch.answer["cost"]))
            search.tell(judged)
            # θ at the mean of the search distribution.
            self.theta = self._coordinates.theta(search.mean).theta

    def told(self) -> Told:
        """Mean cost of the stretch once it has settled."""
        costs = self._episode.costs[self._settling :]
        return {"cost": float(np.cumsum(costs)[-1]) / len(costs)}

    def observe(self, transition: Transition | None, cost: float = 0.0) -> Update | None:
        """Count a sample's cost; the step of θ is that of the mean."""
        before, update = self.theta, super().observe(transition, cost)
        if update is None:
            return None
        blocks = self.controller.parameters.blocks
        return update._replace(step=moved(blocks, before, self.theta).step)


class PolicySearchSimulator(PolicySearch):
    """`PolicySearch` on a plant that is put back: a generation's candidates meet one noise.

    Each episode begins at the scenario's initial state.
    """

    asks_for = "simulator"
