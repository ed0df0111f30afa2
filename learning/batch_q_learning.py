"""Batch Q-learning: an iterated Kalman filter over θ, each batch replayed at the present θ."""

from __future__ import annotations

from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cho_factor, cho_solve

from controllers.errors import QpError
from controllers.rti import LinearisationPoint, RtiNmpc, RtiSolution
from cosim.protocols import Matrix, Vector
from learning.algorithm import Transition, Update
from learning.configuration import Count
from learning.errors import DivergenceError
from learning.q_learning import OUTLIER, ValueConfiguration, ValueRule
from learning.step import Fit

POINT = tuple(f"point_{name}" for name in LinearisationPoint._fields)
NEXT_POINT = tuple(f"next_{name}" for name in POINT)
COLUMNS = (
    *("number", "s", "a", "explored", "cost", "next_s", "error", "correction"),
    *POINT, *NEXT_POINT,
)  # fmt: skip


class BatchQLearningConfiguration(ValueConfiguration):
    """Hyperparameters of batch Q-learning."""

    batch_size: Count = Field(500, description="samples between two updates")
    first_batch: Count | None = Field(
        None,
        description="samples of the first batch, which gives noise and widths; as the others if "
        "not given",
    )
    relinearisations: Count = Field(2, description="replays and steps of θ per batch")


class BatchQLearning(ValueRule):
    """Q-learning in batches: online Q-learning's fit and prior, replayed at the present θ.

    Each batch of `batch_size` transitions is a measurement of d = (θ−θ₀)/σ with the information
    GᵀG/r, G the rows ∇Qᵀσ. The prior of a batch is the posterior of the one before:

        min_d Σ (δ − ∇Qᵀ(d − d_now))²/r + (d − m)ᵀΛ(d − m),  then Λ ← Λ + GᵀG/r, m ← d

    This is done `relinearisations` times a batch, each at the θ of the last step: the iterated
    filter (Gauss–Newton on the posterior). The first batch also gives noise, widths and c_f.
    """

    Configuration = BatchQLearningConfiguration
    KEPT = (*ValueRule.KEPT, "_buffer", "_anchor", "_information", "_mean", "_variance")
    needs_points = True
    configuration: BatchQLearningConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._variance = 0.0
        longest = max(self._length, self.configuration.batch_size)
        self._buffer = ReplayBuffer(self.controller, longest)
        self._anchor = self.controller.theta.copy()
        self._information: Matrix = np.eye(self._anchor.size)
        self._mean: Vector = np.zeros(self._anchor.size)

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; the last of a batch moves θ."""
        prediction = self._model(transition.s, transition.a)
        error = transition.next_s - prediction
        self._errors.add(error)
        expected = self._errors.expected_penalty(prediction)
        self._buffer.add(transition, error, expected - transition.next_penalty)
        if len(self._buffer.rows) < self._length:
            return None
        update = self._update()
        self._buffer.clear()
        return update

    @property
    def _length(self) -> int:
        """Samples of the open batch."""
        settings = self.configuration
        first = settings.first_batch if self._variance == 0.0 else None
        return settings.batch_size if first is None else first

    def _update(self) -> Update:
        settings, update, failures = self.configuration, None, 0
        information = self._information
        for _ in range(settings.relinearisations):
            kept, action_value, next_value, gradient = self._buffer.replay()
            failures += len(kept) - len(action_value)
            if not len(action_value):
                break
            cost, correction = (self._buffer.rows[name][kept] for name in ("cost", "correction"))
            target = self._average_cost.target(cost, next_value)
            # The next penalty is replaced by its expectation.
            td_error = target - action_value + self._average_cost.discount * correction
            if not np.isfinite(td_error).all():
                raise DivergenceError("TD errors are not finite")
            if self._variance == 0.0:
                self._begin_filter(td_error)
                information = self._information
            gradient = gradient * self._step.scale
            limit = settings.innovation_clip * self._variance**0.5
            innovation = np.clip(td_error, -limit, limit)
            told = gradient.T @ gradient / self._variance
            information = self._information + told
            slope = gradient.T @ innovation / self._variance
            slope -= self._information @ (self._present - self._mean)
            fit = Fit(slope, cho_solve(cho_factor(information), slope), information.copy)
            longest = settings.largest_step or np.inf
            share = 1.0 / max(float(np.abs(fit.minimiser).max()) / longest, 1.0)
            information = self._information + share * told
            fit = self._average_cost.take(fit.shrunk(share))
            update = self._step.take(fit, float(np.sqrt(np.mean(td_error**2))))
        if update is None:
            raise DivergenceError("no transition of a batch can be replayed")
        self._information, self._mean = information, self._present
        squares = np.minimum(td_error**2, OUTLIER * self._variance)
        share = min(len(td_error) / settings.variance_memory, 1.0)
        self._variance += share * (float(squares.mean()) - self._variance)
        return update._replace(failures=failures)

    @property
    def _present(self) -> Vector:
        """d of the controller's θ."""
        present: Vector = (self.controller.theta - self._anchor) / self._step.scale
        return present

    def _begin_filter(self, td_error: Vector) -> None:
        """Take the noise, the widths and c_f from the samples of the first batch."""
        rows = self._buffer.rows
        self._variance = max(float(np.mean(td_error**2)), np.finfo(np.float64).tiny)
        start = self._begin(rows["s"], rows["error"], self._variance**0.5)
        self.controller.theta = start.theta
        self._anchor = start.theta.copy()


class ReplayBuffer:
    """Up to `capacity` transitions with their linearisation points, a record each (`COLUMNS`).

    V and Q of a real-time iteration depend on the linearisation point, so a replay uses that of the
    loop, with the model and cost of the controller's θ. Values solved at the same θ are kept where
    the controller is `memoryless`; NaN stands for unknown ones.
    """

    KEPT = ("_count", "_records", "_theta", "_action_value", "_next_value", "_gradient")

    def __init__(self, controller: RtiNmpc, capacity: int) -> None:
        self._controller, self._capacity, self._count = controller, capacity, 0
        self._records: NDArray[Any] = np.zeros(0)
        self._theta = controller.theta
        self._action_value, self._next_value = np.full((2, capacity), np.nan)
        self._gradient = np.zeros((capacity, self._theta.size))

    @property
    def rows(self) -> NDArray[Any]:
        """The transitions kept, (K,), in time's order."""
        return self._records[: self._count]

    def clear(self) -> None:
        """Keep no transition."""
        self._count = 0
        self._action_value[:] = self._next_value[:] = np.nan

    def add(self, transition: Transition, error: Vector, correction: float) -> None:
        """Keep a transition, solved at the controller's θ.

        `error` (n,) is its prediction's, `correction` the expectation of its next penalty less it.
        """
        point, next_point = transition.point, transition.next_point
        assert point is not None and next_point is not None
        values = (
            *(transition.number, transition.s, transition.a, transition.explored),
            *(transition.cost, transition.next_s, error, correction, *point, *next_point),
        )
        if not self._records.size:
            kept = zip(COLUMNS, map(np.asarray, values), strict=True)
            kinds = [(name, value.dtype, value.shape) for name, value in kept]
            self._records = np.empty(self._capacity, kinds)
        row, self._count = self._count, self._count + 1
        self._records[row] = values
        if not self._controller.memoryless:
            return
        self._forget_other_theta()
        self._next_value[row] = transition.next_policy.value
        if not transition.explored:
            self._action_value[row] = transition.policy.value
            self._gradient[row] = transition.policy.value_gradient

    def replay(self) -> tuple[NDArray[np.bool_], Vector, Vector, Matrix]:
        """Q(s, a), V(s₊) and ∇Q (unscaled) of every transition at the controller's θ.

        Before them which of the transitions they are of: not of those whose QP failed.
        """
        self._forget_other_theta()
        now, after = self._action_value[: self._count], self._next_value[: self._count]
        self._solve(np.flatnonzero(np.isnan(now + after)))
        kept = np.isfinite(now) & np.isfinite(after)
        return kept, now[kept], after[kept], self._gradient[: self._count][kept]

    def _forget_other_theta(self) -> None:
        theta = self._controller.theta
        same = theta is self._theta or np.array_equal(theta, self._theta)
        if not (same and self._controller.memoryless):
            self._action_value[:] = self._next_value[:] = np.nan
        self._theta = theta

    def _solve(self, rows: NDArray[np.int64]) -> None:
        """Solve for unknown values of these rows, in time's order; a failing QP leaves NaN."""
        # V(s₊) of one transition is Q of the next: a successor shares the linearisation, and where
        # it was greedy the solution too.
        controller, columns = self._controller, self._records
        at: int | None = None
        value: RtiSolution | None = None
        # Plain numbers: reading them one by one out of arrays costs as much as a gradient.
        numbers, explored = (columns[name][rows].tolist() for name in ("number", "explored"))
        points, next_points = ([columns[name] for name in names] for names in (POINT, NEXT_POINT))
        for number, exploring, row in zip(numbers, explored, rows.tolist(), strict=True):
            try:
                if isnan(self._action_value[row]):
                    if at != number:
                        controller.prepare_at(LinearisationPoint(*(p[row] for p in points)))
                        value = None
                    if exploring:
                        value = controller.feedback(columns["s"][row], columns["a"][row])
                    elif value is None:
                        value = controller.feedback(columns["s"][row])
                    self._action_value[row] = value.value
                    self._gradient[row] = value.value_gradient
                if isnan(self._next_value[row]):
                    controller.prepare_at(LinearisationPoint(*(p[row] for p in next_points)))
                    at, value = number + 1, controller.feedback(columns["next_s"][row])
                    self._next_value[row] = value.value
            except QpError:
                at = None
