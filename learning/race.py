"""Races: which of two θ is the better one, on the same noise from the same state of the plant."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from cosim.scenario import Scenario
from learning.definiteness import certificate, clip_eigenvalues
from learning.episodes import Block, Request, Result, Settle, Step, Trial
from learning.prediction_errors import KnownPenalty, SortedErrors

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
ROUNDING = 1e-9
"""Share of a cost that the solver's last digits may make of moves that the policy does not feel."""


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


class Races:
    """The incumbent, those that race against it, and the budget of samples that races spend.

    A round's races begin at one state of the plant, with the same noise to come. `scenario` gives
    bounds and penalty, `samples` the budget, a race has up to `blocks` blocks of `block` samples.
    """

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
        self._pool = SortedErrors(self._errors)
        self.incumbent = Candidate(start.theta)
        self.accepted = 0

    def spend(self, samples: int) -> None:
        """Count samples that are asked for; raises Spent where the limit leaves fewer."""
        if self.spent + samples > self.limit:
            raise Spent
        self.spent += samples

    def remember(self, errors: Matrix) -> None:
        """Keep prediction errors (K, n) for the pools of the rounds to come."""
        self._errors = np.concatenate([self._errors, errors])[-self.MEMORY :]

    def run(self, candidate: Candidate) -> Generator[Request, Result, None]:
        """One more block of a candidate's race, always on from its last one."""
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
        self._pool = SortedErrors(self._errors)
        self.incumbent = Candidate(self.incumbent.theta)
        for _ in range(blocks):
            yield from self.run(self.incumbent)

    def race(self, theta: Vector, *, patient: bool = False) -> Step:
        """Whether θ takes the incumbent's place: cheaper on the same noise by a standard error.

        It is given up as soon as it is dearer over the blocks that it has run, if `patient` only
        where those to come could not make good for it; to win it must run all, since a slow state
        shows late what a policy does to it.
        """
        admissible = self.admissible(theta)
        if admissible is None:
            return False
        candidate, costs = Candidate(admissible), self.incumbent.costs
        patience = _patience(costs) if patient else 0.0
        for count in range(1, len(costs) + 1):
            yield from self.run(candidate)
            difference = candidate.costs - costs[:count]
            if difference.sum() >= patience - ROUNDING * abs(costs[0]):
                return False
        if not cheaper(difference):
            return False
        self.incumbent = candidate
        self.accepted += 1
        return True

    def sprint(self, theta: Vector, costs: Vector) -> Generator[Request, Result, Vector | None]:
        """The costs of θ over the first blocks of a race where it beats these, else None."""
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
                self.incumbent = self._winner(finalists)

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
    """Loss of a race, summed over its blocks, that the blocks' own spread still explains."""
    return float(costs.std()) * len(costs)
