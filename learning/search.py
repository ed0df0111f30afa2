"""The search: a simulator decides which θ is kept, with or without a learning rule.

`SearchPlan` decides what to try next. It is a generator that yields requests (`Learn`, `Settle`,
`Trial`), is sent results (`Learned`, `Stretch`), and knows no plant, controller or rule. `Search`
carries the requests out as an algorithm.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from controllers.errors import ParameterError
from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector
from cosim.scenario import Scenario
from learning.actor_critic import ActorCritic
from learning.algorithm import Algorithm, Transition, Update
from learning.batch_q_learning import BatchQLearning
from learning.checkpoint import group
from learning.configuration import Configuration, Count
from learning.errors import ConfigurationError, DivergenceError
from learning.prediction_errors import OneStepModel, SortedErrors, expected_penalties
from learning.q_learning import QLearning
from learning.step import clip_eigenvalues, moved, prior_deviation, smallest_eigenvalue

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


class Learn(NamedTuple):
    """Let the rule learn from θ (n_θ,) for some samples.

    It `goes_on` with its data, or starts anew with its prior or trust region times `width`.
    """

    theta: Vector
    samples: int
    width: float
    goes_on: bool


class Settle(NamedTuple):
    """Run θ (n_θ,) greedily for a stretch, then take a snapshot of the plant.

    The plant is reset before, where `episode` gives the seed of its noise.
    """

    theta: Vector
    episode: int | None = None


class Trial(NamedTuple):
    """Run θ (n_θ,) greedily for a stretch, from the snapshot (`begins`) or on from the last one.

    The snapshot includes the noise to come. `sensitive` asks for dπ/dθ.
    """

    theta: Vector
    begins: bool
    sensitive: bool = False


class Learned(NamedTuple):
    """Result of `Learn`: `candidates` (K, n_θ), the last one where it ended.

    `errors` (M, n) are one-step prediction errors; `state_deviation` and `error_deviation` (n,).
    """

    candidates: Matrix
    errors: Matrix
    state_deviation: Vector
    error_deviation: Vector


class Stretch(NamedTuple):
    """Result of `Settle` and `Trial`: mean `stage_cost` and `penalty` per sample.

    `predictions` f(s, a) (K, n); `errors` s₊ − f(s, a) (K, n); `metric` E[∇π Σ⁻¹ ∇πᵀ] (n_θ, n_θ)
    if asked for, with Σ the exploration's variance; `expected` the penalty expected of the
    predictions, None before a comparison has computed it.
    """

    stage_cost: float
    penalty: float
    predictions: Matrix
    errors: Matrix
    metric: Matrix | None = None
    expected: float | None = None


Request = Learn | Settle | Trial
Result = Learned | Stretch
Plan = Generator[Request, Result, None]
Step = Generator[Request, Result, bool]


class Spent(Exception):
    """The samples are used up."""


@dataclass
class Candidate:
    """A θ with the mean costs of its stretches: `realised`, and `expected` with pooled errors."""

    theta: Vector
    realised: list[float] = field(default_factory=list)
    expected: list[float] = field(default_factory=list)

    @property
    def costs(self) -> Vector:
        """The larger of both readings, stretch by stretch.

        The realised penalty is rare spikes. The expected one is too large where the errors depend
        on the state, by 10 to 20 a sample near the best back-off of `paper`.
        """
        return np.maximum(self.realised, self.expected)


class PairedComparison:
    """Decides which of two θ is cheaper; counts the samples spent.

    All comparisons of a round begin at one snapshot, with the same noise to come. The `incumbent`
    has won a comparison, or is the start. Candidates are compared with `base`: the incumbent, or
    the centre of a line search that has not won yet. `scenario` gives bounds and penalty,
    `samples` the budget; a comparison has up to `stretches` stretches of `stretch` samples.
    """

    KEPT = ("_errors", "pooled")
    MEMORY = 6000
    """Prediction errors kept for expected penalties, whose tail counts."""

    def __init__(
        self, scenario: Scenario, start: Parameters, samples: int, *, stretch: int, stretches: int
    ) -> None:
        self._penalty = scenario.state_penalty
        self._parameters, self._start = start.blocks, start.theta
        self.stretch, self.stretches = stretch, stretches
        self.least = 0.5 * max(smallest_eigenvalue(start.blocks, start.theta), 0.0)
        """Least eigenvalue that the Hessians of a candidate may have."""
        self.spent, self.limit = 0, samples
        self.expected = float("nan")
        """Penalty expected of the latest stretch."""
        self._errors: Matrix = np.zeros((0, scenario.state_lower.size))
        self.pooled = self._errors
        self.incumbent = Candidate(start.theta)
        self.base = self.incumbent

    @property
    def pooled(self) -> Matrix:
        """The prediction errors that the penalties of this round's stretches are expected with."""
        return self._pooled

    @pooled.setter
    def pooled(self, errors: Matrix) -> None:
        # Sort once a round: a stretch only looks values up.
        self._pooled, self._pool = errors, SortedErrors(errors)

    def accept(self, candidate: Candidate) -> None:
        """Make a candidate the incumbent."""
        self.base = self.incumbent = candidate

    def spend(self, samples: int) -> None:
        """Count requested samples; raises Spent beyond the limit."""
        if self.spent + samples > self.limit:
            raise Spent
        self.spent += samples

    def remember(self, errors: Matrix) -> None:
        """Keep prediction errors (K, n) for the pools of the rounds to come."""
        self._errors = np.concatenate([self._errors, errors])[-self.MEMORY :]

    def run(self, candidate: Candidate) -> Generator[Request, Result, None]:
        """One more stretch of a candidate, always on from its last one."""
        self.spend(self.stretch)
        stretch = yield Trial(candidate.theta, begins=not candidate.realised)
        assert isinstance(stretch, Stretch)
        self.expected = self._expected(stretch)
        candidate.realised.append(stretch.stage_cost + stretch.penalty)
        candidate.expected.append(stretch.stage_cost + self.expected)
        self.remember(stretch.errors)

    def _expected(self, stretch: Stretch) -> float:
        """Expected penalty of a stretch; the realised one where there is no pool yet."""
        if stretch.expected is not None:
            return stretch.expected
        if len(stretch.predictions) and len(self._pool):
            found = expected_penalties(self._penalty, stretch.predictions, self._pool)
            return float(found.mean(axis=-1).cumsum()[-1])
        return stretch.penalty

    def renew(self, stretches: int, episode: int | None = None) -> Generator[Request, Result, None]:
        """Run the incumbent on new noise: on from where the plant is, or in a new episode."""
        self.spend(self.stretch)
        yield Settle(self.incumbent.theta, episode)
        # One pool for the whole round, so that all θ are judged alike.
        self.pooled = self._errors
        self.base = self.incumbent = Candidate(self.incumbent.theta)
        for _ in range(stretches):
            yield from self.run(self.incumbent)

    def compare(self, theta: Vector, *, patient: bool = False) -> Step:
        """Whether θ takes the base's place: cheaper on the same noise by a standard error.

        Stops once θ's summed cost exceeds the base's; with `patient`, once the stretches left
        cannot make up for it. A winner has run all stretches, since slow states show effects late.
        """
        costs = self.base.costs
        patience = _patience(costs) if patient else 0.0
        candidate = yield from self.screen(theta, costs, patience)
        if candidate is None or not cheaper(candidate.costs - costs):
            return False
        if self.base is self.incumbent:
            self.accept(candidate)
        self.base = candidate
        return True

    def screen(
        self, theta: Vector, costs: Vector, patience: float = 0.0
    ) -> Generator[Request, Result, Candidate | None]:
        """θ with its first stretches if it is never dearer on them, else None."""
        admissible = self.admissible(theta)
        if admissible is None:
            return None
        candidate = Candidate(admissible)
        for count in range(1, len(costs) + 1):
            yield from self.run(candidate)
            if (candidate.costs - costs[:count]).sum() >= patience - ROUNDING * abs(costs[0]):
                return None
        return candidate

    def final(
        self, rivals: list[Vector], stretches: int, episode: int
    ) -> Generator[Request, Result, None]:
        """Make the cheapest of the incumbent and its rivals (n_θ,) the incumbent.

        Each runs over `stretches` stretches of a new episode. A rival is given up once its other
        stretches can no longer make up for its loss. The start is left only for a θ that is cheaper
        by a standard error: the best of many is partly luck.
        """
        yield from self.renew(stretches, episode)
        costs = self.incumbent.costs
        patience = _patience(costs) if stretches > 1 else np.inf
        finalists = [self.incumbent]
        for theta in rivals:
            rival = Candidate(theta)
            while len(rival.realised) < stretches:
                yield from self.run(rival)
                if (rival.costs - costs[: len(rival.realised)]).sum() >= patience:
                    break
            else:
                finalists.append(rival)
                self.accept(self._winner(finalists))

    def _winner(self, finalists: list[Candidate]) -> Candidate:
        """The cheapest; the start, where it is not dearer by a standard error."""
        best = min(finalists, key=lambda candidate: float(candidate.costs.mean()))
        for candidate in finalists:
            start = np.array_equal(candidate.theta, self._start)
            if start and not cheaper(best.costs - candidate.costs):
                return candidate
        return best

    def admissible(self, theta: Vector) -> Vector | None:
        """θ with definite Hessians; None if bounds cross or a slack weight is ≤ 0."""
        blocks = self._parameters
        if not np.isfinite(theta).all():
            return None
        if smallest_eigenvalue(blocks, theta) < self.least:
            theta = clip_eigenvalues(blocks, theta, self.least)
        with suppress(ParameterError):
            Parameters(blocks, theta).require_well_posed()
            return theta
        return None


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

    A round's comparisons begin at the snapshot at the end of its learning. Where no learnt θ won,
    comparisons become twice as long and the next phase has half the width. Without a rule θ rests
    in the phases of learning, which then only measure the coordinates of the line searches
    (`prior_deviation`).

    `scenario` gives bounds and penalty; `action_deviation` (m,) is the exploration's σ, `samples`
    the budget. A comparison has `stretches` stretches of `stretch` samples, a phase has `phase`.
    """

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
        self._start, self._states = start, scenario.state_lower.size
        self._action_deviation, self._samples = action_deviation, samples
        # A short run has short phases and comparisons.
        self._phase = min(phase, max(samples // 8, 1))
        stretch = min(stretch, max(samples // 100, 1))
        self._rng = np.random.default_rng(seed)
        self.comparison = PairedComparison(
            scenario, start, samples, stretch=stretch, stretches=stretches
        )
        self._longer = 2 * stretches
        self._scale: Vector = np.ones(start.theta.size)
        self._past = [start.theta]

    def plan(self) -> Plan:
        """The whole run."""
        comparison = self.comparison
        comparison.limit = int((1.0 - self.FINAL) * self._samples)
        try:
            yield from self._rounds()
        except Spent:
            comparison.limit = self._samples
        stretches = max(int(self.FINAL * self._samples / comparison.stretch / self.FINALISTS), 1)
        last = len(self._past) - 1
        order = dict.fromkeys([0, last, last // 2, *range(last - 1, 0, -1)])
        # The best of many moves is partly luck, and a round too short for rare events.
        incumbent = comparison.incumbent.theta
        rivals = [self._past[k] for k in order if not np.array_equal(self._past[k], incumbent)]
        try:
            yield from comparison.final(rivals, stretches, int(self._rng.integers(2**31)))
        except Spent:
            return

    def _rounds(self) -> Plan:
        comparison = self.comparison
        back_off, weights, reach = 1.0, -1.0, np.full(self.DIRECTIONS, 0.5)
        bounds = [0.5] * self._states
        width, number, better, rescaled, failed, rest = 1.0, 0, True, False, 0, 0
        while True:
            before = comparison.incumbent.theta
            # At the end too few samples may be left for learning, not for a search.
            enough = (
                comparison.limit - comparison.spent
                >= self._phase + comparison.stretches * comparison.stretch
            )
            if enough and rest == 0:
                better = yield from self._learn(width, goes_on=better and not rescaled)
                failed = 0 if better else failed + 1
                width, rest = (width, 0) if better else (0.5 * width, failed)
            else:
                better = False
                yield from self._renew()
            if not better:
                comparison.stretches = self._longer
            rest = max(rest - 1, 0)
            back_off = yield from self._along(self._tightening(), min(back_off, 1.0))
            unscaled = comparison.incumbent
            weights = yield from self._rescale(weights)
            rescaled = comparison.incumbent is not unscaled
            # While learning pays, searching would only cost samples.
            if not better:
                for state in range(self._states):
                    tightening = self._tightening(state)
                    bounds[state] = yield from self._along(tightening, min(bounds[state], 1.0))
                directions = yield from self._directions(turned=number > 0)
                for j, direction in enumerate(directions.T):
                    reach[j] = yield from self._along(direction, float(np.clip(reach[j], 0.05, 1)))
                way = (comparison.incumbent.theta - before) / self._scale
                if way.any():
                    yield from self._along(way, 0.5)
                number += 1
            if not np.array_equal(before, self._past[-1]):
                self._past.append(before)

    def _renew(self) -> Plan:
        """Run the incumbent on new noise, and compare its predecessor with it once more."""
        comparison, past = self.comparison, self._past[-1]
        yield from comparison.renew(comparison.stretches)
        if not np.array_equal(past, comparison.incumbent.theta):
            yield from comparison.compare(past, patient=True)

    def _learn(self, width: float, *, goes_on: bool) -> Step:
        """Learn from the incumbent, then compare the candidates, the latest first."""
        comparison = self.comparison
        comparison.spend(self._phase)
        learned = yield Learn(comparison.incumbent.theta, self._phase, width, goes_on)
        assert isinstance(learned, Learned)
        self._measure(learned)
        yield from self._renew()
        better = False
        for theta in learned.candidates[::-1]:
            better |= yield from comparison.compare(theta)
        return better

    def _measure(self, learned: Learned) -> None:
        """Take the coordinates of the searches from the latest data about the incumbent."""
        start = self._start.with_theta(self.comparison.incumbent.theta)
        self._scale = prior_deviation(
            start,
            learned.state_deviation,
            learned.error_deviation,
            self._action_deviation,
            abs(float(start["c_lambda"])),
            PRIOR_WIDTH,
        )
        self.comparison.remember(learned.errors)

    def _along(self, direction: Vector, reach: float) -> Generator[Request, Result, float]:
        """Line search both ways in scaled θ, (n_θ,); returns the first step of the next time."""
        comparison = self.comparison
        longest = self.CAP / max(float(np.abs(direction).max()), np.finfo(float).tiny)
        origin, quarter = comparison.base.theta, max(len(comparison.base.realised) // 4, 1)
        for sign in (1.0, -1.0):
            # Steps that win over a quarter of the stretches are doubled; the longest runs all.
            step, best, costs = sign * min(reach, longest), 0.0, comparison.base.costs[:quarter]
            while abs(step) <= 4.0 * longest:
                found = yield from comparison.screen(
                    origin + self._scale * (step * direction), costs
                )
                if found is None:
                    break
                best, costs = step, found.costs
                step *= 2.0
            while abs(best) >= min(reach, longest):
                if (yield from comparison.compare(origin + self._scale * (best * direction))):
                    return abs(best)
                best *= 0.5
        return 0.5 * reach

    def _tightening(self, state: int | None = None) -> Vector:
        """All state bounds, or one state's, moved inwards by half their deviation, (n_θ,)."""
        direction = np.zeros_like(self._scale)
        for name, inwards in (("x_l", 0.5), ("x_u", -0.5)):
            where = np.arange(direction.size)[self._start.blocks.slices[name]]
            direction[where if state is None else where[state]] = inwards
        return direction

    def _directions(self, *, turned: bool) -> Generator[Request, Result, Matrix]:
        """Directions in scaled θ that change the policy by the exploration's σ, (n_θ, K)."""
        comparison = self.comparison
        comparison.spend(comparison.stretch)
        stretch = yield Trial(comparison.base.theta, True, sensitive=True)
        assert isinstance(stretch, Stretch) and stretch.metric is not None
        values, vectors = np.linalg.eigh(stretch.metric * np.outer(self._scale, self._scale))
        values, vectors = values[::-1][: self.DIRECTIONS], vectors[:, ::-1][:, : self.DIRECTIONS]
        directions = vectors / np.sqrt(np.maximum(values, 1e-12))
        if turned:
            draw = self._rng.standard_normal((directions.shape[1],) * 2)
            directions = directions @ np.linalg.qr(draw)[0]
        return np.asarray(directions)

    def _rescale(self, decades: float) -> Generator[Request, Result, float]:
        """Search over the inputs' weights, each with its own back-off; the next time's step."""
        comparison = self.comparison
        found = False
        while True:
            kept, least = comparison.incumbent, comparison.least
            theta = self._weighted(10.0**decades)
            comparison.least = min(least, 0.5 * smallest_eigenvalue(self._start.blocks, theta))
            comparison.base = Candidate(theta)
            pays = False
            try:
                for _ in range(len(kept.costs)):
                    yield from comparison.run(comparison.base)
                yield from self._along(self._tightening(), 0.5)
                pays = cheaper(comparison.base.costs - kept.costs)
            finally:
                if pays:
                    comparison.accept(comparison.base)
                comparison.base = comparison.incumbent
            if not pays:
                comparison.least = least
                return decades if found else -0.7 * decades
            found = True

    def _weighted(self, factor: float) -> Vector:
        """The incumbent with its input weights times `factor`, the cost's minimum kept, (n_θ,)."""
        comparison = self.comparison
        parameters = self._start.with_theta(comparison.base.theta)
        hessian, gradient = parameters["B_l"], parameters["b_l"]
        scale = np.ones(len(gradient))
        scale[-self._action_deviation.size :] = factor**0.5
        minimiser = np.linalg.solve(hessian, gradient)
        hessian = hessian * np.outer(scale, scale)
        return parameters.replace({"B_l": hessian, "b_l": hessian @ minimiser}).theta


class SearchConfiguration(Configuration):
    """Settings of the search; those of its rule are the table `rule_settings`."""

    rule: Literal["none", "q-learning", "batch-q-learning", "actor-critic"] = Field(
        "none",
        description="what learns in the phases between the comparisons; none: θ rests in them, and "
        "they last stretches × stretch samples",
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
    stretch: Count = Field(100, description="samples of a stretch of a comparison")
    stretches: Count = Field(8, description="stretches of a comparison that is not decided before")

    def rule_configuration(self, name: str) -> Any:
        """Settings of a rule in the search: those that they share, and the rule's own."""
        shared = {field: getattr(self, field) for field in Configuration.model_fields}
        own = self.rule_settings if name == self.rule else {}
        rule = RULES[name].Configuration
        shared |= {key: value for key, value in RULE_DEFAULTS.items() if key in rule.model_fields}
        return rule.from_dict(shared | own)

    def without_part(self) -> Mapping[str, str]:
        """Settings without effect in a search without a rule."""
        names = ("phase", "rule_settings", "q_learning_first") if self.rule == "none" else ()
        return dict.fromkeys(names, "a search without a rule")

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
    """Data of a request's `length` samples; `deviation` (m,) is the exploration's σ."""

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

    def take(self, transition: Transition, theta: Vector | None = None) -> None:
        """Take a sample, and θ (n_θ,) after it if it may be a candidate."""
        self._rows.append(np.concatenate([transition.s, transition.a, transition.next_s]))
        self.done += 1
        if self._learns:
            if theta is not None and self.done % max(self.length // CANDIDATES, 1) == 0:
                self._candidates.append(theta.copy())
            return
        self._stage_cost += transition.stage_cost
        self._penalty += transition.next_penalty
        if self._sensitive and (self.done - 1) % max(self.length // SENSITIVITIES, 1) == 0:
            jacobian = transition.policy.policy_jacobian / self._deviation[:, None]
            if np.isfinite(jacobian).all():
                self._metric += jacobian.T @ jacobian
                self._jacobians += 1

    def fail(self, cost: float) -> None:
        """Take a sample at which the controller failed, with its share of J."""
        self._stage_cost += cost
        self.done += 1

    def result(self, model: OneStepModel) -> Result:
        """The result, with predictions by the controller's own `model`."""
        n, width = model.states, model.states + len(self._deviation)
        rows = np.array(self._rows[-LATEST:] if self._learns else self._rows).reshape(-1, width + n)
        states = rows[:, :n]
        predictions = np.array([model(row[:n], row[n:width]) for row in rows]).reshape(-1, n)
        errors = rows[:, width:] - predictions
        if not self._learns:
            metric = self._metric / max(self._jacobians, 1) if self._sensitive else None
            count = self.length
            return Stretch(
                self._stage_cost / count, self._penalty / count, predictions, errors, metric
            )
        candidates = np.array(self._candidates).reshape(-1, len(self._metric))
        if not len(errors):
            errors, states = np.zeros((1, n)), np.zeros((1, n))
        return Learned(candidates, errors, states.std(axis=0), errors.std(axis=0))


class Search(Algorithm):
    """An algorithm that runs a `SearchPlan`, with or without a learning rule.

    `theta` is the incumbent; the controller carries the θ that is being tried. A checkpoint keeps
    the results that the plan was given, without prediction errors that no longer count; `restore`
    gives them to the deterministic plan once more.
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
        self._deviation = np.broadcast_to(self.strategy.deviation, scenario.action_lower.shape)
        self._model = OneStepModel(scenario)
        stretch, stretches = settings.stretch, settings.stretches
        search = SearchPlan(
            scenario,
            self.controller.parameters,
            self._deviation,
            self.samples,
            seed,
            phase=stretches * stretch if self._rule is None else settings.phase,
            stretch=stretch,
            stretches=stretches,
        )
        self._comparison, self._plan = search.comparison, search.plan()
        self._results: list[Result] = []
        self._request: Request | None = next(self._plan, None)
        self._open()

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
        return self._comparison.incumbent.theta

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; the last of a request begins the next one."""
        if self._request is None:
            return None
        update: Update | None = None
        if isinstance(self._request, Learn):
            update = self._learn(transition)
        else:
            self._episode.take(transition)
        return self._next() if self._episode.done >= self._episode.length else update

    def failed(self, cost: float) -> Update | None:
        """Count a sample at which the controller failed, and its cost."""
        if self._request is None:
            return None
        self._episode.fail(cost)
        return self._next() if self._episode.done >= self._episode.length else None

    def _open(self) -> None:
        """Set θ, rule and data for the plan's request."""
        request, controller = self._request, self.controller
        controller.theta = self.theta if request is None else request.theta
        learns = isinstance(request, Learn)
        length = request.samples if isinstance(request, Learn) else self._comparison.stretch
        self._episode = EpisodeData(request, length, self._deviation, controller.theta.size)
        if isinstance(request, Learn) and not request.goes_on:
            self._rule = self._make_rule(request.samples, request.width)
            self._learnt = 0
        rule = self._rule if learns else None
        self.explores = rule is not None
        self.needs_action_value = rule is not None and rule.needs_action_value
        self.needs_points = rule is not None and rule.needs_points

    def _learn(self, transition: Transition) -> Update | None:
        if self._rule is None:
            self._episode.take(transition)
            return None
        try:
            # A new rule counts from 0: its schedules begin anew.
            update = self._rule.observe(transition._replace(number=self._learnt))
        except DivergenceError:
            # The phase ends here; its earlier candidates may still be good.
            self._episode.length = self._episode.done + 1
            self._episode.take(transition)
            return None
        self._learnt += 1
        self._episode.take(transition, self.controller.theta)
        return update

    def _next(self) -> Update:
        """Send the plan its result; begin the next request."""
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
        if isinstance(result, Stretch):
            expected = self._comparison.expected
            result = result._replace(predictions=none, expected=expected)
        self._results.append(result._replace(errors=none))
        self._open()

    def state(self) -> dict[str, NDArray[Any]]:
        """Results so far, errors that count, the open request's data, the rule's state."""
        state = super().state() | {"results": np.array(len(self._results))}
        for k, result in enumerate(self._results):
            kept = {name: part for name, part in result._asdict().items() if part is not None}
            state |= {f"result {k} {name}": np.asarray(part) for name, part in kept.items()}
        return state

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Restore what `state` returned."""
        theta = self.controller.theta
        for k in range(int(state["results"])):
            kept: dict[str, Any] = group(state, f"result {k} ")
            for name in kept.keys() & {"stage_cost", "penalty", "expected"}:
                kept[name] = float(kept[name])
            self._advance(Learned(**kept) if "candidates" in kept else Stretch(**kept))
        self.controller.theta = theta
        super().restore(state)
