"""A learning rule made global: it proposes θ, validation on the plant disposes."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cosim.scenario import Scenario
from learning.checkpoint import group, prefixed
from learning.configuration import Configuration
from learning.definiteness import certificate
from learning.episode_data import EpisodeData
from learning.episodes import Learn, Request, Result, Settle, Trial
from learning.errors import DivergenceError
from learning.exploration import Strategy
from learning.prediction_errors import OneStepModel
from learning.protocols import LearnableController, Rule, Transition, Update
from learning.race import Races
from learning.search_history import SearchHistory, results
from learning.validated_search import ValidatedSearch

Vector = NDArray[np.float64]


class GlobalisedLearning:
    """An algorithm whose rule learns in phases, between them validation (`ValidatedSearch`).

    A subclass makes the rule. With `globalisation = "none"` the rule learns on its own, in one
    endless phase. `theta` is the incumbent: what the run hands over, while the controller carries
    the θ that is being tried. Samples of learning and of validation are all the run's.

    A checkpoint keeps the results that the search was given, and `restore` gives them once more:
    the search is a deterministic plan, so it comes back to where it was.
    """

    Configuration: ClassVar[type[Configuration]]

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: Any,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None:
        self._controller, self._scenario, self._configuration = controller, scenario, configuration
        self._strategy, self._rng, self._samples = strategy, rng, samples
        self._search: ValidatedSearch | None = None
        self._seed = int(rng.integers(2**63))
        self._learnt = 0
        self.explores = True
        """Whether the samples explore now."""
        self._rule = self.rule(samples, 1.0)
        if not configuration.globalised:
            return
        self._deviation = np.broadcast_to(
            configuration.deviation(scenario), scenario.action_lower.shape
        )
        self._model, self._states = OneStepModel(scenario), scenario.state_lower.size
        self._start_search()

    def rule(self, samples: int, width: float) -> Rule:
        """The rule for a phase of `samples` samples from the controller's present θ.

        Its prior or trust region is `width` times as wide as in the first phase.
        """
        raise NotImplementedError

    @property
    def needs_action_value(self) -> bool:
        """Whether Q of explored samples is asked for."""
        return self._rule.needs_action_value and self.explores

    @property
    def needs_points(self) -> bool:
        """Whether linearisation points are asked for."""
        return self._rule.needs_points and self.explores

    @property
    def theta(self) -> Vector | None:
        """The incumbent, (n_θ,); None without globalisation, where it is the controller's θ."""
        return None if self._search is None else self._search.incumbent.theta

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; the last of an episode begins the next one."""
        if self._search is None:
            return self._rule.observe(transition)
        if self._request is None:
            return None
        update: Update | None = None
        if isinstance(self._request, Learn):
            update = self._learn(transition)
        else:
            self._episode.take(transition)
        return self._next() if self._episode.over else update

    def failed(self, cost: float) -> Update | None:
        """Count a sample at which the controller failed; its cost is the episode's."""
        if self._search is None or self._request is None:
            return None
        self._episode.fail(cost)
        return self._next() if self._episode.over else None

    # the episode that is going on ---------------------------------------------------------------

    def _start_search(self) -> None:
        settings = self._configuration
        self._search = ValidatedSearch(
            self._scenario,
            self._controller.parameters,
            self._deviation,
            self._samples,
            self._seed,
            phase=settings.phase,
            block=settings.block,
            blocks=settings.blocks,
        )
        self._plan = self._search.plan()
        self._history = SearchHistory(Races.MEMORY)
        self._request: Request | None = next(self._plan, None)
        self._open()

    def _open(self) -> None:
        """Make ready for the request that the plan has put."""
        request, search, controller = self._request, self._search, self._controller
        assert search is not None
        controller.theta = search.incumbent.theta if request is None else request.theta
        self.explores = isinstance(request, Learn)
        length = request.samples if isinstance(request, Learn) else search.block
        self._episode = EpisodeData(
            request, length, self._deviation, controller.theta.size, self._states
        )
        if isinstance(request, Learn) and not request.goes_on:
            self._rule = self.rule(request.samples, request.width)
            self._learnt = 0

    def _learn(self, transition: Transition) -> Update | None:
        """Let the rule have a sample."""
        try:
            # To a new rule the run begins anew, its schedules with it.
            update = self._rule.observe(transition._replace(number=self._learnt))
        except DivergenceError:
            # The phase ends here; what it passed through before may still be good.
            self._episode.end_with_this()
            self._episode.take(transition)
            return None
        self._learnt += 1
        self._episode.take(transition, self._controller.theta)
        return update

    def _next(self) -> Update:
        """Give the plan what came of its request; begin the episode of the next one."""
        old, answered = self._controller.theta, self._request
        self._advance(self._episode.result(self._model))
        theta, blocks = self._controller.theta, self._controller.parameters.blocks
        return Update(
            td_error=float("nan"),
            step=float(np.linalg.norm((theta - old) / blocks.scale)),
            smallest_eigenvalue=certificate(blocks, theta).smallest,
            episode=self._request.episode if isinstance(self._request, Settle) else None,
            mark=isinstance(answered, Settle),
            rewind=isinstance(self._request, Trial) and self._request.begins,
        )

    def _advance(self, result: Result) -> None:
        assert self._search is not None
        answered = self._request
        try:
            self._request = self._plan.send(result)
        except StopIteration:
            self._request = None
        self._history.add(answered, result, self._search.expected)
        self._open()

    # checkpoints --------------------------------------------------------------------------------

    def state(self) -> dict[str, NDArray[Any]]:
        """The rule's state; under globalisation every result so far and the open episode's data."""
        rule = prefixed("rule ", self._rule.state())
        if self._search is None:
            return rule
        state = rule | self._episode.state()
        return state | {"learnt": np.array(self._learnt)} | self._history.state()

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        if self._search is not None:
            theta = self._controller.theta
            for result in results(state):
                self._advance(result)
            self._controller.theta = theta
            self._episode.restore(state)
            self._learnt = int(state["learnt"])
        self._rule.restore(group(state, "rule "))
