"""The search: a plant that can be put back decides which θ is kept, with a learning rule or none.

`learning.search_plan` says what to try; `Search` carries it out as an algorithm.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from learning.actor_critic import ActorCritic
from learning.algorithm import Algorithm, Transition, Update
from learning.batch_q_learning import BatchQLearning
from learning.checkpoint import group
from learning.configuration import Configuration, Count
from learning.errors import ConfigurationError, DivergenceError
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
from learning.step import moved

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
    """The `done` of `length` samples of a request; `deviation` (m,) is the exploration's σ."""

    KEPT = (
        *("done", "length", "_stage_cost", "_penalty", "_rows", "_candidates", "_metric"),
        "_jacobians",
    )

    def __init__(self, request: Request | None, length: int, deviation: Vector, size: int) -> None:
        self._learns = isinstance(request, Learn)
        self._sensitive = isinstance(request, Trial) and request.sensitive
        self._deviation = deviation
        self.done, self.length = 0, length
        self._stage_cost, self._penalty = 0.0, 0.0
        self._rows: list[Vector] = []
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
        self._rows.append(np.concatenate([transition.s, transition.a, transition.next_s]))
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
        n, width = model.states, model.states + len(self._deviation)
        rows = np.array(self._rows[-LATEST:] if self._learns else self._rows).reshape(-1, width + n)
        states = rows[:, :n]
        predictions = np.array([model(row[:n], row[n:width]) for row in rows]).reshape(-1, n)
        errors = rows[:, width:] - predictions
        if not self._learns:
            metric = self._metric / max(self._jacobians, 1) if self._sensitive else None
            count = self.length
            return Block(
                self._stage_cost / count, self._penalty / count, predictions, errors, metric
            )
        candidates = np.array(self._candidates).reshape(-1, len(self._metric))
        if not len(errors):
            errors, states = np.zeros((1, n)), np.zeros((1, n))
        return Learned(candidates, errors, states.std(axis=0), errors.std(axis=0))


class Search(Algorithm):
    """An algorithm that carries a `SearchPlan` out; a rule learns in its phases, or none does.

    `theta` is the incumbent: what the run hands over, while the controller carries the θ that is
    being tried. The samples of learning and of comparisons are all the run's. A checkpoint keeps
    the results that the plan was given, but for prediction errors that no longer count, and
    `restore` gives them once more: the plan is deterministic, so it comes back to where it was.
    """

    Configuration = SearchConfiguration
    KEPT = ("_comparison", "_episode", "_learnt", "_rule")
    asks_for = "simulator"
    configuration: SearchConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings, scenario = self.configuration, self.scenario
        self._learnt, self._rules_made = 0, 0
        seed = int(self.rng.integers(2**63))
        self._rule = self._make_rule(self.samples, 1.0)
        self._deviation = np.broadcast_to(settings.deviation(scenario), scenario.action_lower.shape)
        self._model = OneStepModel(scenario)
        block, blocks = settings.block, settings.blocks
        search = SearchPlan(
            scenario,
            self.controller.parameters,
            self._deviation,
            self.samples,
            seed,
            phase=blocks * block if self._rule is None else settings.phase,
            block=block,
            blocks=blocks,
        )
        self._comparison, self._plan = search.comparison, search.plan()
        self._results: list[Result] = []
        self._request: Request | None = next(self._plan, None)
        self._open()

    def _make_rule(self, samples: int, width: float) -> Algorithm | None:
        """The rule for a phase of `samples` samples from the controller's present θ.

        Its prior or trust region is `width` times as wide as in the first phase.
        """
        settings = self.configuration
        if settings.rule == "none":
            return None
        first = settings.q_learning_first and self._rules_made % 2 == 0
        name = "q-learning" if first else settings.rule
        self._rules_made += 1
        chosen = settings.rule_configuration(name).narrowed(width)
        # Comparisons decide on the mean cost; the rule inside has the scenario's discount.
        if getattr(chosen, "discount", 1.0) is None:
            chosen = chosen.model_copy(update={"discount": self.scenario.discount})
        made: Algorithm = RULES[name](
            self.controller, self.scenario, chosen, samples, self.strategy, self.rng
        )
        return made

    @property
    def theta(self) -> Vector:
        """The incumbent, (n_θ,): it has won a comparison, or it is the start."""
        return self._comparison.incumbent.theta

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
        request, controller = self._request, self.controller
        controller.theta = self.theta if request is None else request.theta
        learns = isinstance(request, Learn)
        length = request.samples if isinstance(request, Learn) else self._comparison.block
        self._episode = EpisodeData(request, length, self._deviation, controller.theta.size)
        if isinstance(request, Learn) and not request.goes_on:
            self._rule = self._make_rule(request.samples, request.width)
            self._learnt = 0
        rule = self._rule if learns else None
        self.explores = rule is not None
        self.needs_action_value = rule is not None and rule.needs_action_value
        self.needs_points = rule is not None and rule.needs_points

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
        self._episode.take(transition, self.controller.theta)
        return update

    def _next(self) -> Update:
        """Give the plan what came of its request; begin the episode of the next one."""
        old, answered = self.controller.theta, self._request
        self._advance(self._episode.result(self._model))
        theta, blocks = self.controller.theta, self.controller.parameters.blocks
        return moved(
            blocks,
            old,
            theta,
            episode=self._request.episode if isinstance(self._request, Settle) else None,
            mark=isinstance(answered, Settle),
            rewind=isinstance(self._request, Trial) and self._request.begins,
        )

    def _advance(self, result: Result) -> None:
        try:
            self._request = self._plan.send(result)
        except StopIteration:
            self._request = None
        none = np.zeros((0, self._model.states))
        if isinstance(result, Block):
            expected = self._comparison.expected
            result = result._replace(predictions=none, expected=expected)
        self._results.append(result._replace(errors=none))
        self._open()

    def state(self) -> dict[str, NDArray[Any]]:
        """Every result so far, the errors that count, the open episode's data, the rule's state."""
        state = super().state() | {"results": np.array(len(self._results))}
        for k, result in enumerate(self._results):
            kept = {name: part for name, part in result._asdict().items() if part is not None}
            state |= {f"result {k} {name}": np.asarray(part) for name, part in kept.items()}
        return state

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        theta = self.controller.theta
        for k in range(int(state["results"])):
            kept: dict[str, Any] = group(state, f"result {k} ")
            for name in kept.keys() & {"stage_cost", "penalty", "expected"}:
                kept[name] = float(kept[name])
            self._advance(Learned(**kept) if "candidates" in kept else Block(**kept))
        self.controller.theta = theta
        super().restore(state)
