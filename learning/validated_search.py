"""Globalisation: what θ to try next, and which of two θ is the better one, as a plan of episodes.

`ValidatedSearch.plan` is a generator. It yields what the plant shall be run for (`Learn`,
`Settle`, `Trial`) and is sent what came of it (`Learned`, `Block`); it knows no plant, controller
or rule. Samples are all that it spends, and it counts them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from cosim.scenario import Scenario
from learning.episodes import Learn, Learned, Plan, Step
from learning.line_search import LineSearch
from learning.prior import prior_deviation
from learning.race import Candidate, Races, Spent

Vector = NDArray[np.float64]


class ValidatedSearch:
    """Phases of learning, each followed by line searches on common noise; the incumbent survives.

    One round: the rule learns from the incumbent; the incumbent of the round before and the θ that
    the rule passed through are raced against it; then come line searches along the back-off of all
    state bounds and over the order of magnitude of the inputs' weights. A candidate takes the
    incumbent's place only if it is cheaper on the same noise. If no learnt θ did, races become
    twice as long, the next phase begins anew with half the width, a trust region about the
    incumbent, and before it come line searches along the back-off of each state, along the
    directions in θ that move the policy most (leading eigenvectors of E[∇π ∇πᵀ] in the prior's
    coordinates, turned at random so that no ridge stays in the way), and along the round's whole
    way. Races of a round all begin at the plant as it was when the round's learning ended, with
    the same noise to come; so slow states are where operation takes them, and each round has new
    noise. The last samples go to a longer race, in a new episode, between the incumbent, the start
    and earlier incumbents.

    `scenario` gives bounds and penalty, `action_deviation` (m,) the exploration's σ, `samples` the
    budget, `block` samples make a block, at most `blocks` of them a race, `phase` a phase.
    """

    FINAL = 0.25
    """Share of the samples for the last race."""
    FINALISTS = 3.2
    """Runs over all blocks of the last race that its samples suffice for."""

    def __init__(
        self,
        scenario: Scenario,
        start: Parameters,
        action_deviation: Vector,
        samples: int,
        seed: int,
        *,
        phase: int,
        block: int,
        blocks: int,
    ) -> None:
        self._start, self._states = start, scenario.state_lower.size
        self._action_deviation, self._samples = action_deviation, samples
        # A short run has short phases and races.
        self._phase = min(phase, max(samples // 8, 1))
        block = min(block, max(samples // 100, 1))
        self._rng = np.random.default_rng(seed)
        self._races = Races(scenario, start, samples, block=block, blocks=blocks)
        self._longer = 2 * blocks
        self._lines = LineSearch(self._races, start, action_deviation.size, self._rng)
        self._past = [start.theta]

    @property
    def block(self) -> int:
        """Samples of a block."""
        return self._races.block

    @property
    def incumbent(self) -> Candidate:
        """The best θ so far."""
        return self._races.incumbent

    @property
    def accepted(self) -> int:
        """How often the incumbent changed."""
        return self._races.accepted

    @property
    def expected(self) -> float:
        """Penalty expected of the latest block in a race."""
        return self._races.expected

    @property
    def spent(self) -> int:
        """Samples asked for so far."""
        return self._races.spent

    def plan(self) -> Plan:
        """The whole run."""
        races = self._races
        races.limit = int((1.0 - self.FINAL) * self._samples)
        try:
            yield from self._rounds()
        except Spent:
            races.limit = self._samples
        blocks = max(int(self.FINAL * self._samples / races.block / self.FINALISTS), 1)
        last = len(self._past) - 1
        order = dict.fromkeys([0, last, last // 2, *range(last - 1, 0, -1)])
        # The best of many moves is partly luck, and a round's race too short for what is rare.
        rivals = [self._past[k] for k in order]
        rivals = [theta for theta in rivals if not np.array_equal(theta, self.incumbent.theta)]
        try:
            yield from races.final(rivals, blocks, int(self._rng.integers(2**31)))
        except Spent:
            return

    def _rounds(self) -> Plan:
        """Rounds without end; the samples are what ends them."""
        races, lines = self._races, self._lines
        back_off, weights, reach = 1.0, -1.0, np.full(lines.DIRECTIONS, 0.5)
        bounds = [0.5] * self._states
        width, number, better, rescaled, failed, rest = 1.0, 0, True, False, 0, 0
        while True:
            before = races.incumbent.theta
            # What is left at the end may be too little to learn from, not to search with.
            enough = races.limit - races.spent >= self._phase + races.blocks * races.block
            if enough and rest == 0:
                better = yield from self._learn(width, goes_on=better and not rescaled)
                failed = 0 if better else failed + 1
                width, rest = (width, 0) if better else (0.5 * width, failed)
            else:
                better = False
                yield from self._renew()
            if not better:
                races.blocks = self._longer
            rest = max(rest - 1, 0)
            back_off = yield from lines.along(lines.tightening(), min(back_off, 1.0))
            unscaled = races.incumbent
            weights = yield from lines.rescale(weights)
            rescaled = races.incumbent is not unscaled
            # While learning pays, searching would only cost samples.
            if not better:
                for state in range(self._states):
                    tightening = lines.tightening(state)
                    bounds[state] = yield from lines.along(tightening, min(bounds[state], 1.0))
                directions = yield from lines.directions(turned=number > 0)
                for j, direction in enumerate(directions.T):
                    reach[j] = yield from lines.along(direction, float(np.clip(reach[j], 0.05, 1)))
                way = (races.incumbent.theta - before) / lines.scale
                if way.any():
                    yield from lines.along(way, 0.5)
                number += 1
            if not np.array_equal(before, self._past[-1]):
                self._past.append(before)

    def _renew(self) -> Plan:
        """Run the incumbent on new noise, and race the one before it against it once more.

        That may have lost on a round's noise alone, or before a slow state showed what the new one
        does to it.
        """
        races, past = self._races, self._past[-1]
        yield from races.renew(races.blocks)
        if not np.array_equal(past, races.incumbent.theta):
            yield from races.race(past, patient=True)

    def _learn(self, width: float, *, goes_on: bool) -> Step:
        """Learn from the incumbent and race what came of it, the latest θ first."""
        races = self._races
        races.spend(self._phase)
        learned = yield Learn(races.incumbent.theta, self._phase, width, goes_on)
        assert isinstance(learned, Learned)
        self._measure(learned)
        yield from self._renew()
        better = False
        for theta in learned.candidates[::-1]:
            better |= yield from races.race(theta)
        return better

    def _measure(self, learned: Learned) -> None:
        """Take the coordinates of the searches from the latest data about the incumbent."""
        start = self._start.with_theta(self.incumbent.theta)
        self._lines.scale = prior_deviation(
            start,
            learned.state_deviation,
            learned.error_deviation,
            self._action_deviation,
            abs(float(start["c_lambda"])),
            0.3,
        )
        self._races.remember(learned.errors)
