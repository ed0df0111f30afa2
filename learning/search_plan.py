"""The search's plan: which θ to try next, and which of two θ is the better one.

A plan is a generator. It yields what the plant shall be run for (`Learn`, `Settle`, `Trial`) and is
sent what came of it (`Learned`, `Block`); it knows no plant, controller or rule.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.theta import Parameters
from cosim.scenario import Scenario
from learning.prediction_errors import KnownPenalty, SortedErrors
from learning.step import certificate, clip_eigenvalues, prior_deviation

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
ROUNDING = 1e-9
"""Share of a cost that the solver's last digits may make of moves that the policy does not feel."""


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
    """Run θ (n_θ,) greedily for a block, and remember the plant as it is then.

    With `episode` the plant is reset first, and this is the seed of its noise.
    """

    theta: Vector
    episode: int | None = None


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
    `state_deviation` and `error_deviation` (n,).
    """

    candidates: Matrix
    errors: Matrix
    state_deviation: Vector
    error_deviation: Vector


class Block(NamedTuple):
    """What a block gives: mean `stage_cost` and `penalty` a sample, `predictions` f(s, a) (K, n).

    `errors` (K, n) beside them are e = s₊ − f(s, a); `metric` is E[∇π Σ⁻¹ ∇πᵀ] (n_θ, n_θ) if it
    was asked for, with Σ the exploration's variance. `expected` is the penalty that a
    comparison expects of the predictions, None where it has not judged them yet.
    """

    stage_cost: float
    penalty: float
    predictions: Matrix
    errors: Matrix
    metric: Matrix | None = None
    expected: float | None = None


Request = Learn | Settle | Trial
Result = Learned | Block
Plan = Generator[Request, Result, None]
Step = Generator[Request, Result, bool]


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


class PairedComparison:
    """Decides which of two θ is cheaper, and counts the samples that this takes.

    A round's comparisons begin at one state of the plant, with the same noise to come. The
    `incumbent` is the best θ so far: it has won a comparison, or it is the start. Candidates are
    compared with `base`. That is the incumbent, but for a line search about a θ that has not won
    yet (`set_base`). `scenario` gives bounds and penalty, `samples` the budget, a comparison has up
    to `blocks` blocks of `block` samples.
    """

    KEPT = ("_errors", "pooled")
    MEMORY = 6000
    """Prediction errors over which a penalty is expected: the tail is what counts."""

    def __init__(
        self, scenario: Scenario, start: Parameters, samples: int, *, block: int, blocks: int
    ) -> None:
        self._penalty = KnownPenalty(scenario)
        self._parameters, self._start = start.blocks, start.theta
        self.block, self.blocks = block, blocks
        self.least = 0.5 * max(certificate(start.blocks, start.theta).smallest, 0.0)
        """Least eigenvalue that the Hessians of a candidate may have."""
        self.spent, self.limit = 0, samples
        self.expected = float("nan")
        """Penalty expected of the latest block."""
        self._errors: Matrix = np.zeros((0, scenario.state_lower.size))
        self.pooled = self._errors
        self.incumbent = Candidate(start.theta)
        self.base = self.incumbent
        self.accepted = 0
        """How often the incumbent's θ changed."""

    def set_base(self, theta: Vector) -> None:
        """Compare what follows with θ, which the incumbent stays apart from."""
        self.base = Candidate(theta)

    def settle(self, *, accept: bool) -> None:
        """Make the base the incumbent, or the incumbent the base again."""
        if accept:
            self._accept(self.base)
        self.base = self.incumbent

    def _accept(self, candidate: Candidate) -> None:
        if not np.array_equal(candidate.theta, self.incumbent.theta):
            self.accepted += 1
        self.base = self.incumbent = candidate

    @property
    def pooled(self) -> Matrix:
        """The prediction errors that the penalties of this round's blocks are expected with."""
        return self._pooled

    @pooled.setter
    def pooled(self, errors: Matrix) -> None:
        self._pooled, self._pool = errors, SortedErrors(errors)

    def spend(self, samples: int) -> None:
        """Count samples that are asked for; raises Spent where the limit leaves fewer."""
        if self.spent + samples > self.limit:
            raise Spent
        self.spent += samples

    def remember(self, errors: Matrix) -> None:
        """Keep prediction errors (K, n) for the pools of the rounds to come."""
        self._errors = np.concatenate([self._errors, errors])[-self.MEMORY :]

    def run(self, candidate: Candidate) -> Generator[Request, Result, None]:
        """One more block of a candidate, always on from its last one."""
        self.spend(self.block)
        block = yield Trial(candidate.theta, begins=not candidate.realised)
        assert isinstance(block, Block)
        self.expected = self._expected(block)
        candidate.realised.append(block.stage_cost + block.penalty)
        candidate.expected.append(block.stage_cost + self.expected)
        self.remember(block.errors)

    def _expected(self, block: Block) -> float:
        """Penalty expected of a block's predictions, its own where there is no pool yet."""
        if block.expected is not None:
            return block.expected
        if len(block.predictions) and len(self._pool):
            return self._penalty.expected(block.predictions, self._pool)
        return block.penalty

    def renew(self, blocks: int, episode: int | None = None) -> Generator[Request, Result, None]:
        """Run the incumbent on from where the plant is, or in a new episode, on new noise."""
        self.spend(self.block)
        yield Settle(self.incumbent.theta, episode)
        # One pool for the whole round, or two θ would not be judged alike.
        self.pooled = self._errors
        self.base = self.incumbent = Candidate(self.incumbent.theta)
        for _ in range(blocks):
            yield from self.run(self.incumbent)

    def compare(self, theta: Vector, *, patient: bool = False) -> Step:
        """Whether θ takes the base's place: cheaper on the same noise by a standard error.

        It is given up as soon as it is dearer over the blocks that it has run, if `patient` only
        where those to come could not make good for it; to win it must run all, since a slow state
        shows late what a policy does to it.
        """
        admissible = self.admissible(theta)
        if admissible is None:
            return False
        candidate, costs = Candidate(admissible), self.base.costs
        patience = _patience(costs) if patient else 0.0
        for count in range(1, len(costs) + 1):
            yield from self.run(candidate)
            difference = candidate.costs - costs[:count]
            if difference.sum() >= patience - ROUNDING * abs(costs[0]):
                return False
        if not cheaper(difference):
            return False
        if self.base is self.incumbent:
            self._accept(candidate)
        self.base = candidate
        return True

    def screen(self, theta: Vector, costs: Vector) -> Generator[Request, Result, Vector | None]:
        """The costs of θ over the first blocks of a comparison where it beats these, else None."""
        admissible = self.admissible(theta)
        if admissible is None:
            return None
        candidate = Candidate(admissible)
        for count in range(1, len(costs) + 1):
            yield from self.run(candidate)
            if (candidate.costs - costs[:count]).sum() >= -ROUNDING * abs(costs[0]):
                return None
        return candidate.costs

    def final(
        self, rivals: list[Vector], blocks: int, episode: int
    ) -> Generator[Request, Result, None]:
        """Leave the cheapest of the incumbent and its rivals (n_θ,), each run over `blocks` blocks.

        In a new episode, so that no θ has to mend what another one left. A rival is given up where
        its remaining blocks could no longer make good what it has lost. The start, if it lasts, is
        left only for a θ that is cheaper by a standard error: the best of many is partly luck.
        """
        yield from self.renew(blocks, episode)
        costs = self.incumbent.costs
        patience = _patience(costs) if blocks > 1 else np.inf
        finalists = [self.incumbent]
        for theta in rivals:
            rival = Candidate(theta)
            while len(rival.realised) < blocks:
                yield from self.run(rival)
                if (rival.costs - costs[: len(rival.realised)]).sum() >= patience:
                    break
            else:
                finalists.append(rival)
                self._accept(self._winner(finalists))

    def _winner(self, finalists: list[Candidate]) -> Candidate:
        """The cheapest; the start, where it is not dearer by a standard error."""
        best = min(finalists, key=lambda candidate: candidate.cost)
        for candidate in finalists:
            start = np.array_equal(candidate.theta, self._start)
            if start and not cheaper(best.costs - candidate.costs):
                return candidate
        return best

    def admissible(self, theta: Vector) -> Vector | None:
        """θ with definite Hessians; None where bounds cross or a slack weight is not positive."""
        blocks = self._parameters
        if not np.isfinite(theta).all():
            return None
        if certificate(blocks, theta).smallest < self.least:
            theta = clip_eigenvalues(blocks, theta, self.least)
        slices = blocks.slices
        if not (theta[slices["x_l"]] < theta[slices["x_u"]]).all():
            return None
        for name in ("w_sigma", "W_sigma"):
            if name in blocks and not (theta[slices[name]] > 0).all():
                return None
        return theta


def cheaper(difference: Vector) -> bool:
    """Whether costs that differ so, block by block, are lower by a standard error."""
    blocks = len(difference)
    error = float(difference.std(ddof=1)) / blocks**0.5 if blocks > 1 else 0.0
    return float(difference.mean()) + error < 0.0


def _patience(costs: Vector) -> float:
    """Loss of a candidate, summed over its blocks, that the blocks' own spread still explains."""
    return float(costs.std()) * len(costs)


class LineSearch:
    """Moves the base of a paired comparison along lines in θ, in steps that win.

    `scale` (n_θ,) are the coordinates, the prior's standard deviations; `start` gives θ's blocks,
    `inputs` is m.
    """

    DIRECTIONS = 4
    CAP = 1.5
    """Longest first step, in the prior's standard deviations."""

    def __init__(
        self, comparison: PairedComparison, start: Parameters, inputs: int, rng: np.random.Generator
    ) -> None:
        self._comparison, self._start, self._inputs, self._rng = comparison, start, inputs, rng
        self.scale: Vector = np.ones(start.theta.size)

    def along(self, direction: Vector, reach: float) -> Generator[Request, Result, float]:
        """Line search both ways along a direction in scaled θ, (n_θ,), from a first step `reach`.

        Steps that win over a quarter of the blocks are doubled, the longest that did is compared
        over all. Returns the first step of the next time.
        """
        comparison = self._comparison
        longest = self.CAP / max(float(np.abs(direction).max()), np.finfo(float).tiny)
        origin, quarter = comparison.base.theta, max(len(comparison.base.realised) // 4, 1)
        for sign in (1.0, -1.0):
            step, best, costs = sign * min(reach, longest), 0.0, comparison.base.costs[:quarter]
            while abs(step) <= 4.0 * longest:
                moved = yield from comparison.screen(
                    origin + self.scale * (step * direction), costs
                )
                if moved is None:
                    break
                best, costs = step, moved
                step *= 2.0
            while abs(best) >= min(reach, longest):
                if (yield from comparison.compare(origin + self.scale * (best * direction))):
                    return abs(best)
                best *= 0.5
        return 0.5 * reach

    def tightening(self, state: int | None = None) -> Vector:
        """All state bounds, or one state's, moved inwards by half their deviation, (n_θ,)."""
        direction = np.zeros_like(self.scale)
        for name, inwards in (("x_l", 0.5), ("x_u", -0.5)):
            where = np.arange(direction.size)[self._start.blocks.slices[name]]
            direction[where if state is None else where[state]] = inwards
        return direction

    def directions(self, *, turned: bool) -> Generator[Request, Result, Matrix]:
        """Directions in scaled θ that change the policy by the exploration's σ, (n_θ, K)."""
        comparison = self._comparison
        comparison.spend(comparison.block)
        block = yield Trial(comparison.base.theta, True, sensitive=True)
        assert isinstance(block, Block) and block.metric is not None
        values, vectors = np.linalg.eigh(block.metric * np.outer(self.scale, self.scale))
        values, vectors = values[::-1][: self.DIRECTIONS], vectors[:, ::-1][:, : self.DIRECTIONS]
        directions = vectors / np.sqrt(np.maximum(values, 1e-12))
        if turned:
            draw = self._rng.standard_normal((directions.shape[1],) * 2)
            directions = directions @ np.linalg.qr(draw)[0]
        found: Matrix = directions
        return found

    def rescale(self, decades: float) -> Generator[Request, Result, float]:
        """Search over the inputs' weights in the stage cost; returns the next time's step.

        With other weights the policy has another gain, and so another best back-off: each is given
        its own, apart from the incumbent, before it is compared with it. Where that did not pay, a
        shorter step the other way comes next.
        """
        comparison = self._comparison
        found = False
        while True:
            kept, least = comparison.incumbent, comparison.least
            theta = self._weighted(10.0**decades)
            comparison.least = min(least, 0.5 * certificate(self._start.blocks, theta).smallest)
            comparison.set_base(theta)
            pays = False
            try:
                for _ in range(len(kept.costs)):
                    yield from comparison.run(comparison.base)
                yield from self.along(self.tightening(), 0.5)
                pays = cheaper(comparison.base.costs - kept.costs)
            finally:
                comparison.settle(accept=pays)
            if not pays:
                comparison.least = least
                return decades if found else -0.7 * decades
            found = True

    def _weighted(self, factor: float) -> Vector:
        """The incumbent with its input weights multiplied, their minimum where it was, (n_θ,)."""
        comparison = self._comparison
        parameters = self._start.with_theta(comparison.base.theta)
        hessian, gradient = parameters["B_l"], parameters["b_l"]
        scale = np.ones(len(gradient))
        scale[-self._inputs :] = factor**0.5
        moved = hessian * np.outer(scale, scale)
        minimiser = np.linalg.solve(hessian, gradient)
        return parameters.replace({"B_l": moved, "b_l": moved @ minimiser}).theta


class SearchPlan:
    """Phases of learning, each followed by line searches on common noise.

    One round: the rule learns from the incumbent; the incumbent of the round before and the θ that
    the rule passed through are compared with it; then come line searches along the back-off of all
    state bounds and over the order of magnitude of the inputs' weights. A candidate takes the
    incumbent's place only if it is cheaper on the same noise. If no learnt θ did, comparisons
    become twice as long, the next phase begins anew with half the width, a trust region about the
    incumbent, and before it come line searches along the back-off of each state, along the
    directions in θ that move the policy most (leading eigenvectors of E[∇π ∇πᵀ] in the prior's
    coordinates, turned at random so that no ridge stays in the way), and along the round's whole
    way. All comparisons of a round begin at the plant as it was when the round's learning ended,
    with the same noise to come; so slow states are where operation takes them, and each round has
    new noise. The last samples go to a longer comparison, in a new episode, between the incumbent,
    the start and earlier incumbents. Without a rule θ rests in the phases of learning, which then
    only measure what the coordinates of the line searches need (`prior_deviation`).

    `scenario` gives bounds and penalty, `action_deviation` (m,) the exploration's σ, `samples` the
    budget, `block` samples make a block, at most `blocks` of them a comparison, `phase` a phase.
    """

    FINAL = 0.25
    """Share of the samples for the last comparison."""
    FINALISTS = 3.2
    """Runs over all blocks of the last comparison that its samples suffice for."""

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
        # A short run has short phases and comparisons.
        self._phase = min(phase, max(samples // 8, 1))
        block = min(block, max(samples // 100, 1))
        self._rng = np.random.default_rng(seed)
        self.comparison = PairedComparison(scenario, start, samples, block=block, blocks=blocks)
        self._longer = 2 * blocks
        self._lines = LineSearch(self.comparison, start, action_deviation.size, self._rng)
        self._past = [start.theta]

    def plan(self) -> Plan:
        """The whole run."""
        comparison = self.comparison
        comparison.limit = int((1.0 - self.FINAL) * self._samples)
        try:
            yield from self._rounds()
        except Spent:
            comparison.limit = self._samples
        blocks = max(int(self.FINAL * self._samples / comparison.block / self.FINALISTS), 1)
        last = len(self._past) - 1
        order = dict.fromkeys([0, last, last // 2, *range(last - 1, 0, -1)])
        # The best of many moves is partly luck, and a round too short for what is rare.
        rivals = [self._past[k] for k in order]
        rivals = [
            theta for theta in rivals if not np.array_equal(theta, self.comparison.incumbent.theta)
        ]
        try:
            yield from comparison.final(rivals, blocks, int(self._rng.integers(2**31)))
        except Spent:
            return

    def _rounds(self) -> Plan:
        """Rounds without end; the samples are what ends them."""
        comparison, lines = self.comparison, self._lines
        back_off, weights, reach = 1.0, -1.0, np.full(lines.DIRECTIONS, 0.5)
        bounds = [0.5] * self._states
        width, number, better, rescaled, failed, rest = 1.0, 0, True, False, 0, 0
        while True:
            before = comparison.incumbent.theta
            # What is left at the end may be too little to learn from, not to search with.
            enough = (
                comparison.limit - comparison.spent
                >= self._phase + comparison.blocks * comparison.block
            )
            if enough and rest == 0:
                better = yield from self._learn(width, goes_on=better and not rescaled)
                failed = 0 if better else failed + 1
                width, rest = (width, 0) if better else (0.5 * width, failed)
            else:
                better = False
                yield from self._renew()
            if not better:
                comparison.blocks = self._longer
            rest = max(rest - 1, 0)
            back_off = yield from lines.along(lines.tightening(), min(back_off, 1.0))
            unscaled = comparison.incumbent
            weights = yield from lines.rescale(weights)
            rescaled = comparison.incumbent is not unscaled
            # While learning pays, searching would only cost samples.
            if not better:
                for state in range(self._states):
                    tightening = lines.tightening(state)
                    bounds[state] = yield from lines.along(tightening, min(bounds[state], 1.0))
                directions = yield from lines.directions(turned=number > 0)
                for j, direction in enumerate(directions.T):
                    reach[j] = yield from lines.along(direction, float(np.clip(reach[j], 0.05, 1)))
                way = (comparison.incumbent.theta - before) / lines.scale
                if way.any():
                    yield from lines.along(way, 0.5)
                number += 1
            if not np.array_equal(before, self._past[-1]):
                self._past.append(before)

    def _renew(self) -> Plan:
        """Run the incumbent on new noise, and compare the one before it with it once more.

        That may have lost on a round's noise alone, or before a slow state showed what the new one
        does to it.
        """
        comparison, past = self.comparison, self._past[-1]
        yield from comparison.renew(comparison.blocks)
        if not np.array_equal(past, comparison.incumbent.theta):
            yield from comparison.compare(past, patient=True)

    def _learn(self, width: float, *, goes_on: bool) -> Step:
        """Learn from the incumbent and compare what came of it, the latest θ first."""
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
        self._lines.scale = prior_deviation(
            start,
            learned.state_deviation,
            learned.error_deviation,
            self._action_deviation,
            abs(float(start["c_lambda"])),
            0.3,
        )
        self.comparison.remember(learned.errors)
