"""What a search asks the plant to be run for, and what it gets to know of it."""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    was asked for, with Σ the exploration's variance. `expected` is the penalty that a race expects
    of the predictions, None where it has not judged them yet.
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
