"""`backoff`: how far to back off from each active bound, by a line search on the plant.

`BackOffSearch` is the search; the rule runs it on the plant, `learning.backed_off` on the model.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.protocols import Matrix, Vector
from cosim.core.scenario import Positive, Scenario
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
        description="how far, in κ, a sample speaks for another back-off; twice that in the coarse "
        "round",
    )
    resolution: Positive = Field(0.01, description="step of κ")
    plateau: Positive = Field(
        1e-6,
        description="estimated costs that differ by this share are one, so that no last digit "
        "decides",
    )
    active_share: Share = Field(
        0.05,
        description="share of the samples in which a bound must be active to be searched",
    )


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
        self._n_columns = 2 + 2 * n + problem.n_actions
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
        # Rounds (bound, Phase); the first segment finds the bound of the first.
        self._schedule: list[list[int]] = []
        self._round = 0
        self._candidates: Matrix = self.kappa[None].copy()  # κ of the round's segments, (S, 2n)
        self._tried: Matrix = np.zeros((0, 3 + n))  # rows (round, κ, ℓ, s) of settled samples
        self._segment = 0
        self._begin_segment(budget // self._shares)

    @property
    def theta(self) -> Parameters:
        """θ with the best back-offs so far."""
        return self.backed_off(self.kappa)

    @property
    def trial(self) -> Parameters:
        """θ of the present segment; the best one when the search has ended."""
        if self.has_ended:
            return self.theta
        kappa = self._candidates[self._segment]
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
        if transition is not None:
            row = [
                self._count,
                transition.stage_cost,
                *transition.s.tolist(),
                *transition.a.tolist(),
                *transition.next_s.tolist(),
            ]
            self._rows.append(row)
            # Which bounds are active is found in the first round alone.
            if self._round == 0:
                gradient = transition.solution.value_gradient
                multipliers = gradient[self._bounds]
                self._n_active += multipliers != 0
        self._count += 1
        if self._count < self._length:
            return False
        self._end_segment()
        return True

    def _begin_segment(self, length: int) -> None:
        self._length = length
        self._count = 0
        self._rows: list[list[float]] = []  # (number, ℓ, s, a, s₊) of samples that did not fail
        self._n_active = np.zeros(2 * self._n)  # samples in which each bound was active

    def _end_segment(self) -> None:
        self.led_beyond = False
        rows = np.array(self._rows).reshape(-1, self._n_columns)
        # A bound counts that was active at any of the first round's κ.
        if self._round == 0:
            share = self._n_active / self._length
            self._active = np.maximum(self._active, share)
        if not self._schedule:
            length = self._begin_schedule(rows)
        else:
            bound, _ = self._schedule[self._round]
            kappa = self._candidates[self._segment, bound]
            self._keep(rows, kappa)
            length = self._length
        if self.has_ended:
            return
        self._segment += 1
        if self._segment == len(self._candidates):
            length = self._end_round()
        self._begin_segment(length)

    def _begin_schedule(self, rows: Matrix) -> int:
        """Find σ and the first bound; the first segment counts as the first of its coarse round.

        Returns:
            Samples of the next segment.
        """
        if not len(rows) or self._active.max() < self.settings.active_share:
            self.has_ended = True
            return 0
        n = self._n
        m = self._n_columns - 2 - 2 * n
        _, _, states, actions, next_states = np.split(rows, np.cumsum([1, 1, n, m]), axis=1)
        errors = self._model.errors(states, actions, next_states, self.start)
        self._unit = errors.std(axis=0)
        first = int(np.argmax(self._active))
        self._schedule = [[first, Phase.COARSE]]
        self._keep(rows, 0.0)
        # The first round is about one bound; later rounds share the samples that it leaves.
        length, self._candidates = self._round_at(first, Phase.COARSE, 1.0)
        return length

    def _keep(self, rows: Matrix, kappa: float) -> None:
        """Keep the samples of a segment at κ once the loop has settled."""
        number = rows[:, 0]
        settled = rows[number >= self._settling]
        # Round and κ stand before the sample: slopes are taken within a round.
        label = np.full((len(settled), 2), (self._round, kappa))
        last = 2 + self._n
        cost_and_state = settled[:, 1:last]
        kept = np.hstack([label, cost_and_state])
        self._tried = np.concatenate([self._tried, kept])

    def _end_round(self) -> int:
        """Choose the round's κ and begin the next round; samples of its segments."""
        bound, phase = self._schedule[self._round]
        self.kappa[bound], self.led_beyond = self._best(bound, phase)
        if self._round == 0:
            self._schedule += self._later_rounds(bound)
        self._round += 1
        self._segment = 0
        if self._round == len(self._schedule):
            self.has_ended = True
            return 0
        bound, phase = self._schedule[self._round]
        # The samples of the medium round count in the fine one too.
        if phase != Phase.FINE:
            self._tried = self._tried[:0]
        # What the first round has left, over all rounds to come.
        shares = self.settings.round_shares
        left = self._shares - shares[Phase.COARSE]
        total = sum(shares[later] for _, later in self._schedule[1:])
        length, self._candidates = self._round_at(bound, phase, left / total)
        return length

    def _later_rounds(self, first: int) -> list[list[int]]:
        """The rounds after the coarse one of the first bound: those of the others, then its own."""
        rounds: list[list[int]] = []
        active = self._active >= self.settings.active_share
        for bound in np.flatnonzero(active).tolist():
            if bound != first:
                rounds += [
                    [bound, Phase.COARSE],
                    [bound, Phase.MEDIUM],
                    [bound, Phase.FINE],
                ]
        return [*rounds, [first, Phase.MEDIUM], [first, Phase.FINE]]

    def _round_at(
        self,
        bound: int,
        phase: int,
        left: float,
    ) -> tuple[int, Matrix]:
        """A round of a bound.

        Args:
            bound: whose κ is tried.
            phase: Phase.COARSE, Phase.MEDIUM or Phase.FINE.
            left: factor of the round's share of the budget.

        Returns:
            Samples of each segment, and κ of all bounds in each, (S, 2n).
        """
        settings = self.settings
        rounds = (
            settings.coarse_offsets,
            settings.medium_offsets,
            settings.fine_offsets,
        )
        offsets = rounds[phase]
        share = settings.round_shares[phase]
        parts = self._shares * len(offsets)
        wanted = int(self._budget * left * share / parts)
        # One sample at least counts, once the loop has settled.
        length = max(wanted, self._settling + 1)

        least = self._least(bound)
        back = max(least, -offsets[-1])
        if phase == Phase.COARSE and back < -1.0:
            # Of a start that is backed off, look for less.
            offsets = (0.0, back, back / 2)
        candidates = np.tile(self.kappa, (len(offsets), 1))
        for row, offset in zip(candidates, offsets, strict=True):
            row[bound] = max(row[bound] + offset, least)
        return length, candidates

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

    def _best(self, bound: int, phase: int) -> tuple[float, bool]:
        """κ of least estimated cost of a bound, and whether the estimate led beyond what was run.

        A sample at one κ says what another one would cost: its states move with κ, their penalty
        is known, and the rest of the cost has a slope.
        """
        settings = self.settings
        n = self._n
        if not len(self._tried):  # the controller failed in all of them
            return float(self.kappa[bound]), False
        rounds = self._tried[:, 0]
        kappa = self._tried[:, 1]
        costs_and_states = self._tried[:, 2:]
        costs = costs_and_states[:, 0]
        states = costs_and_states[:, 1:]
        slopes = self._slopes(rounds, kappa, costs_and_states)
        cost_slope = slopes[0]
        state_slopes = slopes[1:]
        # The state itself moves as its bound does.
        state = bound % n
        direction = 1 if bound < n else -1
        state_slopes[state] = self._unit[state] * direction
        reach = settings.reach
        if phase == Phase.COARSE:
            reach = 2 * reach
        # Costs of different κ share their mean; what differs is estimated.
        mean = float(costs.mean())

        def change(value: float) -> float:
            # Samples far away speak for another place of the state.
            distance = value - kappa
            near = np.abs(distance) < reach + settings.resolution / 2
            change_of_states = np.outer(distance[near], state_slopes)
            moved = states[near] + change_of_states
            penalty = known_penalty(self._penalty, moved).mean()
            return float(cost_slope * value + penalty)

        def best_of(values: Vector) -> float:
            changes = [change(value) for value in values]
            estimates = mean + np.array(changes)
            least = estimates.min()
            limit = least + settings.plateau * abs(least)
            plateau = values[estimates <= limit]
            smallest = np.argmin(np.abs(plateau))
            return float(plateau[smallest])

        least = self._least(bound)
        low = max(kappa.min() - reach, least)
        high = kappa.max() + reach
        # Multiples of the resolution, so that a start in its last digits has the same grid.
        first = np.ceil(low / settings.resolution)
        last = np.floor(high / settings.resolution)
        grid = settings.resolution * np.arange(first, last + 1)
        best = best_of(grid)
        # Beyond what was run an estimate is a guess: of these κ the best is chosen.
        falls_at_low_end = best == grid[0] and low > least
        if best == grid[-1] or falls_at_low_end:
            return best_of(np.unique(kappa)), True
        return best, False

    @staticmethod
    def _slopes(
        rounds: Vector,
        kappa: Vector,
        values: Matrix,
    ) -> Vector:
        """d/dκ of the mean of each column of values (K, 1+n), (1+n,), within the rounds (K,)."""
        above = np.zeros(values.shape[1])
        below = 0.0
        for number in np.unique(rounds):
            # Least squares within the round: rounds meet different noise.
            inside = rounds == number
            of_round = kappa[inside]
            centred = of_round - of_round.mean()
            above += centred @ values[inside]
            below += float(centred @ centred)
        return np.asarray(above / below if below > 0 else above)

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
            "tried": self._tried,
            "segment": self._segment,
            "length": self._length,
            "count": self._count,
            "rows": np.array(self._rows),
            "n_active": self._n_active,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self.kappa = state["kappa"]
        self.has_ended = state["has_ended"]
        self._unit = state["unit"]
        self._active = state["active"]
        self._schedule = state["schedule"].tolist()
        self._round = state["round"]
        self._candidates = state["candidates"]
        self._tried = state["tried"]
        self._segment = state["segment"]
        self._length = state["length"]
        self._count = state["count"]
        self._rows = state["rows"].tolist()
        self._n_active = state["n_active"]


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
