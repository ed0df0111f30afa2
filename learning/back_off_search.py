"""A line search over the back-off of the active bounds, on samples of the plant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector
from cosim.scenario import Scenario
from learning.algorithm import Transition
from learning.errors import ConfigurationError
from learning.prediction_errors import OneStepModel, known_penalty

PHASES = ((3, (0.0, 2.0, 4.0)), (5, (-0.5, 0.0, 0.5)), (8, (-0.25, 0.25)))
"""Sixteenths of a bound's samples, and back-offs κ about the best so far, of each round."""
REACH = 1.0
"""How far, in κ, a sample speaks for another back-off; twice that in the coarse first round."""
RESOLUTION = 0.01
PLATEAU = 1e-6
"""Estimated costs that differ by this share are one, so that no last digit decides."""
SEGMENTS = 16
"""The budget has that many of the first round's stretches."""
BINDING = 0.05
"""Share of the samples in which a bound must bind to count as active."""


class Segment(NamedTuple):
    """A stretch of `steps` samples of a `round` with back-offs `kappa` (2n,)."""

    round: int
    steps: int
    kappa: Vector


class BackOffSearch:
    """Finds the κ of least cost for the active bounds x_l + κσ and x_u − κσ.

    σ is the standard deviation of the model's one-step prediction error in each state; a bound is
    active where it binds in the QP (dV/dx_l or dV/dx_u ≠ 0) in `BINDING` of the samples. Each has a
    line search of three rounds (docs/method.md). The bound that binds most often at κ = 0 has the
    first round, which finds the others, and the last two. No true bound is loosened. Of back-offs
    whose estimates differ by less than `PLATEAU` the smallest is taken. Where the estimate falls to
    the end of its range, the best back-off that was run is taken, and the next round is about it;
    `refused` says so of the latest round. Raises ConfigurationError on a budget that is too small.
    """

    KEPT = (
        *("origin", "stretches", "kappa", "_unit", "_schedule", "_segment", "_step", "_binding"),
        *("_share", "_seeds", "_first", "_rows"),
    )

    def __init__(
        self,
        start: Parameters,
        problem: Problem,
        scenario: Scenario,
        budget: int,
        rng: np.random.Generator,
    ) -> None:
        least = 2 * SEGMENTS * problem.horizon
        if budget < least:
            raise ConfigurationError(
                f"a search of the back-off needs at least {least} samples, it has {budget}"
            )
        self.origin, self._parameters, self._budget = start.theta, start, budget
        self._penalty, self._model = scenario.state_penalty, OneStepModel(scenario)
        self._settling = problem.horizon
        n, self._actions = problem.n_states, problem.n_actions
        self._n = n
        self._true = (scenario.state_lower, scenario.state_upper)
        self._seeds = rng.integers(2**63, size=2 * n * len(PHASES)).tolist()
        self.kappa = np.zeros(2 * n)
        """Best back-offs found, of lower then upper bounds, (2n,)."""
        self._unit = np.zeros(n)
        self._schedule: list[tuple[int, int]] = []
        self._plan = [Segment(0, budget // SEGMENTS, self.kappa.copy())]
        self._segment = self._step = 0
        self.refused = False
        self._binding, self._share = np.zeros(2 * n), np.zeros(2 * n)
        self._first: list[Vector] = []
        self._rows: list[Vector] = []

    @property
    def start(self) -> Parameters:
        """θ with no bound backed off."""
        return self._parameters.with_theta(self.origin)

    @property
    def seed(self) -> int:
        """Seed of the noise of the present episode."""
        return int(self._seeds[self._plan[self._segment].round])

    @property
    def theta(self) -> Parameters:
        """θ with the best back-offs found."""
        return self.at(self.kappa)

    @property
    def candidate(self) -> Parameters:
        """θ that is tried now."""
        return self.theta if self.done else self.at(self._plan[self._segment].kappa)

    @property
    def done(self) -> bool:
        """Whether the budget is spent, or no bound is active."""
        return self._segment >= len(self._plan)

    def at(self, kappa: Vector) -> Parameters:
        """θ with its bounds κ (2n,) backed off, within the true bounds, x_l kept below x_u."""
        lower = np.maximum(self.start["x_l"] + kappa[: self._n] * self._unit, self._true[0])
        upper = np.minimum(self.start["x_u"] - kappa[self._n :] * self._unit, self._true[1])
        crossed = lower >= upper
        middle = (lower + upper) / 2
        lower[crossed], upper[crossed] = middle[crossed] - 1e-6, middle[crossed] + 1e-6
        return self.start.replace({"x_l": lower, "x_u": upper})

    def observe(self, transition: Transition | None) -> bool:
        """Take a sample, None after a failure; returns whether a new episode begins."""
        if self.done:
            return False
        segment = self._plan[self._segment]
        if transition is not None and self._step >= self._settling:
            cost = [float(segment.round), transition.stage_cost]
            self._rows.append(np.concatenate([cost, segment.kappa, transition.s]))
        if transition is not None and segment.round == 0:
            gradient, slices = transition.policy.value_gradient, self.start.blocks.slices
            bounds = [gradient[slices[name]] for name in ("x_l", "x_u")]
            self._binding += np.concatenate(bounds) != 0
            if self._segment == 0:
                self._first.append(np.concatenate([transition.s, transition.a, transition.next_s]))
        self._step += 1
        self.refused = False
        if self._step < segment.steps:
            return False
        self._share = np.maximum(self._share, self._binding / segment.steps)
        self._binding[:] = 0.0
        self._step = 0
        self._segment += 1
        if self._segment == 1:
            self._begin()
        elif self.done:
            self._end_round(segment.round)
        return not self.done

    def _begin(self) -> None:
        """σ and the bound to begin with, from the first segment, at κ = 0."""
        if not self._first or self._share.max() < BINDING:
            return
        rows, n = np.array(self._first), self._n
        errors = self._model.errors(rows[:, :n], rows[:, n:-n], rows[:, -n:], self.start)
        self._unit = errors.std(axis=0)
        self._schedule = [(int(np.argmax(self._share)), 0)]
        self._plan += self._segments(0)[1:]

    def _end_round(self, number: int) -> None:
        """Move κ to the estimated optimum and plan the next round about it."""
        first = self._schedule[0][0]
        self.kappa[self._schedule[number][0]] = self._best(number)
        if number == 0:
            others = [int(i) for i in np.flatnonzero(self._share >= BINDING) if i != first]
            self._schedule += [(bound, phase) for bound in others for phase in range(3)]
            self._schedule += [(first, 1), (first, 2)]
        if number + 1 < len(self._schedule):
            self._plan += self._segments(number + 1)

    def _segments(self, number: int) -> list[Segment]:
        bound, phase = self._schedule[number]
        share, offsets = PHASES[phase]
        # The first round is about one bound; later rounds share the samples that it leaves.
        left = 13 / sum(PHASES[later][0] for _, later in self._schedule[1:]) if number else 1.0
        steps = int(self._budget * left * share / (SEGMENTS * len(offsets)))
        steps = max(steps, self._settling + 1)
        if phase == 0 and (least := max(self._least(bound), -offsets[-1])) < -1.0:
            offsets = (0.0, least, least / 2)  # of a start that is backed off, look for less
        kappas = [self.kappa.copy() for _ in offsets]
        for kappa, offset in zip(kappas, offsets, strict=True):
            kappa[bound] = max(kappa[bound] + offset, self._least(bound))
        return [Segment(number, steps, kappa) for kappa in kappas]

    def _least(self, bound: int) -> float:
        """κ of the true bound; at most 0 if the start loosens no bound."""
        state, upper = bound % self._n, bound >= self._n
        room = (
            self.start["x_u"][state] - self._true[1][state]
            if upper
            else self._true[0][state] - self.start["x_l"][state]
        )
        return float(room / self._unit[state]) if self._unit[state] > 0 else 0.0

    def _best(self, number: int) -> float:
        """κ of least estimated cost of a round's bound, from this round and the second one."""
        n, (bound, phase) = self._n, self._schedule[number]
        rows = np.array(self._rows).reshape(len(self._rows), 2 + 3 * n)
        rows = rows[rows[:, 0] >= number - (phase == 2)]
        if not len(rows):  # the controller failed in all of them
            return float(self.kappa[bound])
        kappa, states = rows[:, 2 + bound], rows[:, 2 + 2 * n :]
        slope = self._slopes(rows[:, 0], kappa, np.column_stack([rows[:, 1], states]))
        slope[1 + bound % n] = self._unit[bound % n] * (1 if bound < n else -1)
        reach = REACH * (2 if phase == 0 else 1)

        def estimate(value: float) -> float:
            near = np.abs(kappa - value) < reach + RESOLUTION / 2
            moved = states[near] + np.outer(value - kappa[near], slope[1:])
            return float(slope[0] * value + known_penalty(self._penalty, moved).mean())

        def best_of(values: Vector) -> float:
            costs = mean + np.array([estimate(value) for value in values])
            plateau = values[costs <= costs.min() + PLATEAU * abs(costs.min())]
            return float(plateau[np.argmin(np.abs(plateau))])

        mean, least = float(rows[:, 1].mean()), self._least(bound)
        low, high = max(kappa.min() - reach, least), kappa.max() + reach
        # Multiples of the resolution, so that a start in its last digits has the same grid.
        steps = np.arange(np.ceil(low / RESOLUTION), np.floor(high / RESOLUTION) + 1)
        grid = RESOLUTION * steps
        found = best_of(grid)
        if found == grid[-1] or (found == grid[0] and low > least):
            self.refused = True
            return best_of(np.unique(kappa))
        return found

    @staticmethod
    def _slopes(rounds: Vector, kappa: Vector, values: Matrix) -> Vector:
        """d/dκ of each column's mean, (1+n,), within the rounds."""
        above, below = np.zeros(values.shape[1]), 0.0
        for number in np.unique(rounds):
            mine = rounds == number
            centred = kappa[mine] - kappa[mine].mean()
            above += centred @ values[mine]
            below += float(centred @ centred)
        return np.asarray(above / below if below > 0 else above)

    @property
    def stretches(self) -> list[Vector]:
        """The plan as rows: κ, the round, the samples."""
        return [np.append(segment.kappa, segment[:2]) for segment in self._plan]

    @stretches.setter
    def stretches(self, rows: list[Vector]) -> None:
        self._plan = [Segment(int(row[-2]), int(row[-1]), row[:-2]) for row in rows]
