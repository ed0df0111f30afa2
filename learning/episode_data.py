"""What the samples of an open episode give: a phase of learning, or a block of a race."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.episodes import Block, Learn, Learned, Request, Result, Trial
from learning.prediction_errors import OneStepModel
from learning.protocols import Transition

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
CANDIDATES = 3
"""θ of a phase of learning that are raced, at equal distances in samples."""
SENSITIVITIES = 100
"""Policy Jacobians, at most, that the metric of a block is the mean of."""
LATEST = 1000
"""Samples of a phase of learning whose prediction errors are kept."""
ROW = ("s", "a", "after")


class EpisodeData:
    """The `done` of `length` samples of a request's episode.

    `deviation` (m,) is the exploration's σ; `size` is n_θ and `states` n.
    """

    def __init__(
        self, request: Request | None, length: int, deviation: Vector, size: int, states: int
    ) -> None:
        self._learns = isinstance(request, Learn)
        self._sensitive = isinstance(request, Trial) and request.sensitive
        self._deviation, self._states = deviation, states
        self.done, self.length = 0, length
        self._stage_cost, self._penalty = 0.0, 0.0
        self._rows: list[tuple[Vector, ...]] = []
        self._candidates: list[Vector] = []
        self._metric: Matrix = np.zeros((size, size))
        self._jacobians = 0

    @property
    def over(self) -> bool:
        """Whether all samples are done."""
        return self.done >= self.length

    def end_with_this(self) -> None:
        """Let the sample that is coming be the last one."""
        self.length = self.done + 1

    def take(self, transition: Transition, theta: Vector | None = None) -> None:
        """Take a sample, and θ (n_θ,) after it, where that may be a candidate."""
        self._rows.append((transition.s, transition.a, transition.next_s))
        if not self._learns:
            self._judge(transition)
        elif theta is not None and (self.done + 1) % max(self.length // CANDIDATES, 1) == 0:
            self._candidates.append(theta.copy())
        self.done += 1

    def fail(self, cost: float) -> None:
        """Take a sample at which the controller failed, with its share of J."""
        self._stage_cost += cost
        self.done += 1

    def _judge(self, transition: Transition) -> None:
        self._stage_cost += transition.stage_cost
        self._penalty += transition.next_penalty
        if self._sensitive and self.done % max(self.length // SENSITIVITIES, 1) == 0:
            jacobian = transition.policy.policy_jacobian / self._deviation[:, None]
            if np.isfinite(jacobian).all():
                self._metric += jacobian.T @ jacobian
                self._jacobians += 1

    def result(self, model: OneStepModel) -> Result:
        """What came of the episode, its predictions by the controller's own `model`."""
        n, rows = self._states, self._rows[-LATEST:] if self._learns else self._rows
        predictions = np.array([model(s, a) for s, a, _ in rows]).reshape(-1, n)
        errors = np.array([after for _, _, after in rows]).reshape(-1, n) - predictions
        if not self._learns:
            metric = self._metric / max(self._jacobians, 1) if self._sensitive else None
            count = self.length
            return Block(
                self._stage_cost / count, self._penalty / count, predictions, errors, metric
            )
        states = np.array([s for s, _, _ in rows]).reshape(-1, n)
        candidates = np.array(self._candidates).reshape(-1, len(self._metric))
        if not len(errors):
            errors, states = np.zeros((1, n)), np.zeros((1, n))
        return Learned(candidates, errors, states.std(axis=0), errors.std(axis=0))

    def state(self) -> dict[str, NDArray[Any]]:
        """All that was taken, as arrays."""
        counts = [self.done, self.length, self._stage_cost, self._penalty, self._jacobians]
        state: dict[str, NDArray[Any]] = {
            "counts": np.array(counts),
            "metric": self._metric.copy(),
            "candidates": np.array(self._candidates).reshape(-1, len(self._metric)),
        }
        for name, part in zip(ROW, zip(*self._rows, strict=True), strict=False):
            state[f"rows {name}"] = np.array(part)
        return state

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        done, length, self._stage_cost, self._penalty, jacobians = map(float, state["counts"])
        self.done, self.length, self._jacobians = int(done), int(length), int(jacobians)
        self._metric = state["metric"].copy()
        self._candidates = [row.copy() for row in state["candidates"]]
        if "rows s" in state:
            self._rows = list(zip(*(state[f"rows {name}"] for name in ROW), strict=True))
