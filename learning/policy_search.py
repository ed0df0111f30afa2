"""Policy search: CMA-ES over the part of θ that the policy depends on, no gradient, no model."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from cmaes import CMA
from pydantic import Field
from scipy.linalg import expm

from controllers.theta import Parameters
from cosim.core.protocols import Vector
from cosim.core.scenario import Positive, Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State
from learning.configuration import Configuration, Count, GreedyConfiguration
from learning.step import HESSIAN_BLOCKS, update_without_fit


class PolicySearchConfiguration(GreedyConfiguration):
    """Hyperparameters of the policy search."""

    population: Count = Field(13, description="candidates of a generation")
    episode: Count = Field(500, description="plant samples that evaluate a candidate")
    spread: Positive = Field(0.5, description="σ at the start, in the coordinates of the search")
    width: Positive = Field(
        0.02,
        description="unit of states and actions, as a share of the width of their bounds",
    )
    offset_share: Positive = Field(0.1, description="unit of c_f, as a share of that of states")


class Coordinates:
    """θ about a start by coordinates z that have no unit: θ(0) is the start.

    A Hessian B = LLᵀ becomes L exp(Z) Lᵀ, positive definite for every symmetric Z; its linear term
    b − 2B·δ; c_f, x_l and x_u move by δ. δ is in units of the bounds' width (of the reference where
    one is infinite), a share of that for c_f. Initial cost and slack weights stay.

    Args:
        start: θ(0).
        scenario: its bounds.
        width: unit of states and actions, as a share of the width of their bounds.
        offset_share: unit of c_f, as a share of that of states.

    Attributes:
        size: number of coordinates.
    """

    def __init__(
        self,
        start: Parameters,
        scenario: Scenario,
        width: float,
        offset_share: float = 0.1,
    ) -> None:
        self._start = start
        span = scenario.state_upper - scenario.state_lower
        # A state without bounds has the size of its reference.
        size = np.abs(scenario.reference_state)
        span = np.where(np.isfinite(span), span, size)
        span = np.where(span > 0, span, 1.0)
        action_span = scenario.action_upper - scenario.action_lower
        states = width * span
        actions = width * action_span
        self._factors = {}
        for name in HESSIAN_BLOCKS:
            self._factors[name] = np.linalg.cholesky(start[name])
        # The order of the blocks is that of their coordinates in z.
        blocks = start.blocks
        self._units = {
            "B_Vf": np.ones(blocks.block("B_Vf").size),
            "b_Vf": states,
            "B_l": np.ones(blocks.block("B_l").size),
            "b_l": np.concatenate([states, actions]),
            "c_f": offset_share * states,
            "x_l": states,
            "x_u": states,
        }
        self.size = sum(unit.size for unit in self._units.values())

    def theta(self, z: Vector) -> Parameters:
        """θ at z, (size,); x_l is kept below x_u."""
        start = self._start
        values = {}
        first = 0
        for name, unit in self._units.items():
            # Each block takes its own coordinates off the vector.
            last = first + unit.size
            delta = unit * z[first:last]
            first = last
            if name in HESSIAN_BLOCKS:
                symmetric = start.blocks.block(name).unpack(delta)
                factor = self._factors[name]
                matrix = factor @ expm(symmetric) @ factor.T
                # A block of θ must be symmetric to the last digit.
                values[name] = (matrix + matrix.T) / 2
            elif name.startswith("b_"):
                # The minimiser of the quadratic cost moves by δ.
                hessian = start["B_" + name[2:]]
                values[name] = start[name] - 2 * hessian @ delta
            else:
                values[name] = start[name] + delta
        # A candidate without a feasible state would only fail.
        crossed = values["x_l"] >= values["x_u"]
        for name in ("x_l", "x_u"):
            wanted = values[name]
            values[name] = np.where(crossed, start[name], wanted)
        return start.replace(values)


class PolicySearch(Algorithm):
    """CMA-ES (Hansen) on the mean cost of stretches of operation, one for each candidate.

    A stretch begins where the last one ended; its first samples, as many as the horizon has, settle
    and do not count. The final θ is the mean of the search distribution; the part of a generation
    that the budget leaves over changes nothing.
    """

    learns_from_estimates = True

    Configuration: ClassVar[type[Configuration]] = PolicySearchConfiguration
    configuration: PolicySearchConfiguration
    explores = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings = self.configuration
        start = self.controller.parameters
        self._blocks = start.blocks
        self._coordinates = Coordinates(
            start,
            self.scenario,
            settings.width,
            settings.offset_share,
        )
        # The first samples of a stretch are of the candidate before; one at least counts.
        horizon = self.scenario.controller.horizon
        self._settling = min(horizon, settings.episode - 1)
        origin = np.zeros(self._coordinates.size)
        # It draws by a generator of its own, which the rule's seeds.
        self._search = CMA(
            mean=origin,
            sigma=settings.spread,
            population_size=settings.population,
            seed=int(self.rng.integers(2**31)),
        )
        self.theta: Vector = self._coordinates.theta(origin).theta
        """θ at the mean of the search distribution, (n_θ,); the controller carries a candidate."""
        self._generations: list[list[float]] = []  # costs of all complete generations
        self._evaluated: list[float] = []  # costs of the open generation's candidates so far
        self._costs: list[float] = []  # samples of the present stretch
        self._ask()
        self._try_candidate()

    def _ask(self) -> None:
        """Draw the candidates of a generation."""
        size = self.configuration.population
        self._population = [self._search.ask() for _ in range(size)]

    def _try_candidate(self) -> None:
        """Set the controller's θ to that of the next candidate."""
        number = len(self._evaluated)
        z = self._population[number]
        candidate = self._coordinates.theta(z)
        self.controller.theta = candidate.theta

    def _tell(self, costs: list[float]) -> None:
        """Move the search distribution by the costs of a generation, and draw the next."""
        self._generations.append(costs)
        evaluated = zip(self._population, costs, strict=True)
        self._search.tell(list(evaluated))
        self._ask()

    def observe(self, transition: Transition) -> Update | None:
        """Count a sample's cost; the last one of a stretch begins the next candidate's."""
        return self._count(transition.known_cost)

    def failed(self, cost: float) -> Update | None:
        """Count the cost of a sample at which the controller failed."""
        return self._count(cost)

    def _count(self, cost: float) -> Update | None:
        self._costs.append(cost)
        if len(self._costs) < self.configuration.episode:
            return None
        settled = self._costs[self._settling :]
        # The last of running sums: `np.sum` adds in another order, with other digits.
        total = float(np.cumsum(settled)[-1])
        mean_cost = total / len(settled)
        self._evaluated.append(mean_cost)
        self._costs = []
        mean_before = self.theta
        candidate_before = self.controller.theta
        # CMA-ES learns from whole generations alone.
        if len(self._evaluated) == self.configuration.population:
            self._tell(self._evaluated)
            self._evaluated = []
            at_mean = self._coordinates.theta(self._search.mean)
            self.theta = at_mean.theta
        self._try_candidate()
        # The log's step is that of the mean, its eigenvalue that of the candidate.
        of_candidate = update_without_fit(
            self._blocks,
            candidate_before,
            self.controller.theta,
        )
        of_mean = update_without_fit(self._blocks, mean_before, self.theta)
        return of_candidate._replace(step=of_mean.step)

    def state_dict(self) -> State:
        """All costs: with the seed they say what CMA-ES has drawn and learned."""
        return {
            "theta": self.theta,
            "generations": np.array(self._generations),
            "evaluated": np.array(self._evaluated),
            "costs": np.array(self._costs),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; CMA-ES is told the costs once more."""
        # Its draws are those of the seed, so the same costs lead to the same distribution.
        self._generations = []
        for costs in state["generations"].tolist():
            self._tell(costs)
        self.theta = state["theta"]
        self._evaluated = state["evaluated"].tolist()
        self._costs = state["costs"].tolist()
