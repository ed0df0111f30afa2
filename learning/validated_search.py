"""Globalisation: what θ to try next, and which of two θ is the better one, as a plan of episodes.

`ValidatedSearch.plan` is a generator. It yields what the plant shall be run for (`Learn`, `Trial`)
and is sent what came of it (`Learned`, `Block`); it knows no plant, controller or rule. Samples
are all that it spends, and it counts them.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from controllers.theta import ThetaBlocks
from cosim.scenario import Scenario
from learning.definiteness import certificate, clip_eigenvalues
from learning.prediction_errors import KnownPenalty, SortedErrors
from learning.prior import prior_deviation

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Learn(NamedTuple):
    """Let the rule learn from θ (n_θ,) for some samples.

    A rule that `goes_on` keeps what it has learnt so far; a new one has a prior or trust region
    `width` times as wide as the configured one.
    """

    theta: Vector
    samples: int
    width: float
    goes_on: bool


class Settle(NamedTuple):
    """Run θ (n_θ,) greedily for a block, and remember the plant as it is then."""

    theta: Vector


class Trial(NamedTuple):
    """Run θ (n_θ,) greedily for a block, from the remembered plant or on from the last block.

    The remembered plant includes its noise to come. `sensitive` asks for dπ/dθ.
    """

    theta: Vector
    begins: bool
    sensitive: bool = False


class Learned(NamedTuple):
    """What a phase of learning gives.

    `candidates` (K, n_θ), the last is where it ended; `errors` (M, n) one-step prediction errors;
    `state_deviation` (n,).
    """

    candidates: Matrix
    errors: Matrix
    state_deviation: Vector


class Block(NamedTuple):
    """What a block gives: mean `stage_cost` and `penalty` a sample, `predictions` f(s, a) (K, n).

    `errors` (K, n) beside them are e = s₊ − f(s, a); `metric` is E[∇π Σ⁻¹ ∇πᵀ] (n_θ, n_θ) if it
    was asked for, with Σ the exploration's variance.
    """

    stage_cost: float
    penalty: float
    predictions: Matrix
    errors: Matrix
    metric: Matrix | None


Request = Learn | Settle | Trial
Plan = Generator[Request, "Learned | Block", None]
Step = Generator[Request, "Learned | Block", bool]


class Spent(Exception):
    """The samples are used up."""


@dataclass
class Candidate:
    """A θ with the mean costs of its blocks: `realised`, and `expected` with pooled errors."""

    theta: Vector
    realised: list[float] = field(default_factory=list)
    expected: list[float] = field(default_factory=list)

    @property
    def costs(self) -> Vector:
        """The dearer of the two readings, block by block: neither may flatter.

        The realised penalty is rare spikes; the expected one is dear by what the errors depend on
        the state, 10 to 20 a sample near the best back-off of `paper`.
        """
        return np.maximum(self.realised, self.expected)

    @property
    def cost(self) -> float:
        """Mean over the blocks."""
        return float(self.costs.mean())


class ValidatedSearch:
    """Phases of learning, each followed by line searches on common noise; the incumbent survives.

    One round: the rule learns from the incumbent; the θ that it passed through are raced against
    it; then comes a line search along the back-off of all state bounds. A candidate takes the
    incumbent's place only if it is cheaper on the same noise. If no learnt θ did, the next phase
    begins anew with half the width, a trust region about the incumbent, and before it come line
    searches along the directions in θ that move the policy most (leading eigenvectors of
    E[∇π ∇πᵀ] in the prior's coordinates, turned at random so that no ridge stays in the way), and
    along the round's whole way. Races of a round all begin at
    the plant as it was when the round's learning ended, with the same noise to come; so slow states
    are where operation takes them, and each round has new noise.
    The last samples go to a longer race between the start and some of the rounds' incumbents.

    `scenario` gives bounds and penalty, `action_deviation` (m,) the exploration's σ, `samples` the
    budget, `block` samples make a block, at most `blocks` of them a race, `phase` a phase.
    """

    DIRECTIONS = 6
    MEMORY = 6000
    """Prediction errors over which a penalty is expected: the tail is what counts."""
    FINAL = 0.25
    """Share of the samples for the last race."""
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
        block: int,
        blocks: int,
    ) -> None:
        self._penalty = KnownPenalty(scenario)
        self._start, self._blocks_of = start, start.blocks
        self._action_deviation, self._samples = action_deviation, samples
        # A short run has short phases and races.
        self._phase = min(phase, max(samples // 8, 1))
        self._block, self._blocks = min(block, max(samples // 100, 1)), blocks
        self._least = 0.5 * max(certificate(start.blocks, start.theta).smallest, 0.0)
        self._rng = np.random.default_rng(seed)
        self._spent, self._limit = 0, samples
        self._errors: Matrix = np.zeros((0, scenario.state_lower.size))
        self._pool = SortedErrors(self._errors)
        self._scale: Vector = np.ones(start.theta.size)
        self.incumbent = Candidate(start.theta)
        self.accepted = 0

    @property
    def block(self) -> int:
        """Samples of a block."""
        return self._block

    def plan(self) -> Plan:
        """The whole run."""
        past = [self._start.theta]
        width, back_off, reach = 1.0, 1.0, np.full(self.DIRECTIONS, 0.5)
        self._limit = int((1.0 - self.FINAL) * self._samples)
        try:
            number, better, failed, rest = 0, True, 0, 0
            while True:
                before = self.incumbent.theta
                # What is left at the end may be too little to learn from, not to search with.
                enough = self._limit - self._spent >= self._phase + self._blocks * self._block
                if enough and rest == 0:
                    better = yield from self._learn(width, goes_on=better)
                    failed = 0 if better else failed + 1
                    width, rest = (width, 0) if better else (0.5 * width, failed)
                else:
                    better = False
                    yield from self._renew(self._blocks)
                rest = max(rest - 1, 0)
                back_off = yield from self._along(self._tightening(), min(back_off, 1.0))
                if better:
                    # While learning pays, searching would only cost samples.
                    past.append(self.incumbent.theta)
                    continue
                directions = yield from self._directions(turned=number > 0)
                for j, direction in enumerate(directions.T):
                    reach[j] = yield from self._along(direction, float(np.clip(reach[j], 0.05, 1)))
                way = (self.incumbent.theta - before) / self._scale
                if way.any():
                    yield from self._along(way, 0.5)
                past.append(self.incumbent.theta)
                number += 1
        except Spent:
            self._limit = self._samples
        try:
            yield from self._final(past)
        except Spent:
            return

    def _final(self, past: list[Vector]) -> Plan:
        """The cheapest of the incumbent, the start and earlier incumbents, in a long race.

        A round's race is too short for what is rare, and the best of many moves is partly luck.
        """
        blocks = max(int(self.FINAL * self._samples / self._block / 4.2), 1)
        yield from self._renew(blocks)
        costs = self.incumbent.costs
        far = float(costs.std()) if blocks > 1 else np.inf
        last = len(past) - 1
        order = [0, last // 2, last // 4, 3 * last // 4, *range(last - 1, 0, -1)]
        for theta in (past[k] for k in dict.fromkeys(order)):
            rival = Candidate(theta)
            while len(rival.realised) < blocks:
                yield from self._run(rival)
                if float((rival.costs - costs[: len(rival.realised)]).mean()) > far:
                    break
            else:
                self.incumbent = min(self.incumbent, rival, key=lambda candidate: candidate.cost)

    def _learn(self, width: float, *, goes_on: bool) -> Step:
        """Learn from the incumbent and race what came of it, the latest θ first."""
        self._spend(self._phase)
        learned = yield Learn(self.incumbent.theta, self._phase, width, goes_on)
        assert isinstance(learned, Learned)
        self._measure(learned)
        yield from self._renew(self._blocks)
        better = False
        for theta in learned.candidates[::-1]:
            better |= yield from self._race(theta)
        return better

    def _measure(self, learned: Learned) -> None:
        """Take the coordinates of the searches from the latest data about the incumbent."""
        start = self._start.with_theta(self.incumbent.theta)
        self._scale = prior_deviation(
            start,
            learned.state_deviation,
            learned.errors.std(axis=0),
            self._action_deviation,
            abs(float(start["c_lambda"])),
            0.3,
        )
        self._remember(learned.errors)

    def _remember(self, errors: Matrix) -> None:
        """Keep prediction errors for the pools of the rounds to come."""
        self._errors = np.concatenate([self._errors, errors])[-self.MEMORY :]

    def _spend(self, samples: int) -> None:
        if self._spent + samples > self._limit:
            raise Spent
        self._spent += samples

    def _run(self, candidate: Candidate) -> Generator[Request, Learned | Block, None]:
        """One more block of a candidate's race, always on from its last one."""
        self._spend(self._block)
        block = yield Trial(candidate.theta, begins=not candidate.realised)
        assert isinstance(block, Block)
        expected = block.penalty
        if len(block.predictions) and len(self._pool):
            expected = self._penalty.expected(block.predictions, self._pool)
        candidate.realised.append(block.stage_cost + block.penalty)
        candidate.expected.append(block.stage_cost + expected)
        self._remember(block.errors)

    def _renew(self, blocks: int) -> Generator[Request, Learned | Block, None]:
        """Run the incumbent on from where the plant is, on new noise."""
        self._spend(self._block)
        yield Settle(self.incumbent.theta)
        # One pool for the whole round, or two θ would not be judged alike.
        self._pool = SortedErrors(self._errors)
        self.incumbent = Candidate(self.incumbent.theta)
        for _ in range(blocks):
            yield from self._run(self.incumbent)

    def _race(self, theta: Vector) -> Step:
        """Whether θ takes the incumbent's place: cheaper on the same noise by a standard error.

        It is given up as soon as it is dearer over those that it has run; to win it must run all,
        since a slow state shows late what a policy does to it.
        """
        admissible = self._admissible(theta)
        if admissible is None:
            return False
        candidate, costs = Candidate(admissible), self.incumbent.costs
        for count in range(1, len(costs) + 1):
            yield from self._run(candidate)
            difference = candidate.costs - costs[:count]
            if difference.mean() >= 0.0:
                return False
        if not _cheaper(difference):
            return False
        self.incumbent = candidate
        self.accepted += 1
        return True

    def _along(self, direction: Vector, reach: float) -> Generator[Request, Learned | Block, float]:
        """Line search both ways along a direction in scaled θ, (n_θ,), doubling steps that win.

        The first step is `reach`; returns that of the next time.
        """
        longest = self.CAP / max(float(np.abs(direction).max()), np.finfo(float).tiny)
        for sign in (1.0, -1.0):
            step, found = sign * min(reach, longest), False
            while abs(step) <= 4.0 * longest:
                moved = self.incumbent.theta + self._scale * (step * direction)
                if not (yield from self._race(moved)):
                    break
                found = True
                step *= 2.0
            if found:
                return 0.5 * abs(step)
        return 0.5 * reach

    def _tightening(self) -> Vector:
        """All state bounds moved inwards by half their prior's deviation, (n_θ,), scaled."""
        direction = np.zeros_like(self._scale)
        direction[self._blocks_of.slices["x_l"]] = 0.5
        direction[self._blocks_of.slices["x_u"]] = -0.5
        return direction

    def _directions(self, *, turned: bool) -> Generator[Request, Learned | Block, Matrix]:
        """Directions in scaled θ that change the policy by the exploration's σ, (n_θ, K)."""
        self._spend(self._block)
        block = yield Trial(self.incumbent.theta, True, sensitive=True)
        assert isinstance(block, Block) and block.metric is not None
        values, vectors = np.linalg.eigh(block.metric * np.outer(self._scale, self._scale))
        values, vectors = values[::-1][: self.DIRECTIONS], vectors[:, ::-1][:, : self.DIRECTIONS]
        directions = vectors / np.sqrt(np.maximum(values, 1e-12))
        if turned:
            draw = self._rng.standard_normal((directions.shape[1],) * 2)
            directions = directions @ np.linalg.qr(draw)[0]
        found: Matrix = directions
        return found

    def _admissible(self, theta: Vector) -> Vector | None:
        """θ with definite Hessians; None where bounds cross or a slack weight is not positive."""
        blocks: ThetaBlocks = self._blocks_of
        if not np.isfinite(theta).all():
            return None
        if certificate(blocks, theta).smallest < self._least:
            theta = clip_eigenvalues(blocks, theta, self._least)
        slices = blocks.slices
        if not (theta[slices["x_l"]] < theta[slices["x_u"]]).all():
            return None
        for name in ("w_sigma", "W_sigma"):
            if name in blocks and not (theta[slices[name]] > 0).all():
                return None
        return theta


def _cheaper(difference: Vector) -> bool:
    """Whether costs that differ so, block by block, are lower by a standard error."""
    blocks = len(difference)
    error = float(difference.std(ddof=1)) / blocks**0.5 if blocks > 1 else 0.0
    return float(difference.mean()) + error < 0.0
