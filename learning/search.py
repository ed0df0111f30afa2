"""The search: a plant that can be put back decides which θ is kept, with a learning rule or none.

`learning.search_plan` says what to try; `Search` carries it out as an algorithm.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from cosim.scenario import Scenario
from learning.actor_critic import ActorCritic
from learning.algorithm import LearnableController, Rule, Transition, Update
from learning.batch_q_learning import BatchQLearning
from learning.checkpoint import group, prefixed
from learning.configuration import Configuration, Count
from learning.errors import ConfigurationError, DivergenceError
from learning.exploration import Strategy
from learning.prediction_errors import OneStepModel
from learning.q_learning import QLearning
from learning.search_plan import (
    Block,
    Learn,
    Learned,
    Request,
    Result,
    SearchPlan,
    Settle,
    Trial,
)
from learning.step import certificate

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
RULES: dict[str, Any] = {
    "q-learning": QLearning,
    "batch-q-learning": BatchQLearning,
    "actor-critic": ActorCritic,
}
CANDIDATES = 3
"""θ of a phase of learning that are compared, at equal distances in samples."""
SENSITIVITIES = 100
"""Policy Jacobians, at most, that the metric of a block is the mean of."""
LATEST = 1000
"""Samples of a phase of learning whose prediction errors are kept."""
ROW = ("s", "a", "after")


class SearchConfiguration(Configuration):
    """Settings of the search; those of its rule are the table `rule_settings`."""

    rule: Literal["none", "q-learning", "batch-q-learning", "actor-critic"] = Field(
        "none",
        description="what learns in the phases between the comparisons; none: θ rests in them, and "
        "they last blocks × block samples",
    )
    rule_settings: dict[str, Any] = Field(
        {}, description="the rule's own settings, as rule_settings = {prior_width = 0.1}"
    )
    q_learning_first: bool = Field(
        False,
        description="phases of Q-learning come before those of the rule, and in turn with them: a "
        "policy gradient alone finds no way out of a start that violates its bounds",
    )
    phase: Count = Field(2500, description="samples of learning between comparisons")
    block: Count = Field(100, description="samples of a block of a comparison")
    blocks: Count = Field(8, description="blocks of a comparison that is not decided before")

    def rule_configuration(self, name: str) -> Any:
        """Settings of a rule in the search: those that they share, and the rule's own."""
        shared = {field: getattr(self, field) for field in Configuration.model_fields}
        own = self.rule_settings if name == self.rule else {}
        return RULES[name].Configuration.from_dict(shared | own)

    def without_part(self) -> Mapping[str, str]:
        """The settings that only a search with a rule has."""
        names = ("phase", "rule_settings", "q_learning_first") if self.rule == "none" else ()
        return dict.fromkeys(names, "a search without a rule")

    def depends_on_samples(self) -> list[str]:
        """The plan shares the samples out."""
        return [*super().depends_on_samples(), "samples (shared out by the search)"]

    @model_validator(mode="after")
    def _take_over_from_the_rule(self) -> Self:
        """Explore as the rule would, unless told otherwise; refuse settings that it lacks."""
        if shared := sorted(self.rule_settings.keys() & Configuration.model_fields.keys()):
            raise ValueError(f"rule_settings: {shared[0]} is a setting of the search itself")
        rule = "q-learning" if self.rule == "none" else self.rule
        fields = RULES[rule].Configuration.model_fields
        for name in ("exploration_probability", "exploration_share"):
            if name not in self.model_fields_set:
                # Not by `setattr`: it is still a default, which a scenario may replace.
                self.__dict__[name] = fields[name].default
        if self.rule != "none":
            try:
                self.rule_configuration(self.rule)
            except ConfigurationError as error:
                raise ValueError(f"rule_settings: {error}") from None
        return self


class EpisodeData:
    """The `done` of `length` samples of a request's episode.

    `deviation` (m,) is the exploration's σ; `size` is n_θ and `states` n.
    """

    def __init__(
        self, request: Request | None, length: int, deviation: Vector, size: int, states: int
    ) -> None:
        self._learns = isinstance(request, Learn)
        self._sensitive = isinstance(request, Trial) and request.sensitive
        self._deviation, self._states = deviation, states
        self.done, self.length = 0, length
        self._stage_cost, self._penalty = 0.0, 0.0
        self._rows: list[tuple[Vector, ...]] = []
        self._candidates: list[Vector] = []
        self._metric: Matrix = np.zeros((size, size))
        self._jacobians = 0

    @property
    def over(self) -> bool:
        """Whether all samples are done."""
        return self.done >= self.length

    def end_with_this(self) -> None:
        """Let the sample that is coming be the last one."""
        self.length = self.done + 1

    def take(self, transition: Transition, theta: Vector | None = None) -> None:
        """Take a sample, and θ (n_θ,) after it, where that may be a candidate."""
        self._rows.append((transition.s, transition.a, transition.next_s))
        if not self._learns:
            self._judge(transition)
        elif theta is not None and (self.done + 1) % max(self.length // CANDIDATES, 1) == 0:
            self._candidates.append(theta.copy())
        self.done += 1

    def fail(self, cost: float) -> None:
        """Take a sample at which the controller failed, with its share of J."""
        self._stage_cost += cost
        self.done += 1

    def _judge(self, transition: Transition) -> None:
        self._stage_cost += transition.stage_cost
        self._penalty += transition.next_penalty
        if self._sensitive and self.done % max(self.length // SENSITIVITIES, 1) == 0:
            jacobian = transition.policy.policy_jacobian / self._deviation[:, None]
            if np.isfinite(jacobian).all():
                self._metric += jacobian.T @ jacobian
                self._jacobians += 1

    def result(self, model: OneStepModel) -> Result:
        """What came of the episode, its predictions by the controller's own `model`."""
        n, rows = self._states, self._rows[-LATEST:] if self._learns else self._rows
        predictions = np.array([model(s, a) for s, a, _ in rows]).reshape(-1, n)
        errors = np.array([after for _, _, after in rows]).reshape(-1, n) - predictions
        if not self._learns:
            metric = self._metric / max(self._jacobians, 1) if self._sensitive else None
            count = self.length
            return Block(
                self._stage_cost / count, self._penalty / count, predictions, errors, metric
            )
        states = np.array([s for s, _, _ in rows]).reshape(-1, n)
        candidates = np.array(self._candidates).reshape(-1, len(self._metric))
        if not len(errors):
            errors, states = np.zeros((1, n)), np.zeros((1, n))
        return Learned(candidates, errors, states.std(axis=0), errors.std(axis=0))

    def state(self) -> dict[str, NDArray[Any]]:
        """All that was taken, as arrays."""
        counts = [self.done, self.length, self._stage_cost, self._penalty, self._jacobians]
        state: dict[str, NDArray[Any]] = {
            "counts": np.array(counts),
            "metric": self._metric.copy(),
            "candidates": np.array(self._candidates).reshape(-1, len(self._metric)),
        }
        for name, part in zip(ROW, zip(*self._rows, strict=True), strict=False):
            state[f"rows {name}"] = np.array(part)
        return state

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        done, length, self._stage_cost, self._penalty, jacobians = map(float, state["counts"])
        self.done, self.length, self._jacobians = int(done), int(length), int(jacobians)
        self._metric = state["metric"].copy()
        self._candidates = [row.copy() for row in state["candidates"]]
        if "rows s" in state:
            self._rows = list(zip(*(state[f"rows {name}"] for name in ROW), strict=True))


class Search:
    """An algorithm that carries a `SearchPlan` out; a rule learns in its phases, or none does.

    `theta` is the incumbent: what the run hands over, while the controller carries the θ that is
    being tried. The samples of learning and of comparisons are all the run's. A checkpoint keeps
    the results that the plan was given, but for prediction errors that no longer count, and
    `restore` gives them once more: the plan is deterministic, so it comes back to where it was.
    """

    Configuration: ClassVar[type[Configuration]] = SearchConfiguration
    asks_for: ClassVar[Literal["operation", "simulator"]] = "simulator"

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: SearchConfiguration,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None:
        self._controller, self._scenario, self._configuration = controller, scenario, configuration
        self._strategy, self._rng = strategy, rng
        self._learnt, self._rules_made = 0, 0
        self.explores = True
        """Whether the samples explore now."""
        seed = int(rng.integers(2**63))
        self._rule = self._make_rule(samples, 1.0)
        self._deviation = np.broadcast_to(
            configuration.deviation(scenario), scenario.action_lower.shape
        )
        self._model, self._states = OneStepModel(scenario), scenario.state_lower.size
        block, blocks = configuration.block, configuration.blocks
        self._search = SearchPlan(
            scenario,
            controller.parameters,
            self._deviation,
            samples,
            seed,
            phase=blocks * block if self._rule is None else configuration.phase,
            block=block,
            blocks=blocks,
        )
        self._plan = self._search.plan()
        self._results: list[Result] = []
        self._request: Request | None = next(self._plan, None)
        self._open()

    def _make_rule(self, samples: int, width: float) -> Rule | None:
        """The rule for a phase of `samples` samples from the controller's present θ.

        Its prior or trust region is `width` times as wide as in the first phase.
        """
        settings = self._configuration
        if settings.rule == "none":
            return None
        first = settings.q_learning_first and self._rules_made % 2 == 0
        name = "q-learning" if first else settings.rule
        self._rules_made += 1
        chosen = settings.rule_configuration(name).narrowed(width)
        # Comparisons decide on the mean cost; the rule inside has the scenario's discount.
        if getattr(chosen, "discount", 1.0) is None:
            chosen = chosen.model_copy(update={"discount": self._scenario.discount})
        made: Rule = RULES[name](
            self._controller,
            self._scenario,
            chosen,
            samples,
            self._strategy,
            self._rng,
        )
        return made

    @property
    def needs_action_value(self) -> bool:
        """Whether Q of explored samples is asked for."""
        return self.explores and self._rule is not None and self._rule.needs_action_value

    @property
    def needs_points(self) -> bool:
        """Whether linearisation points are asked for."""
        return self.explores and self._rule is not None and self._rule.needs_points

    @property
    def theta(self) -> Vector:
        """The incumbent, (n_θ,): it has won a comparison, or it is the start."""
        return self._search.comparison.incumbent.theta

    @property
    def accepted(self) -> int:
        """How often the incumbent changed."""
        return self._search.comparison.accepted

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; the last of an episode begins the next one."""
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
        if self._request is None:
            return None
        self._episode.fail(cost)
        return self._next() if self._episode.over else None

    def _open(self) -> None:
        """Make ready for the request that the plan has put."""
        request, controller = self._request, self._controller
        controller.theta = self.theta if request is None else request.theta
        learns = isinstance(request, Learn)
        self.explores = learns and self._rule is not None
        length = request.samples if isinstance(request, Learn) else self._search.comparison.block
        self._episode = EpisodeData(
            request, length, self._deviation, controller.theta.size, self._states
        )
        if isinstance(request, Learn) and not request.goes_on:
            self._rule = self._make_rule(request.samples, request.width)
            self._learnt = 0

    def _learn(self, transition: Transition) -> Update | None:
        """Let the rule have a sample."""
        if self._rule is None:
            self._episode.take(transition)
            return None
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
        try:
            self._request = self._plan.send(result)
        except StopIteration:
            self._request = None
        none = np.zeros((0, self._states))
        if isinstance(result, Block):
            expected = self._search.comparison.expected
            result = result._replace(predictions=none, expected=expected)
        self._results.append(result._replace(errors=none))
        self._open()

    def state(self) -> dict[str, NDArray[Any]]:
        """Every result so far, the errors that count, the open episode's data, the rule's state."""
        state = self._episode.state() | self._search.comparison.state()
        state |= {"learnt": np.array(self._learnt), "results": np.array(len(self._results))}
        for k, result in enumerate(self._results):
            kept = {name: part for name, part in result._asdict().items() if part is not None}
            state |= {f"result {k} {name}": np.asarray(part) for name, part in kept.items()}
        return state | ({} if self._rule is None else prefixed("rule ", self._rule.state()))

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        theta = self._controller.theta
        for k in range(int(state["results"])):
            kept: dict[str, Any] = group(state, f"result {k} ")
            for name in kept.keys() & {"stage_cost", "penalty", "expected"}:
                kept[name] = float(kept[name])
            self._advance(Learned(**kept) if "candidates" in kept else Block(**kept))
        self._search.comparison.restore(state)
        self._controller.theta = theta
        self._episode.restore(state)
        self._learnt = int(state["learnt"])
        if self._rule is not None:
            self._rule.restore(group(state, "rule "))
