"""A line search over the back-off of the active bounds, on samples of the plant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector
from cosim.scenario import Scenario
from learning.algorithm import Transition
from learning.episodes import Episode, Told
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


@dataclass(eq=False)
class Segment(Episode):
    """A stretch of operation; `asked` are the places in θ of the bounds (2n,) that may bind."""

    KEPT = (*Episode.KEPT, "rows", "binding")
    asked: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        self.rows: list[Vector] = []
        self.binding: Vector = np.zeros(self.asked.size)

    def take(self, transition: Transition | None, cost: float) -> bool:
        """Keep a sample."""
        if transition is not None:
            measured = (transition.s, transition.a, transition.next_s)
            self.rows.append(np.concatenate([[self.done, transition.stage_cost], *measured]))
            if self.asked.size:
                self.binding += transition.policy.value_gradient[self.asked] != 0
        return super().take(transition, cost)

    def told(self) -> Told:
        """Rows of number, stage cost, s, a and s₊, (K, 2+2n+m); how often each bound bound."""
        rows = np.array(self.rows) if self.rows else np.zeros((0, 2 + self.asked.size))
        return {"rows": rows, "binding": self.binding / self.length}


class BackOffSearch:
    """Finds the κ of least cost for the active bounds x_l + κσ and x_u − κσ.

    σ is the standard deviation of the model's one-step prediction error in each state; a bound is
    active where it binds in the QP (dV/dx_l or dV/dx_u ≠ 0) in `BINDING` of the samples. Each has a
    line search of three rounds (docs/method.md). The bound that binds most often at κ = 0 has the
    first round, which finds the others, and the last two. No true bound is loosened. Of back-offs
    whose estimates differ by less than `PLATEAU` the smallest is taken. Where the estimate falls to
    the end of its range, the best back-off that was run is taken, the next round is about it, and
    the round's last segment is `refused`. `start` is θ with no bound backed off; it may be set
    until the `plan` begins. Raises ConfigurationError on a budget that is too small.
    """

    def __init__(
        self, start: Parameters, scenario: Scenario, budget: int, rng: np.random.Generator
    ) -> None:
        problem = Problem.from_scenario(scenario)
        least = 2 * SEGMENTS * problem.horizon
        if budget < least:
            raise ConfigurationError(
                f"a search of the back-off needs at least {least} samples, it has {budget}"
            )
        self.start, self._budget = start, budget
        self._penalty, self._model = scenario.state_penalty, OneStepModel(scenario)
        self._settling = problem.horizon
        self._n = n = problem.n_states
        self._true = (scenario.state_lower, scenario.state_upper)
        self._seeds = rng.integers(2**63, size=2 * n * len(PHASES)).tolist()
        self.kappa = np.zeros(2 * n)
        """Best back-offs found, of lower then upper bounds, (2n,)."""
        self._unit = np.zeros(n)

    @property
    def theta(self) -> Parameters:
        """θ with the best back-offs found."""
        return self.at(self.kappa)

    def at(self, kappa: Vector) -> Parameters:
        """θ with its bounds κ (2n,) backed off, within the true bounds, x_l kept below x_u."""
        lower = np.maximum(self.start["x_l"] + kappa[: self._n] * self._unit, self._true[0])
        upper = np.minimum(self.start["x_u"] - kappa[self._n :] * self._unit, self._true[1])
        crossed = lower >= upper
        middle = (lower + upper) / 2
        lower[crossed], upper[crossed] = middle[crossed] - 1e-6, middle[crossed] + 1e-6
        return self.start.replace({"x_l": lower, "x_u": upper})

    def plan(self) -> Iterator[Segment]:
        """The whole search; the segments of a round meet the same noise."""
        n, slices = self._n, self.start.blocks.slices
        bounds = np.concatenate(
            [np.arange(self.start.theta.size)[slices[b]] for b in ("x_l", "x_u")]
        )
        steps = self._budget // SEGMENTS
        segment = Segment(self.theta.theta, steps, self._seeds[0], asked=bounds)
        yield segment
        rows, share = segment.answer["rows"], segment.answer["binding"]
        if not len(rows) or share.max() < BINDING:
            return
        states, following = rows[:, 2 : 2 + n], rows[:, -n:]
        errors = self._model.errors(states, rows[:, 2 + n : -n], following, self.start)
        self._unit = errors.std(axis=0)
        first = int(np.argmax(share))
        schedule, tried = [(first, 0)], [self._settled(segment, 0, 0.0)]
        for number, (bound, phase) in enumerate(schedule):
            if number and phase != 2:  # the second round's samples count in the third one too
                tried = []
            left = 13 / sum(PHASES[later][0] for _, later in schedule[1:]) if number else 1.0
            steps, kappas = self._segments(bound, phase, left)
            for kappa in kappas[0 if number else 1 :]:
                asked = bounds[: 0 if number else None]
                segment = Segment(self.at(kappa).theta, steps, self._seeds[number], asked=asked)
                yield segment
                tried.append(self._settled(segment, number, kappa[bound]))
                share = share if number else np.maximum(share, segment.answer["binding"])
            self.kappa[bound], segment.refused = self._best(bound, phase, np.concatenate(tried))
            if not number:
                others = [int(i) for i in np.flatnonzero(share >= BINDING) if i != first]
                schedule += [(other, phase) for other in others for phase in range(3)]
                schedule += [(first, 1), (first, 2)]

    def _settled(self, segment: Segment, number: int, kappa: float) -> Matrix:
        """Round, κ, stage cost and state, (K, 3+n), of a segment once the loop has settled."""
        rows = segment.answer["rows"]
        rows = rows[rows[:, 0] >= self._settling, 1 : 2 + self._n]
        return np.hstack([np.full((len(rows), 2), (number, kappa)), rows])

    def _segments(self, bound: int, phase: int, left: float) -> tuple[int, list[Vector]]:
        """Samples of each segment of a round, and their back-offs."""
        share, offsets = PHASES[phase]
        # The first round is about one bound; later rounds share the samples that it leaves.
        steps = int(self._budget * left * share / (SEGMENTS * len(offsets)))
        if phase == 0 and (least := max(self._least(bound), -offsets[-1])) < -1.0:
            offsets = (0.0, least, least / 2)  # of a start that is backed off, look for less
        kappas = [self.kappa.copy() for _ in offsets]
        for kappa, offset in zip(kappas, offsets, strict=True):
            kappa[bound] = max(kappa[bound] + offset, self._least(bound))
        return max(steps, self._settling + 1), kappas

    def _least(self, bound: int) -> float:
        """κ of the true bound; at most 0 if the start loosens no bound."""
        state, upper = bound % self._n, bound >= self._n
        room = (
            self.start["x_u"][state] - self._true[1][state]
            if upper
            else self._true[0][state] - self.start["x_l"][state]
        )
        return float(room / self._unit[state]) if self._unit[state] > 0 else 0.0

    def _best(self, bound: int, phase: int, tried: Matrix) -> tuple[float, bool]:
        """κ of least estimated cost of a bound, and whether the estimate led beyond what was tried.

        `tried` are rows of `_settled`.
        """
        n = self._n
        if not len(tried):  # the controller failed in all of them
            return float(self.kappa[bound]), False
        kappa, costs, states = tried[:, 1], tried[:, 2], tried[:, 3:]
        slope = self._slopes(tried[:, 0], kappa, tried[:, 2:])
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

        mean, least = float(costs.mean()), self._least(bound)
        low, high = max(kappa.min() - reach, least), kappa.max() + reach
        # Multiples of the resolution, so that a start in its last digits has the same grid.
        steps = np.arange(np.ceil(low / RESOLUTION), np.floor(high / RESOLUTION) + 1)
        grid = RESOLUTION * steps
        found = best_of(grid)
        if found == grid[-1] or (found == grid[0] and low > least):
            return best_of(np.unique(kappa)), True
        return found, False

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
