"""`backoff`: how far to back off from each active bound, by a line search on the plant.

`BackOffSearch` is the search; the rule runs it on the plant, `learning.backed_off` on the model.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.protocols import Matrix, Vector
from cosim.core.scenario import Penalty, Positive, Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Configuration, Count, GreedyConfiguration, Share
from learning.errors import ConfigurationError
from learning.prediction_errors import OneStepModel, known_penalty
from learning.step import update_without_fit

DEFAULT_BUDGET = 8000
"""Samples of a practitioner's method where the user states none."""


class Phase(IntEnum):
    """The rounds of the search of one back-off, each finer than the last."""

    COARSE = 0
    MEDIUM = 1
    FINE = 2


class BackOffConfiguration(GreedyConfiguration):
    """Hyperparameters of the search of back-offs κ, in standard deviations of the error."""

    round_shares: tuple[Count, Count, Count] = Field(
        (3, 5, 8),
        description="samples of a bound's coarse, medium and fine round, as shares",
    )
    coarse_offsets: tuple[float, ...] = Field(
        (0.0, 2.0, 4.0),
        description="κ of the coarse round, about the best so far; the first is 0",
    )
    medium_offsets: tuple[float, ...] = Field(
        (-0.5, 0.0, 0.5),
        description="κ of the medium round, about the best so far",
    )
    fine_offsets: tuple[float, ...] = Field(
        (-0.25, 0.25),
        description="κ of the fine round, about the best so far",
    )
    reach: Positive = Field(
        1.0,
        description=(
            "distance in κ over which a sample counts for another back-off; twice that in "
            "the coarse round"
        ),
    )
    resolution: Positive = Field(0.01, description="step of κ")
    plateau: Positive = Field(
        1e-6,
        description="share by which estimated costs must differ to be told apart",
    )
    active_share: Share = Field(
        0.05,
        description="share of the samples in which a bound must be active to be searched",
    )


class Round(NamedTuple):
    """A round of the search: κ of one bound are tried, those of the others stay."""

    bound: int
    phase: Phase


class Segment:
    """Samples in a row at one θ.

    Args:
        length: how many, those at which the controller failed included.
        n_bounds: number of bounds.

    Attributes:
        count: samples so far, failed ones included.
        n_active: samples in which each bound was active, (2n,).
    """

    def __init__(self, length: int, n_bounds: int) -> None:
        self.length = length
        self.count = 0
        self.n_active: Vector = np.zeros(n_bounds)
        # Of each sample at which the controller did not fail:
        self._numbers: list[int] = []
        self._stage_costs: list[float] = []
        self._states: list[list[float]] = []
        self._actions: list[list[float]] = []
        self._next_states: list[list[float]] = []

    @property
    def is_empty(self) -> bool:
        """Whether the controller failed at all samples."""
        return not self._numbers

    def add(self, transition: Transition) -> None:
        """Keep the present sample."""
        self._numbers.append(self.count)
        self._stage_costs.append(transition.stage_cost)
        self._states.append(transition.s.tolist())
        self._actions.append(transition.a.tolist())
        self._next_states.append(transition.next_s.tolist())

    def errors(self, model: OneStepModel, theta: Parameters) -> Matrix:
        """One-step prediction errors of a model at θ, (K, n)."""
        states = np.array(self._states)
        actions = np.array(self._actions)
        next_states = np.array(self._next_states)
        return model.errors(states, actions, next_states, theta)

    def settled(self, settling: int) -> Matrix:
        """Rows (ℓ, s) of the samples after the first `settling`, (K, 1+n)."""
        rows = []
        for number, cost, state in zip(self._numbers, self._stage_costs, self._states, strict=True):
            if number >= settling:
                rows.append([cost, *state])
        return np.array(rows)

    def state_dict(self) -> State:
        """The samples."""
        return {
            "length": self.length,
            "count": self.count,
            "n_active": self.n_active,
            "numbers": np.array(self._numbers, int),
            "stage_costs": np.array(self._stage_costs),
            "states": np.array(self._states),
            "actions": np.array(self._actions),
            "next_states": np.array(self._next_states),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self.length = state["length"]
        self.count = state["count"]
        self.n_active = state["n_active"]
        self._numbers = state["numbers"].tolist()
        self._stage_costs = state["stage_costs"].tolist()
        self._states = state["states"].tolist()
        self._actions = state["actions"].tolist()
        self._next_states = state["next_states"].tolist()


@dataclass(frozen=True)
class CostEstimate:
    """The mean cost at any κ of a bound, from samples that were run at some.

    A sample at one κ says what another one would cost: its states move with κ, their penalty is
    known, and the rest of the cost has a slope.

    Attributes:
        kappa: κ of each sample, (K,).
        states: its state, (K, n).
        mean_cost: mean stage cost of all samples; κ share it, what differs is estimated.
        cost_slope: of the stage cost, for a unit of κ.
        state_slopes: of the states, (n,).
        penalty: of the true bounds.
        reach: how far, in κ, a sample speaks for another κ.
    """

    kappa: Vector
    states: Matrix
    mean_cost: float
    cost_slope: float
    state_slopes: Vector
    penalty: Penalty
    reach: float

    def at(self, value: float) -> float:
        """The cost at a κ within reach of a sample."""
        # Samples far away speak for another place of the state.
        distance = value - self.kappa
        near = np.abs(distance) < self.reach
        change_of_states = np.outer(distance[near], self.state_slopes)
        moved = self.states[near] + change_of_states
        penalty = known_penalty(self.penalty, moved).mean()
        change = self.cost_slope * value + penalty
        return float(self.mean_cost + change)

    def best_of(self, values: Vector, plateau: float) -> float:
        """The smallest κ of those that cost least.

        Args:
            values: κ to choose from, (M,).
            plateau: costs that differ by this share are one.
        """
        costs = np.array([self.at(value) for value in values])
        least = costs.min()
        limit = least + plateau * abs(least)
        cheapest = values[costs <= limit]
        smallest = np.argmin(np.abs(cheapest))
        return float(cheapest[smallest])


class BackOffSearch:
    """Finds the κ of least cost for the active bounds x_l + κσ and x_u − κσ.

    σ is the standard deviation of the model's one-step prediction error in each state; a bound is
    active where it is in the QP (dV/dx_l or dV/dx_u ≠ 0) in `active_share` of the samples. Each has
    a line search of three rounds (docs/method.md), a round of several segments at one κ each. The
    bound that is active most often at κ = 0 has the first round, which finds the others, and the
    last two. No true bound is loosened. Of back-offs whose estimates differ by less than `plateau`
    the smallest is chosen. Where the estimate falls to the end of its range, the best back-off that
    was run is chosen, and the next round is about it.

    Whoever runs it sets the controller's θ to `trial` and lets `observe` have each sample, until
    the search `has_ended`.

    Args:
        start: θ with no bound backed off.
        scenario: its true bounds, penalty and nominal model.
        budget: samples of the search.
        rng: draws the seeds of the rounds.
        settings: rounds and resolution.

    Attributes:
        kappa: best back-offs so far, of lower then upper bounds, (2n,).
        has_ended: no segment is left.
        led_beyond: whether the last segment ended a round whose estimate led beyond what was run.

    Raises:
        ConfigurationError: the budget is too small.
    """

    def __init__(
        self,
        start: Parameters,
        scenario: Scenario,
        budget: int,
        rng: np.random.Generator,
        settings: BackOffConfiguration,
    ) -> None:
        problem = Problem.from_scenario(scenario)
        n = problem.n_states
        self._shares = sum(settings.round_shares)
        least = 2 * self._shares * problem.horizon
        if budget < least:
            raise ConfigurationError(
                f"a search of the back-off needs at least {least} samples, it has {budget}"
            )
        self.start = start
        self.settings = settings
        self._budget = budget
        self._n = n
        self._settling = problem.horizon  # samples of a segment that do not count
        self._penalty = scenario.state_penalty
        self._model = OneStepModel(scenario)
        self._true_lower = scenario.state_lower
        self._true_upper = scenario.state_upper
        # Where the bounds are in θ, to read which of them are active.
        places = np.arange(start.theta.size)
        slices = start.blocks.slices
        self._bounds = np.concatenate([places[slices["x_l"]], places[slices["x_u"]]])
        self._seeds = rng.integers(2**63, size=2 * n * len(settings.round_shares)).tolist()

        self.kappa: Vector = np.zeros(2 * n)
        self.has_ended = False
        self.led_beyond = False
        self._unit: Vector = np.zeros(n)  # σ, known after the first segment
        self._active: Vector = np.zeros(2 * n)  # largest share of a first round's segment
        # The first segment is at κ = 0: it finds σ, and the bound that the first round is about.
        self._schedule: list[Round] = []
        self._round = 0
        self._candidates: Matrix = self.kappa[None].copy()  # κ of the round's segments, (S, 2n)
        self._number = 0  # of the present segment in its round
        self._segment = Segment(budget // self._shares, 2 * n)
        self._tried: Matrix = np.zeros((0, 3 + n))  # rows (round, κ, ℓ, s) of settled samples

    @property
    def theta(self) -> Parameters:
        """θ with the best back-offs so far."""
        return self.backed_off(self.kappa)

    @property
    def trial(self) -> Parameters:
        """θ of the present segment; the best one when the search has ended."""
        if self.has_ended:
            return self.theta
        kappa = self._candidates[self._number]
        return self.backed_off(kappa)

    @property
    def seed(self) -> int:
        """Seed of the present round's noise, where it can be chosen."""
        return int(self._seeds[self._round])

    def backed_off(self, kappa: Vector) -> Parameters:
        """θ with its bounds κ (2n,) backed off, within the true bounds, x_l kept below x_u."""
        n = self._n
        of_lower = kappa[:n] * self._unit
        of_upper = kappa[n:] * self._unit
        lower = self.start["x_l"] + of_lower
        upper = self.start["x_u"] - of_upper
        lower = np.maximum(lower, self._true_lower)
        upper = np.minimum(upper, self._true_upper)
        crossed = lower >= upper
        # Back-offs of both bounds may meet; the QP needs room between them.
        middle = (lower + upper) / 2
        lower[crossed] = middle[crossed] - 1e-6
        upper[crossed] = middle[crossed] + 1e-6
        return self.start.replace({"x_l": lower, "x_u": upper})

    def observe(self, transition: Transition | None) -> bool:
        """Learn from a sample of the present segment.

        Args:
            transition: None where the controller failed.

        Returns:
            Whether it was the segment's last; `trial` is the next one's then.
        """
        segment = self._segment
        if transition is not None:
            segment.add(transition)
            # Which bounds are active is found in the first round alone.
            if self._round == 0:
                gradient = transition.solution.value_gradient
                multipliers = gradient[self._bounds]
                segment.n_active += multipliers != 0
        segment.count += 1
        if segment.count < segment.length:
            return False
        self._end_segment(segment)
        return True

    def _end_segment(self, segment: Segment) -> None:
        """Keep what a segment has shown, and begin the next one, perhaps of another round."""
        self.led_beyond = False
        if self._round == 0:
            # A bound counts that was active at any of the first round's κ.
            share = segment.n_active / segment.length
            self._active = np.maximum(self._active, share)
        if not self._schedule:
            self._begin_schedule(segment)
            if self.has_ended:
                return
        self._keep(segment)
        self._number += 1
        if self._number == len(self._candidates):
            self._end_round()
        else:
            self._segment = Segment(segment.length, 2 * self._n)

    def _begin_schedule(self, segment: Segment) -> None:
        """Find σ and the first bound, whose coarse round the first segment, at κ = 0, begins."""
        if segment.is_empty or self._active.max() < self.settings.active_share:
            self.has_ended = True
            return
        errors = segment.errors(self._model, self.start)
        self._unit = errors.std(axis=0)
        first = int(np.argmax(self._active))
        self._schedule = [Round(first, Phase.COARSE)]
        # The first round is about one bound; later rounds share the samples that it leaves.
        self._begin_round(1.0)
        # Whatever the round's first κ is, the segment was run without a back-off.
        self._candidates[0, first] = 0.0

    def _keep(self, segment: Segment) -> None:
        """Keep the samples of a segment once the loop has settled."""
        settled = segment.settled(self._settling)
        if not len(settled):
            return
        bound = self._schedule[self._round].bound
        kappa = self._candidates[self._number, bound]
        # Round and κ stand before the sample: slopes are taken within a round.
        labels = np.tile([self._round, kappa], (len(settled), 1))
        kept = np.hstack([labels, settled])
        self._tried = np.concatenate([self._tried, kept])

    def _begin_round(self, factor: float) -> None:
        """Set the κ that the present round tries, and begin its first segment.

        Args:
            factor: of the round's share of the budget.
        """
        bound, phase = self._schedule[self._round]
        offsets = self._offsets(bound, phase)
        wanted = self.kappa[bound] + np.array(offsets)
        self._number = 0
        self._candidates = np.tile(self.kappa, (len(offsets), 1))
        self._candidates[:, bound] = np.maximum(wanted, self._least(bound))
        # The round's share of the budget, over its segments.
        share = self.settings.round_shares[phase]
        parts = self._shares * len(offsets)
        length = int(self._budget * factor * share / parts)
        # One sample at least counts, once the loop has settled.
        length = max(length, self._settling + 1)
        self._segment = Segment(length, 2 * self._n)

    def _offsets(self, bound: int, phase: Phase) -> tuple[float, ...]:
        """κ that a round tries of its bound, from the best so far on."""
        settings = self.settings
        if phase == Phase.FINE:
            return settings.fine_offsets
        if phase == Phase.MEDIUM:
            return settings.medium_offsets
        # Of a start that is backed off by more than κ = 1, look for less.
        largest = settings.coarse_offsets[-1]
        back = max(self._least(bound), -largest)
        return (0.0, back, back / 2) if back < -1.0 else settings.coarse_offsets

    def _end_round(self) -> None:
        """Choose the round's κ, and begin the next round."""
        bound, phase = self._schedule[self._round]
        self.kappa[bound], self.led_beyond = self._best(bound, phase)
        if self._round == 0:
            self._schedule += self._later_rounds(bound)
        self._round += 1
        if self._round == len(self._schedule):
            self.has_ended = True
            return
        # The samples of the medium round count in the fine one too.
        if self._schedule[self._round].phase != Phase.FINE:
            self._tried = self._tried[:0]
        # What the first round has left, over all rounds to come.
        shares = self.settings.round_shares
        left = self._shares - shares[Phase.COARSE]
        total = sum(shares[later.phase] for later in self._schedule[1:])
        self._begin_round(left / total)

    def _later_rounds(self, first: int) -> list[Round]:
        """The rounds after the coarse one of the first bound: those of the others, then its own."""
        rounds = []
        active = self._active >= self.settings.active_share
        for bound in np.flatnonzero(active).tolist():
            if bound != first:
                rounds += [Round(bound, phase) for phase in Phase]
        return [*rounds, Round(first, Phase.MEDIUM), Round(first, Phase.FINE)]

    def _least(self, bound: int) -> float:
        """κ of the true bound; at most 0 if the start loosens no bound."""
        state = bound % self._n
        # Without errors κ has no unit, and there is nothing to look for.
        if self._unit[state] <= 0:
            return 0.0
        if bound < self._n:
            room = self._true_lower[state] - self.start["x_l"][state]
        else:
            room = self.start["x_u"][state] - self._true_upper[state]
        return float(room / self._unit[state])

    def _best(self, bound: int, phase: Phase) -> tuple[float, bool]:
        """κ of least estimated cost of a bound, and whether that led beyond what was run."""
        if not len(self._tried):  # the controller failed in all of them
            return float(self.kappa[bound]), False
        settings = self.settings
        reach = settings.reach
        if phase == Phase.COARSE:
            reach = 2 * reach
        estimate = self._estimate(bound, reach)
        kappa = estimate.kappa
        least = self._least(bound)
        low = max(kappa.min() - reach, least)
        high = kappa.max() + reach
        # Multiples of the resolution, so that a start in its last digits has the same grid.
        first = np.ceil(low / settings.resolution)
        last = np.floor(high / settings.resolution)
        grid = settings.resolution * np.arange(first, last + 1)
        best = estimate.best_of(grid, settings.plateau)
        # Beyond what was run an estimate is a guess: of these κ the best is chosen.
        falls_at_low_end = best == grid[0] and low > least
        if best == grid[-1] or falls_at_low_end:
            return estimate.best_of(np.unique(kappa), settings.plateau), True
        return best, False

    def _estimate(self, bound: int, reach: float) -> CostEstimate:
        """Estimated cost at other κ of a bound.

        Args:
            bound: whose κ were tried.
            reach: how far, in κ, a sample speaks for another κ.
        """
        rounds = self._tried[:, 0]
        kappa = self._tried[:, 1]
        costs_and_states = self._tried[:, 2:]
        slopes = slopes_within_rounds(rounds, kappa, costs_and_states)
        state_slopes = slopes[1:]
        # The state itself moves as its bound does.
        state = bound % self._n
        direction = 1 if bound < self._n else -1
        state_slopes[state] = self._unit[state] * direction
        return CostEstimate(
            kappa=kappa,
            states=costs_and_states[:, 1:],
            mean_cost=float(costs_and_states[:, 0].mean()),
            cost_slope=slopes[0],
            state_slopes=state_slopes,
            penalty=self._penalty,
            # κ are multiples of the resolution: half of it decides no rounding.
            reach=reach + self.settings.resolution / 2,
        )

    def state_dict(self) -> State:
        """The schedule, the open round and segment, and the best back-offs."""
        return {
            "kappa": self.kappa,
            "has_ended": self.has_ended,
            "unit": self._unit,
            "active": self._active,
            "schedule": np.array(self._schedule, int),
            "round": self._round,
            "candidates": self._candidates,
            "number": self._number,
            "tried": self._tried,
            **prefixed("segment", self._segment.state_dict()),
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self.kappa = state["kappa"]
        self.has_ended = state["has_ended"]
        self._unit = state["unit"]
        self._active = state["active"]
        self._schedule = []
        for bound, phase in state["schedule"].tolist():
            self._schedule.append(Round(bound, Phase(phase)))
        self._round = state["round"]
        self._candidates = state["candidates"]
        self._number = state["number"]
        self._tried = state["tried"]
        self._segment.load_state_dict(part_of(state, "segment"))


def slopes_within_rounds(
    rounds: Vector,
    kappa: Vector,
    values: Matrix,
) -> Vector:
    """Slopes d/dκ of the means of values, by least squares within the rounds.

    Rounds meet different noise, so that their means say nothing of κ.

    Args:
        rounds: number of each sample's round, (K,).
        kappa: its κ, (K,).
        values: whose means are compared, (K, M).

    Returns:
        The slopes, (M,); zero where κ is the same throughout.
    """
    above = np.zeros(values.shape[1])
    below = 0.0
    for number in np.unique(rounds):
        inside = rounds == number
        of_round = kappa[inside]
        centred = of_round - of_round.mean()
        above += centred @ values[inside]
        below += float(centred @ centred)
    return np.asarray(above / below if below > 0 else above)


class BackOff(Algorithm):
    """One number κ an active bound, found by a line search (`BackOffSearch`); else θ stays.

    `theta` is the best θ so far; the controller carries the one that is tried.
    """

    learns_from_estimates = True

    Configuration: ClassVar[type[Configuration]] = BackOffConfiguration
    budget: ClassVar[int] = DEFAULT_BUDGET
    explores = False

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        start = self.controller.parameters
        self._search = BackOffSearch(
            start,
            self.scenario,
            self.samples,
            self.rng,
            self.configuration,
        )
        self.controller.theta = self._search.trial.theta

    @property
    def theta(self) -> Vector:
        """θ with the best back-offs so far, (n_θ,)."""
        return self._search.theta.theta

    def observe(self, transition: Transition | None) -> Update | None:
        """Learn from one sample; the last one of a segment sets the θ of the next."""
        if self._search.has_ended or not self._search.observe(transition):
            return None
        # The θ of the next segment, or the best one after the last.
        old = self.controller.theta
        new = self._search.trial
        self.controller.theta = new.theta
        refused = self._search.led_beyond
        return update_without_fit(new.blocks, old, new.theta, refused=refused)

    def failed(self, cost: float) -> Update | None:
        """Count a sample at which the controller failed."""
        return self.observe(None)

    def state_dict(self) -> State:
        """The search."""
        return prefixed("search", self._search.state_dict())

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._search.load_state_dict(part_of(state, "search"))


def backed_off_by_errors(
    parameters: Parameters,
    scenario: Scenario,
    errors: Matrix,
) -> Parameters:
    """θ with its bounds backed off by the largest prediction errors.

    None of these would have led from within θ's bounds to beyond the scenario's. Bounds that would
    cross stay.

    Args:
        parameters: θ.
        scenario: the true bounds.
        errors: e, (K, n).
    """
    lowest = errors.min(axis=0)
    highest = errors.max(axis=0)
    downwards = np.maximum(-lowest, 0.0)
    upwards = np.maximum(highest, 0.0)
    lower = scenario.state_lower + downwards
    upper = scenario.state_upper - upwards
    crossed = lower >= upper
    lower = np.where(crossed, parameters["x_l"], lower)
    upper = np.where(crossed, parameters["x_u"], upper)
    return parameters.replace({"x_l": lower, "x_u": upper})
