"""Line searches in θ: along a direction, the back-off of the bounds, the inputs' weights."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from learning.definiteness import certificate
from learning.episodes import Block, Request, Result, Trial
from learning.race import Candidate, Races, Spent, cheaper

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class LineSearch:
    """Moves the incumbent of `races` along lines in θ, in steps that win.

    `scale` (n_θ,) are the coordinates, the prior's standard deviations; `start` gives θ's blocks,
    `inputs` is m.
    """

    DIRECTIONS = 4
    CAP = 1.5
    """Longest first step, in the prior's standard deviations."""

    def __init__(
        self, races: Races, start: Parameters, inputs: int, rng: np.random.Generator
    ) -> None:
        self._races, self._start, self._inputs, self._rng = races, start, inputs, rng
        self.scale: Vector = np.ones(start.theta.size)

    def along(self, direction: Vector, reach: float) -> Generator[Request, Result, float]:
        """Line search both ways along a direction in scaled θ, (n_θ,), from a first step `reach`.

        Steps that win over a quarter of a race are doubled, the longest that did is raced. Returns
        the first step of the next time.
        """
        races = self._races
        longest = self.CAP / max(float(np.abs(direction).max()), np.finfo(float).tiny)
        origin, quarter = races.incumbent.theta, max(len(races.incumbent.realised) // 4, 1)
        for sign in (1.0, -1.0):
            step, best, costs = sign * min(reach, longest), 0.0, races.incumbent.costs[:quarter]
            while abs(step) <= 4.0 * longest:
                moved = yield from races.sprint(origin + self.scale * (step * direction), costs)
                if moved is None:
                    break
                best, costs = step, moved
                step *= 2.0
            while abs(best) >= min(reach, longest):
                if (yield from races.race(origin + self.scale * (best * direction))):
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
        races = self._races
        races.spend(races.block)
        block = yield Trial(races.incumbent.theta, True, sensitive=True)
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
        its own before it meets the incumbent. Where that did not pay, a shorter step the other
        way comes next.
        """
        races = self._races
        found = False
        while True:
            kept, least = races.incumbent, races.least
            theta = self._weighted(10.0**decades)
            races.least = min(least, 0.5 * certificate(self._start.blocks, theta).smallest)
            races.incumbent = Candidate(theta)
            try:
                for _ in range(len(kept.costs)):
                    yield from races.run(races.incumbent)
                yield from self.along(self.tightening(), 0.5)
            except Spent:
                races.incumbent = kept
                raise
            if not cheaper(races.incumbent.costs - kept.costs):
                races.incumbent, races.least = kept, least
                return decades if found else -0.7 * decades
            found = True
            races.accepted += 1

    def _weighted(self, factor: float) -> Vector:
        """The incumbent with its input weights multiplied, their minimum where it was, (n_θ,)."""
        races = self._races
        parameters = self._start.with_theta(races.incumbent.theta)
        hessian, gradient = parameters["B_l"], parameters["b_l"]
        scale = np.ones(len(gradient))
        scale[-self._inputs :] = factor**0.5
        moved = hessian * np.outer(scale, scale)
        minimiser = np.linalg.solve(hessian, gradient)
        return parameters.replace({"B_l": moved, "b_l": moved @ minimiser}).theta
