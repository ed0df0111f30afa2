"""The search: a simulator decides which θ is kept, with or without a learning rule.

`SearchPlan` decides what to try next. It yields episodes (`Trial`), reads their answers, and knows
no plant, controller or rule. `Search` takes the episodes as an algorithm.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from controllers.errors import ParameterError
from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector
from cosim.scenario import Scenario
from learning.actor_critic import ActorCritic
from learning.algorithm import Algorithm, Transition, Update
from learning.batch_q_learning import BatchQLearning
from learning.configuration import Configuration, Count
from learning.episodes import Episode, Planned, Told
from learning.errors import DivergenceError
from learning.prediction_errors import OneStepModel, SortedErrors, expected_penalties
from learning.q_learning import QLearning
from learning.step import clip_eigenvalues, prior_deviation, smallest_eigenvalue

RULES: dict[str, type[Algorithm]] = {
    "q-learning": QLearning,
    "batch-q-learning": BatchQLearning,
    "actor-critic": ActorCritic,
}
PRIOR_WIDTH = 0.3
"""Prior width of a rule within the search: wider than alone, since the search judges each θ."""
RULE_DEFAULTS = {
    "prior_width": PRIOR_WIDTH,
    "variance_memory": 2000.0,
    "largest_step": 0.0,
    "mean_cost_memory": 0.0,
}
"""Hyperparameters of a rule within the search that differ from those of the rule alone."""
CANDIDATES = 3
"""θ of a phase of learning that are compared, at equal distances in samples."""
SENSITIVITIES = 100
"""Largest number of policy Jacobians in the metric of a stretch."""
LATEST = 1000
"""Samples of a phase of learning whose prediction errors are kept."""
ROUNDING = 1e-9
"""Share of a cost that counts as rounding."""
NONE: Matrix = np.zeros((0, 0))


@dataclass(eq=False)
class Trial(Episode):
    """θ (n_θ,) runs greedily for a stretch, or is where the rule `learns` from.

    The rule goes on with its data, or with a `width` begins anew, its prior or trust region so many
    times as wide; it leaves `candidates` (n_θ,), the last one where it ended. What a stretch may
    `measure` is dπ/dθ, in the exploration's σ, (m, n_θ).
    """

    KEPT = (*Episode.KEPT, "candidates")
    learns: bool = False
    width: float | None = None
    candidates: list[Vector] = field(default_factory=list, init=False)


Plan = Generator[Trial, None, None]
Verdict = Generator[Trial, None, bool]


class Spent(Exception):
    """The samples are used up."""


class Candidate:
    """A θ with the mean `costs` of its stretches so far, of two readings the larger.

    The realised penalty is rare spikes. The expected one, with pooled errors, is too large where
    the errors depend on the state, by 10 to 20 a sample near the best back-off of `paper`.
    """

    def __init__(self, theta: Vector) -> None:
        self.theta, self.costs = theta, np.zeros(0)


def cheaper(difference: Vector) -> bool:
    """Whether costs that differ so, stretch by stretch, are lower by a standard error."""
    stretches = len(difference)
    error = float(difference.std(ddof=1)) / stretches**0.5 if stretches > 1 else 0.0
    return float(difference.mean()) + error < 0.0


def _patience(costs: Vector) -> float:
    """Loss of a candidate, summed over its stretches, that their own spread still explains."""
    return float(costs.std()) * len(costs)


class SearchPlan:
    """Phases of learning, each followed by line searches on common noise (docs/method.md).

    All comparisons of a round begin at the snapshot at the end of its learning, with the same noise
    to come. The `incumbent` has won a comparison, or is the start. Candidates are compared with
    `base`: the incumbent, or the centre of a line search that has not won yet. Where no learnt θ
    won, comparisons become twice as long and the next phase has half the width. Without a rule θ
    rests in the phases of learning, which then only measure the coordinates of the line searches
    (`prior_deviation`).

    `scenario` gives bounds and penalty; `action_deviation` (m,) is the exploration's σ, `samples`
    the budget. A comparison has up to `stretches` stretches of `stretch` samples, a phase `phase`.
    """

    KEPT = ("_errors", "_pool")
    MEMORY = 6000
    """Prediction errors kept for expected penalties, whose tail counts."""
    FINAL = 0.25
    """Share of the samples for the last comparison."""
    FINALISTS = 3.2
    """Runs over all stretches of the last comparison that its samples suffice for."""
    DIRECTIONS = 4
    CAP = 1.5
    """Longest first step of a line search, in the prior's standard deviations."""

    def __init__(
        self,
        scenario: Scenario,
        start: Parameters,
        action_deviation: Vector,
        samples: int,
        seed: int,
        *,
        phase: int,
        stretch: int,
        stretches: int,
    ) -> None:
        self._penalty, self._states = scenario.state_penalty, scenario.state_lower.size
        self._start, self._blocks = start, start.blocks
        self._action_deviation, self._samples = action_deviation, samples
        # A short run has short phases and comparisons.
        self._phase = min(phase, max(samples // 8, 1))
        self.stretch, self._stretches = min(stretch, max(samples // 100, 1)), stretches
        self._longer = 2 * stretches
        self._rng = np.random.default_rng(seed)
        self.least = 0.5 * max(smallest_eigenvalue(start.blocks, start.theta), 0.0)
        """Least eigenvalue that the Hessians of a candidate may have."""
        self.spent, self._limit = 0, samples
        self._errors: Matrix = np.zeros((0, self._states))
        self._pool = SortedErrors(self._errors)
        self.base = self.incumbent = Candidate(start.theta)
        self._scale: Vector = np.ones(start.theta.size)
        self._past = [start.theta]

    def plan(self) -> Plan:
        """The whole run."""
        self._limit = int((1.0 - self.FINAL) * self._samples)
        with suppress(Spent):
            yield from self._rounds()
        self._limit = self._samples
        stretches = max(int(self.FINAL * self._samples / self.stretch / self.FINALISTS), 1)
        last = len(self._past) - 1
        order = dict.fromkeys([0, last, last // 2, *range(last - 1, 0, -1)])
        # The best of many moves is partly luck, and a round too short for rare events.
        incumbent = self.incumbent.theta
        rivals = [self._past[k] for k in order if not np.array_equal(self._past[k], incumbent)]
        with suppress(Spent):
            yield from self.final(rivals, stretches, int(self._rng.integers(2**31)))

    def _rounds(self) -> Plan:
        back_off, weights, reach = 1.0, -1.0, np.full(self.DIRECTIONS, 0.5)
        bounds = [0.5] * self._states
        width, number, better, rescaled, failed, rest = 1.0, 0, True, False, 0, 0
        while True:
            before = self.incumbent.theta
            # At the end too few samples may be left for learning, not for a search.
            needed = self._phase + self._stretches * self.stretch
            if self._limit - self.spent >= needed and rest == 0:
                better = yield from self._learn(None if better and not rescaled else width)
                failed = 0 if better else failed + 1
                width, rest = (width, 0) if better else (0.5 * width, failed)
            else:
                better = False
                yield from self._renew()
            if not better:
                self._stretches = self._longer
            rest = max(rest - 1, 0)
            back_off = yield from self._along(self._tightening(), min(back_off, 1.0))
            unscaled = self.incumbent
            weights = yield from self._rescale(weights)
            rescaled = self.incumbent is not unscaled
            # While learning pays, searching would only cost samples.
            if not better:
                for state in range(self._states):
                    tightening = self._tightening(state)
                    bounds[state] = yield from self._along(tightening, min(bounds[state], 1.0))
                directions = yield from self._directions(turned=number > 0)
                for j, direction in enumerate(directions.T):
                    reach[j] = yield from self._along(direction, float(np.clip(reach[j], 0.05, 1)))
                way = (self.incumbent.theta - before) / self._scale
                if way.any():
                    yield from self._along(way, 0.5)
                number += 1
            if not np.array_equal(before, self._past[-1]):
                self._past.append(before)

    def _renew(self) -> Plan:
        """Run the incumbent on new noise, and compare its predecessor with it once more."""
        past = self._past[-1]
        yield from self.renew(self._stretches)
        if not np.array_equal(past, self.incumbent.theta):
            yield from self.compare(past, patient=True)

    def _learn(self, width: float | None) -> Verdict:
        """Learn from the incumbent, then compare the candidates, the latest first."""
        trial = Trial(self.incumbent.theta, self._phase, learns=True, width=width)
        told, _, errors = yield from self._ask(trial)
        # The coordinates of the searches, from the latest data about the incumbent.
        start = self._start.with_theta(self.incumbent.theta)
        level, (s, e) = abs(float(start["c_lambda"])), told["deviations"]
        self._scale = prior_deviation(start, s, e, self._action_deviation, level, PRIOR_WIDTH)
        self._remember(errors)
        yield from self._renew()
        better = False
        for theta in told["candidates"][::-1]:
            better |= yield from self.compare(theta)
        return better

    def _along(self, direction: Vector, reach: float) -> Generator[Trial, None, float]:
        """Line search both ways in scaled θ, (n_θ,); returns the first step of the next time."""
        longest = self.CAP / max(float(np.abs(direction).max()), np.finfo(float).tiny)
        origin, quarter = self.base.theta, max(len(self.base.costs) // 4, 1)
        for sign in (1.0, -1.0):
            # Steps that win over a quarter of the stretches are doubled; the longest runs all.
            step, best, costs = sign * min(reach, longest), 0.0, self.base.costs[:quarter]
            while abs(step) <= 4.0 * longest:
                found = yield from self._screen(origin + self._scale * (step * direction), costs)
                if found is None:
                    break
                best, costs = step, found.costs
                step *= 2.0
            while abs(best) >= min(reach, longest):
                if (yield from self.compare(origin + self._scale * (best * direction))):
                    return abs(best)
                best *= 0.5
        return 0.5 * reach

    def _tightening(self, state: int | None = None) -> Vector:
        """All state bounds, or one state's, moved inwards by half their deviation, (n_θ,)."""
        direction = np.zeros_like(self._scale)
        for name, inwards in (("x_l", 0.5), ("x_u", -0.5)):
            where = np.arange(direction.size)[self._blocks.slices[name]]
            direction[where if state is None else where[state]] = inwards
        return direction

    def _directions(self, *, turned: bool) -> Generator[Trial, None, Matrix]:
        """Directions in scaled θ that change the policy by the exploration's σ, (n_θ, K)."""

        def sensitivity(transition: Transition, number: int) -> Matrix | None:
            if number % max(self.stretch // SENSITIVITIES, 1):
                return None
            return transition.policy.policy_jacobian / self._action_deviation[:, None]

        trial = Trial(self.base.theta, self.stretch, rewind=True, measure=sensitivity)
        told, _, _ = yield from self._ask(trial)
        values, vectors = np.linalg.eigh(told["metric"] * np.outer(self._scale, self._scale))
        values, vectors = values[::-1][: self.DIRECTIONS], vectors[:, ::-1][:, : self.DIRECTIONS]
        directions = vectors / np.sqrt(np.maximum(values, 1e-12))
        if turned:
            draw = self._rng.standard_normal((directions.shape[1],) * 2)
            directions = directions @ np.linalg.qr(draw)[0]
        return np.asarray(directions)

    def _rescale(self, decades: float) -> Generator[Trial, None, float]:
        """Search over the inputs' weights, each with its own back-off; the next time's step."""
        found = False
        while True:
            kept, least = self.incumbent, self.least
            theta = self._weighted(10.0**decades)
            self.least = min(least, 0.5 * smallest_eigenvalue(self._blocks, theta))
            self.base = Candidate(theta)
            for _ in range(len(kept.costs)):
                yield from self._run(self.base)
            yield from self._along(self._tightening(), 0.5)
            if not cheaper(self.base.costs - kept.costs):
                self.base, self.least = kept, least
                return decades if found else -0.7 * decades
            self.incumbent, found = self.base, True

    def _weighted(self, factor: float) -> Vector:
        """The incumbent with its input weights times `factor`, the cost's minimum kept, (n_θ,)."""
        parameters = self._start.with_theta(self.base.theta)
        hessian, gradient = parameters["B_l"], parameters["b_l"]
        scale = np.ones(len(gradient))
        scale[-self._action_deviation.size :] = factor**0.5
        minimiser = np.linalg.solve(hessian, gradient)
        hessian = hessian * np.outer(scale, scale)
        return parameters.replace({"B_l": hessian, "b_l": hessian @ minimiser}).theta

    def _ask(self, trial: Trial) -> Generator[Trial, None, tuple[Told, Matrix, Matrix]]:
        """What a trial told; apart its predictions and errors, of which no checkpoint has a use.

        Raises Spent where its samples are beyond the limit.
        """
        if self.spent + trial.length > self._limit:
            raise Spent
        self.spent += trial.length
        yield trial
        told = trial.answer
        return told, told.pop("predictions", NONE), told.pop("errors", NONE)

    def _remember(self, errors: Matrix) -> None:
        """Keep prediction errors (K, n) for the pools of the rounds to come."""
        kept = [self._errors, errors.reshape(-1, self._states)]
        self._errors = np.concatenate(kept)[-self.MEMORY :]

    def _run(self, candidate: Candidate) -> Plan:
        """One more stretch of a candidate, always on from its last one."""
        trial = Trial(candidate.theta, self.stretch, rewind=not len(candidate.costs))
        told, predictions, errors = yield from self._ask(trial)
        cost, penalty = map(float, told["cost"])
        if "expected" not in told:
            told["expected"] = penalty  # where there is no pool yet
            if len(predictions) and len(self._pool.errors):
                due = expected_penalties(self._penalty, predictions, self._pool)
                told["expected"] = float(due.mean(axis=-1).cumsum()[-1])
        larger = np.maximum(cost + penalty, cost + told["expected"])
        candidate.costs = np.append(candidate.costs, larger)
        self._remember(errors)

    def renew(self, stretches: int, seed: int | None = None) -> Plan:
        """Run the incumbent on new noise: on from where the plant is, or after a reset."""
        yield from self._ask(Trial(self.incumbent.theta, self.stretch, seed, mark=True))
        # One pool for the whole round, so that all θ are judged alike.
        self._pool = SortedErrors(self._errors)
        self.base = self.incumbent = Candidate(self.incumbent.theta)
        for _ in range(stretches):
            yield from self._run(self.incumbent)

    def compare(self, theta: Vector, *, patient: bool = False) -> Verdict:
        """Whether θ takes the base's place: cheaper on the same noise by a standard error.

        Stops once θ's summed cost exceeds the base's; with `patient`, once the stretches left
        cannot make up for it. A winner has run all stretches, since slow states show effects late.
        """
        costs = self.base.costs
        candidate = yield from self._screen(theta, costs, _patience(costs) if patient else 0.0)
        if candidate is None or not cheaper(candidate.costs - costs):
            return False
        if self.base is self.incumbent:
            self.incumbent = candidate
        self.base = candidate
        return True

    def _screen(
        self, theta: Vector, costs: Vector, patience: float = 0.0
    ) -> Generator[Trial, None, Candidate | None]:
        """θ with its first stretches if it is never dearer on them, else None."""
        admissible = self.admissible(theta)
        if admissible is None:
            return None
        candidate = Candidate(admissible)
        for count in range(1, len(costs) + 1):
            yield from self._run(candidate)
            if (candidate.costs - costs[:count]).sum() >= patience - ROUNDING * abs(costs[0]):
                return None
        return candidate

    def final(self, rivals: list[Vector], stretches: int, seed: int) -> Plan:
        """Make the cheapest of the incumbent and its rivals (n_θ,) the incumbent.

        Each runs over `stretches` stretches of new noise. A rival is given up once its other
        stretches can no longer make up for its loss. The start is left only for a θ that is cheaper
        by a standard error: the best of many is partly luck.
        """
        yield from self.renew(stretches, seed)
        costs = self.incumbent.costs
        patience = _patience(costs) if stretches > 1 else np.inf
        finalists = [self.incumbent]
        for theta in rivals:
            rival = yield from self._screen(theta, costs, patience)
            if rival is not None:
                finalists.append(rival)
                self.base = self.incumbent = self._winner(finalists)

    def _winner(self, finalists: list[Candidate]) -> Candidate:
        """The cheapest; the start, where it is not dearer by a standard error."""
        best = min(finalists, key=lambda candidate: float(candidate.costs.mean()))
        for candidate in finalists:
            start = np.array_equal(candidate.theta, self._start.theta)
            if start and not cheaper(best.costs - candidate.costs):
                return candidate
        return best

    def admissible(self, theta: Vector) -> Vector | None:
        """θ with definite Hessians; None if bounds cross or a slack weight is ≤ 0."""
        if not np.isfinite(theta).all():
            return None
        if smallest_eigenvalue(self._blocks, theta) < self.least:
            theta = clip_eigenvalues(self._blocks, theta, self.least)
        with suppress(ParameterError):
            Parameters(self._blocks, theta).require_well_posed()
            return theta
        return None


class SearchConfiguration(Configuration):
    """Settings of the search; its rule has its own defaults but for `RULE_DEFAULTS`."""

    rule: Literal["none", "q-learning", "batch-q-learning", "actor-critic"] = Field(
        "none",
        description="what learns in the phases between the comparisons; none: θ rests in them, and "
        "they last stretches × stretch samples",
    )
    q_learning_first: bool = Field(
        False,
        description="phases of Q-learning come before those of the rule, and in turn with them: a "
        "policy gradient alone finds no way out of a start that violates its bounds",
    )
    phase: Count = Field(2500, description="samples of learning between comparisons")
    stretch: Count = Field(100, description="samples of a stretch of a comparison")
    stretches: Count = Field(8, description="stretches of a comparison that is not decided before")

    def rule_configuration(self, name: str) -> Any:
        """Settings of a rule in the search: those that they share, and `RULE_DEFAULTS`."""
        shared = {field: getattr(self, field) for field in Configuration.model_fields}
        rule = RULES[name].Configuration
        own = {key: value for key, value in RULE_DEFAULTS.items() if key in rule.model_fields}
        return rule.from_dict(shared | own)

    def without_part(self) -> Mapping[str, str]:
        """Settings without effect in a search without a rule."""
        names = ("phase", "q_learning_first") if self.rule == "none" else ()
        return dict.fromkeys(names, "a search without a rule")

    @model_validator(mode="after")
    def _take_over_from_the_rule(self) -> Self:
        """Explore as the rule would, unless told otherwise."""
        rule = "q-learning" if self.rule == "none" else self.rule
        fields = RULES[rule].Configuration.model_fields
        for name in ("exploration_probability", "exploration_share"):
            if name not in self.model_fields_set:
                # Not by `setattr`: it is still a default, which a scenario may replace.
                self.__dict__[name] = fields[name].default
        return self


class Search(Planned):
    """An algorithm that follows a `SearchPlan`, with or without a learning rule.

    `theta` is the incumbent; the controller carries the θ that is being tried.
    """

    Configuration = SearchConfiguration
    KEPT = ("_search", "_learnt", "_rule")
    asks_for = "simulator"
    configuration: SearchConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings, scenario = self.configuration, self.scenario
        self._learnt, self._rules_made = 0, 0
        seed = int(self.rng.integers(2**63))
        self._rule = self._make_rule(self.samples, 1.0)
        self._model = OneStepModel(scenario)
        stretch, stretches = settings.stretch, settings.stretches
        self._search = SearchPlan(
            scenario,
            self.controller.parameters,
            np.broadcast_to(self.strategy.deviation, scenario.action_lower.shape),
            self.samples,
            seed,
            phase=stretches * stretch if self._rule is None else settings.phase,
            stretch=stretch,
            stretches=stretches,
        )
        self.follow(self._search.plan())

    def _make_rule(self, samples: int, width: float) -> Algorithm | None:
        """The rule for a phase, its prior or trust region `width` times the configured one."""
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
        return RULES[name](self.controller, self.scenario, chosen, samples, self.strategy, self.rng)

    @property
    def theta(self) -> Vector:
        """The incumbent, (n_θ,): it has won a comparison, or it is the start."""
        return self._search.incumbent.theta

    def _begin(self, episode: Trial | None) -> None:
        super()._begin(episode)
        learns = episode is not None and episode.learns
        if episode is not None and learns and episode.width is not None:
            self._rule, self._learnt = self._make_rule(episode.length, episode.width), 0
        rule = self._rule if learns else None
        self.explores = rule is not None
        self.needs_action_value = rule is not None and rule.needs_action_value
        self.needs_points = rule is not None and rule.needs_points

    def told(self) -> Told:
        """What the trial told, with predictions by the controller's own model.

        Prediction `errors` s₊ − f(s, a), (K, n). Of learning `candidates` and `deviations` (2, n)
        of states and errors. Of a stretch its `cost`, means of stage cost and penalty per sample
        (2,), its `predictions` f(s, a) (K, n), and `metric` E[∇π Σ⁻¹ ∇πᵀ] (n_θ, n_θ), Σ = diag σ².
        """
        trial, model, n = self._episode, self._model, self._model.states
        rows = trial.samples(3 + model.inputs + n)
        costs, rows = np.array(trial.costs), rows[-LATEST:] if trial.learns else rows
        predictions = np.array([model(row[3 : 3 + n], row[3 + n : -n]) for row in rows])
        predictions = predictions.reshape(-1, n)
        states, errors = rows[:, 3 : 3 + n], rows[:, -n:] - predictions
        if trial.learns:
            if not len(rows):
                states, errors = np.zeros((2, 1, n))
            deviations = np.array([states.std(axis=0), errors.std(axis=0)])
            return {"errors": errors, "candidates": trial.candidates, "deviations": deviations}
        # A sample at which the controller failed has its share of J alone.
        costs[rows[:, 0].astype(int)] = rows[:, 1]
        total = costs.cumsum()[-1], np.append(0.0, rows[:, 2]).cumsum()[-1]
        told = {"cost": np.array(total) / trial.length}
        told |= {"errors": errors, "predictions": predictions}
        if trial.measure is not None:
            jacobians = [J for J in map(np.array, trial.measured) if np.isfinite(J).all()]
            metric = sum((J.T @ J for J in jacobians), np.zeros((trial.theta.size,) * 2))
            told["metric"] = metric / max(len(jacobians), 1)
        return told

    def observe(self, transition: Transition | None, cost: float = 0.0) -> Update | None:
        """Take one sample, of which the rule learns in a phase of learning."""
        update, trial = None, self._episode
        if self.explores and transition is not None and self._rule is not None:
            try:
                # A new rule counts from 0: its schedules begin anew.
                update = self._rule.observe(transition._replace(number=self._learnt))
                self._learnt += 1
                if (len(trial.costs) + 1) % max(trial.length // CANDIDATES, 1) == 0:
                    trial.candidates.append(self.controller.theta.copy())
            except DivergenceError:
                # The phase ends here; its earlier candidates may still be good.
                trial.length = len(trial.costs) + 1
        return super().observe(transition, cost) or update
