"""Values that change over a run: linearly or geometrically from start to end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Linear:
    """A value that goes linearly from `start` to `end` over `samples`, then stays."""

    start: Vector
    end: Vector
    samples: int

    def __call__(self, sample: int) -> Vector:
        """Value at a sample, in the shape of `start`."""
        if self.end is self.start:
            return self.start
        share = min(sample / self.samples, 1.0) if self.samples > 0 else 1.0
        return self.start + share * (self.end - self.start)

    def at(self, samples: NDArray[np.int64]) -> NDArray[np.float64]:
        """Values at samples, (K,), in the shape (K, …) with that of `start` behind."""
        done = samples / self.samples if self.samples > 0 else np.ones(len(samples))
        shares = np.minimum(done, 1.0).reshape(-1, *(1,) * self.start.ndim)
        values: NDArray[np.float64] = self.start + shares * (self.end - self.start)
        return values


@dataclass(frozen=True)
class Geometric:
    """A positive number that goes from `start` to `end` by equal ratios over `samples`."""

    start: float
    end: float
    samples: int

    def __call__(self, sample: int) -> float:
        """Value at a sample."""
        value: float = self.start * (self.end / self.start) ** min(sample / self.samples, 1.0)
        return value


def linear(start: ArrayLike, end: ArrayLike | None, samples: int) -> Linear:
    """Linear schedule; without `end` it is constant."""
    first = np.asarray(start, dtype=np.float64)
    return Linear(first, first if end is None else np.asarray(end, dtype=np.float64), samples)
