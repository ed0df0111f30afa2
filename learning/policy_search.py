"""Policy search: CMA-ES over the part of θ that the policy depends on, no gradient, no model."""

from __future__ import annotations

from typing import Any

import numpy as np
from cmaes import CMA
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import expm

from controllers.theta import Parameters
from cosim.protocols import Vector
from cosim.scenario import Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.baselines import GreedyConfiguration
from learning.configuration import Count, Positive
from learning.step import HESSIANS, moved, smallest_eigenvalue


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


class PolicySearch(Algorithm):
    """CMA-ES (Hansen) on the mean cost of stretches of operation, one for each candidate.

    A stretch begins where the last one ended; its first samples, as many as the horizon has, settle
    and do not count. The mean of the search distribution is what the run hands over; the part of a
    generation that the budget leaves over changes nothing.
    """

    Configuration = PolicySearchConfiguration
    KEPT = ("_told", "_costs", "_noise", "_sum", "_step")

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings, start = self.configuration, self.controller.parameters
        self._coordinates = Coordinates(start, self.scenario, settings.width)
        self._seed = int(self.rng.integers(2**31))
        self._search = self._new_search()
        self._told: list[Vector] = []
        self._costs: list[float] = []
        self._sum, self._step = 0.0, 0
        horizon = self.scenario.controller.horizon
        self._settling = 0 if self._simulated else min(horizon, settings.episode - 1)
        self._begin_generation()
        self.first_episode = self._noise if self._simulated else None
        self.controller.theta = self._coordinates.theta(self._population[0]).theta

    @property
    def _simulated(self) -> bool:
        return self.asks_for == "simulator"

    def _new_search(self) -> CMA:
        return CMA(
            mean=np.zeros(self._coordinates.size),
            sigma=self.configuration.spread,
            population_size=self.configuration.population,
            seed=self._seed,
        )

    def _begin_generation(self) -> None:
        self._population, self._costs = self._ask(), []
        self._noise = int(self.rng.integers(2**63))

    def _ask(self) -> list[Vector]:
        return [self._search.ask() for _ in range(self.configuration.population)]

    @property
    def theta(self) -> Vector:
        """θ at the mean of the search distribution, (n_θ,)."""
        return self._coordinates.theta(self._search.mean).theta

    def observe(self, transition: Transition) -> Update | None:
        """Count a sample's cost."""
        return self.failed(transition.cost)

    def failed(self, cost: float) -> Update | None:
        """Count a cost, the controller failed or not; the last of an episode brings a candidate."""
        self._sum += cost if self._step >= self._settling else 0.0
        self._step += 1
        if self._step < self.configuration.episode:
            return None
        self._costs.append(self._sum / (self._step - self._settling))
        self._sum, self._step = 0.0, 0
        before = self.theta
        if len(self._costs) == len(self._population):
            self._tell(np.array(self._population), self._costs)
            self._begin_generation()
        candidate = self._coordinates.theta(self._population[len(self._costs)])
        self.controller.theta = candidate.theta
        blocks, episode = candidate.blocks, self._noise if self._simulated else None
        return moved(blocks, before, self.theta, episode=episode)._replace(
            smallest_eigenvalue=smallest_eigenvalue(blocks, candidate.theta)
        )

    def _tell(self, population: NDArray[np.float64], costs: list[float]) -> None:
        self._search.tell(list(zip(population, costs, strict=True)))
        self._told.append(np.column_stack([population, costs]))

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Restore what `state` returned, by asking and telling all of it again."""
        super().restore(state)
        self._search, told, self._told = self._new_search(), self._told, []
        for generation in told:
            self._ask()
            self._tell(generation[:, :-1], generation[:, -1].tolist())
        self._population = self._ask()


class PolicySearchSimulator(PolicySearch):
    """`PolicySearch` on a plant that is put back: a generation's candidates meet one noise.

    Each episode begins at the scenario's initial state.
    """

    asks_for = "simulator"
