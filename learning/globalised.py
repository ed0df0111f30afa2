"""A learning rule made global: it proposes θ, validation on the plant disposes."""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.scenario import Scenario
from learning.configuration import Configuration
from learning.definiteness import certificate
from learning.episodes import Block, Learn, Learned, Request, Settle, Trial
from learning.errors import DivergenceError
from learning.exploration import Strategy
from learning.prediction_errors import OneStepModel
from learning.protocols import LearnableController, Transition, Update
from learning.validated_search import ValidatedSearch

Vector = NDArray[np.float64]
CANDIDATES = 3
"""θ of a phase of learning that are raced, at equal distances in samples."""
SENSITIVITIES = 100
"""Policy Jacobians, at most, that the metric of a block is the mean of."""


class Rule(Protocol):
    """A learning rule as the globalisation uses it; each algorithm of the package is one."""

    @property
    def needs_action_value(self) -> bool:
        """As in `Algorithm`."""

    @property
    def needs_points(self) -> bool:
        """As in `Algorithm`."""

    def observe(self, transition: Transition) -> Update | None:
        """As in `Algorithm`."""

    def state(self) -> dict[str, NDArray[Any]]:
        """As in `Algorithm`."""

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """As in `Algorithm`."""


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
        self._model = OneStepModel(scenario)
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
        update = self._take(transition)
        self._done += 1
        return update if self._done < self._length else self._next()

    def failed(self, cost: float) -> Update | None:
        """Count a sample at which the controller failed; its cost is the episode's."""
        if self._search is None or self._request is None:
            return None
        self._stage_cost += cost
        self._done += 1
        return None if self._done < self._length else self._next()

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
        self._learned: list[Learned] = []
        self._block_results: list[Block] = []
        self._request: Request | None = next(self._plan, None)
        self._open()

    def _open(self) -> None:
        """Make ready for the request that the plan has put."""
        request, search = self._request, self._search
        assert search is not None
        self._done, self._stage_cost, self._penalty = 0, 0.0, 0.0
        self._rows: list[tuple[Vector, Vector, Vector]] = []
        self._candidates: list[Vector] = []
        self._metric = np.zeros((self._controller.theta.size,) * 2)
        self._sensitive = 0
        self.explores = isinstance(request, Learn)
        if isinstance(request, Learn):
            self._length = request.samples
            self._controller.theta = request.theta
            if not request.goes_on:
                self._rule = self.rule(request.samples, request.width)
                self._learnt = 0
        elif request is not None:
            self._length = search.block
            self._controller.theta = request.theta
        else:
            self._controller.theta = search.incumbent.theta

    def _take(self, transition: Transition) -> Update | None:
        self._rows.append((transition.s, transition.a, transition.next_s))
        if not isinstance(self._request, Learn):
            self._stage_cost += transition.stage_cost
            self._penalty += transition.next_penalty
            every = max(self._length // SENSITIVITIES, 1)
            if self._sensitive_block and self._done % every == 0:
                jacobian = transition.policy.policy_jacobian / self._deviation[:, None]
                if np.isfinite(jacobian).all():
                    self._metric += jacobian.T @ jacobian
                    self._sensitive += 1
            return None
        update: Update | None = None
        if self._done < self._length:
            try:
                # To a new rule the run begins anew, its schedules with it.
                update = self._rule.observe(transition._replace(number=self._learnt))
                self._learnt += 1
            except DivergenceError:
                # The phase ends here; what it passed through before may still be good.
                self._length = self._done + 1
                return None
        if (self._done + 1) % max(self._length // CANDIDATES, 1) == 0:
            self._candidates.append(self._controller.theta.copy())
        return update

    def _next(self) -> Update:
        """Give the plan what came of its request; begin the episode of the next one."""
        result = self._result()
        if isinstance(result, Learned):
            self._learned.append(result)
        else:
            self._block_results.append(result)
        old, request = self._controller.theta, self._request
        self._advance(result)
        settled = isinstance(request, Settle)
        return Update(
            td_error=float("nan"),
            step=float(np.linalg.norm((self._controller.theta - old) / self._scale)),
            smallest_eigenvalue=certificate(
                self._controller.parameters.blocks, self._controller.theta
            ).smallest,
            episode=self._request.episode if isinstance(self._request, Settle) else None,
            mark=settled,
            rewind=isinstance(self._request, Trial) and self._request.begins,
        )

    @property
    def _sensitive_block(self) -> bool:
        return isinstance(self._request, Trial) and self._request.sensitive

    @property
    def _scale(self) -> Vector:
        return self._controller.parameters.blocks.scale

    def _advance(self, result: Learned | Block) -> None:
        try:
            self._request = self._plan.send(result)
        except StopIteration:
            self._request = None
        self._open()

    def _result(self) -> Learned | Block:
        n = self._scenario.state_lower.size
        rows = self._rows[-1000:] if isinstance(self._request, Learn) else self._rows
        predictions = np.array([self._model(s, a) for s, a, _ in rows]).reshape(-1, n)
        errors = np.array([after for _, _, after in rows]).reshape(-1, n) - predictions
        if not isinstance(self._request, Learn):
            metric = self._metric / max(self._sensitive, 1) if self._sensitive_block else None
            count = self._length
            return Block(
                self._stage_cost / count, self._penalty / count, predictions, errors, metric
            )
        states = np.array([s for s, _, _ in rows]).reshape(-1, n)
        candidates = np.array(self._candidates).reshape(-1, self._controller.theta.size)
        if not len(errors):
            errors, states = np.zeros((1, n)), np.zeros((1, n))
        return Learned(candidates, errors, states.std(axis=0))

    # checkpoints --------------------------------------------------------------------------------

    def state(self) -> dict[str, NDArray[Any]]:
        """The rule's state; under globalisation every result so far and the open episode's data."""
        rule = {f"rule {name}": values for name, values in self._rule.state().items()}
        if self._search is None:
            return rule
        n, size = self._scenario.state_lower.size, self._controller.theta.size
        state = rule | {
            "counts": np.array(
                [
                    self._done,
                    self._length,
                    self._stage_cost,
                    self._penalty,
                    self._sensitive,
                    self._learnt,
                ]
            ),
            "metric": self._metric.copy(),
            "candidates": np.array(self._candidates).reshape(-1, size),
            "results": np.array([len(self._learned), len(self._block_results)]),
        }
        for name, part in zip(("s", "a", "after"), zip(*self._rows, strict=True), strict=False):
            state[f"rows {name}"] = np.array(part)
        for k, learned in enumerate(self._learned):
            state |= {f"learned {k} {name}": v for name, v in learned._asdict().items()}
        for k, block in enumerate(self._block_results):
            state[f"block {k} costs"] = np.array([block.stage_cost, block.penalty])
            state[f"block {k} data"] = np.stack([block.predictions, block.errors]).reshape(2, -1, n)
            if block.metric is not None:
                state[f"block {k} metric"] = block.metric
        return state

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        rule = {k.removeprefix("rule "): v for k, v in state.items() if k.startswith("rule ")}
        if self._search is None:
            self._rule.restore(rule)
            return
        theta = self._controller.theta
        self._replay(state)
        self._controller.theta = theta
        done, length, self._stage_cost, self._penalty, sensitive, learnt = (
            float(value) for value in state["counts"]
        )
        self._done, self._length = int(done), int(length)
        self._sensitive, self._learnt = int(sensitive), int(learnt)
        self._metric = state["metric"].copy()
        self._candidates = [row.copy() for row in state["candidates"]]
        if "rows s" in state:
            parts = (state[f"rows {name}"] for name in ("s", "a", "after"))
            self._rows = list(zip(*parts, strict=True))
        self._rule.restore(rule)

    def _replay(self, state: dict[str, NDArray[Any]]) -> None:
        """Put the plan where it was by the results that it had been given."""
        counts = [int(value) for value in state["results"]]
        while len(self._learned) < counts[0] or len(self._block_results) < counts[1]:
            if isinstance(self._request, Learn):
                prefix = f"learned {len(self._learned)}"
                learned = Learned(*(state[f"{prefix} {name}"] for name in Learned._fields))
                self._learned.append(learned)
                self._advance(learned)
                continue
            prefix = f"block {len(self._block_results)}"
            stage_cost, penalty = (float(value) for value in state[f"{prefix} costs"])
            predictions, errors = state[f"{prefix} data"]
            metric = state.get(f"{prefix} metric")
            block = Block(stage_cost, penalty, predictions, errors, metric)
            self._block_results.append(block)
            self._advance(block)
