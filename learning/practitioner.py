"""What the practitioner's baselines share: an estimate from plant data, then a back-off search."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from controllers.parameters import Parameters
from controllers.problem import Problem
from cosim.scenario import Scenario
from learning.algorithm import LearnableController, Transition, Update
from learning.back_off_search import BackOffSearch
from learning.checkpoint import group, prefixed
from learning.configuration import Configuration, Share
from learning.exploration import Strategy
from learning.greedy_configuration import GreedyConfiguration
from learning.step import certificate

Vector = NDArray[np.float64]


class PractitionerConfiguration(GreedyConfiguration):
    """Settings of a baseline that a practitioner would use."""

    back_off: bool = Field(True, description="search the back-off of the active bounds")
    estimation_share: Share = Field(0.25, description="share of the samples for the estimate")

    def depends_on_samples(self) -> list[str]:
        """The shares of the samples that each stage has."""
        return [*super().depends_on_samples(), "samples (shared out among the stages)"]


class Practitioner:
    """First an estimate, on `estimation_share` of the samples, then a `BackOffSearch` from it.

    A subclass says how it `learn`s from a transition and how it `conclude`s; it reports θ with the
    best back-off found so far, whatever it is trying.
    """

    Configuration: ClassVar[type[Configuration]] = PractitionerConfiguration
    budget: ClassVar[int] = 8000
    """Samples of a run where the user says nothing."""

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: PractitionerConfiguration,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None:
        self._controller, self._scenario, self._configuration = controller, scenario, configuration
        self._problem = Problem.from_scenario(scenario)
        self._rng, self._samples = rng, samples
        self._estimation = self.estimation_samples()
        self._count = 0
        self._search: BackOffSearch | None = None
        self._reported: Parameters = controller.parameters
        self.needs_action_value = False
        self.needs_points = False
        if not self._estimation:
            self._begin_search(self._reported)

    def estimation_samples(self) -> int:
        """Samples before the search begins."""
        share = self._configuration.estimation_share if self._configuration.back_off else 1.0
        return max(round(share * self._samples), 1)

    def learn(self, transition: Transition) -> Parameters | None:
        """Take a sample of the estimation; the θ to go on with, or None."""
        raise NotImplementedError

    def conclude(self) -> Parameters:
        """θ at the end of the estimation."""
        raise NotImplementedError

    @property
    def theta(self) -> Vector:
        """The θ found so far, (n_θ,)."""
        return self._reported.theta

    @property
    def first_episode(self) -> int | None:
        """Seed of the search's first round, where it begins at once."""
        return None if self._search is None or self._count else self._search.seed

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample of the estimation or of the search."""
        return self._advance(transition)

    def failed(self, cost: float) -> Update | None:
        """Take a sample at which the controller failed: it counts, and says nothing."""
        return self._advance(None)

    def _advance(self, transition: Transition | None) -> Update | None:
        self._count += 1
        if self._search is not None:
            return self._searched(self._search, transition)
        moved = None if transition is None else self.learn(transition)
        if self._count == self._estimation:
            moved = self._reported = self.conclude()
            if self._configuration.back_off:
                search = self._begin_search(moved)
                return self._move(search.candidate, search.seed)
        if moved is None:
            return None
        self._reported = moved
        return self._move(moved)

    def _begin_search(self, start: Parameters) -> BackOffSearch:
        budget = self._samples - self._count
        self._search = BackOffSearch(start, self._problem, self._scenario, budget, self._rng)
        return self._search

    def _searched(self, search: BackOffSearch, transition: Transition | None) -> Update | None:
        was_done, episode = search.done, search.observe(transition)
        if episode:
            self._reported = search.theta
            return self._move(search.candidate, search.seed)
        if search.done and not was_done:
            self._reported = search.theta
            return self._move(search.theta)
        return None

    def _move(self, parameters: Parameters, episode: int | None = None) -> Update:
        step = parameters.theta - self._controller.theta
        self._controller.theta = parameters.theta
        return Update(
            td_error=float("nan"),
            step=float(np.linalg.norm(step / parameters.blocks.scale)),
            smallest_eigenvalue=certificate(parameters.blocks, parameters.theta).smallest,
            episode=episode,
        )

    def state(self) -> dict[str, NDArray[Any]]:
        """The count, θ as reported, and the search."""
        kept: dict[str, NDArray[Any]] = {
            "count": np.array(self._count),
            "reported": self._reported.theta,
        }
        if self._search is not None:
            kept |= prefixed("search_", self._search.state())
            kept["search_start"] = self._search.start.theta
        return kept

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._count = int(state["count"])
        self._reported = self._reported.with_theta(state["reported"])
        if "search_start" in state:
            rng = np.random.default_rng(0)  # its seeds are restored too
            start = self._reported.with_theta(state["search_start"])
            budget = self._samples - (self._estimation if self._estimation else 0)
            self._search = BackOffSearch(start, self._problem, self._scenario, budget, rng)
            self._search.restore(group(state, "search_"))
