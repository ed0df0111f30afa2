"""Batch Q-learning: an iterated Kalman filter over θ, each batch replayed at the present θ."""

from __future__ import annotations

from math import isnan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cho_factor, cho_solve

from controllers.errors import QpError
from controllers.rti import LinearisationPoint, RtiNmpc, RtiSolution
from cosim.core.protocols import Matrix, Vector
from learning.algorithm import Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Count
from learning.errors import DivergenceError
from learning.q_learning import ValueConfiguration, ValueRule, redundancy_of
from learning.step import Fit


class BatchQLearningConfiguration(ValueConfiguration):
    """Hyperparameters of batch Q-learning."""

    batch_size: Count = Field(500, description="samples between two updates")
    first_batch: Count | None = Field(
        None,
        description="samples of the first batch, which gives noise and widths; as the others if "
        "not given",
    )
    intercept: bool = Field(
        True,
        description="at a discount of 1 δ and ∇Q lose their means over the batch, for the level of "
        "Q means nothing; false: the mean cost is fitted with θ",
    )
    relinearisations: Count = Field(2, description="replays and steps of θ per batch")


class BatchQLearning(ValueRule):
    """Q-learning in batches: online Q-learning's fit and prior, replayed at the present θ.

    Each batch of `batch_size` transitions is a measurement of d = (θ−θ₀)/σ with the information
    GᵀG/r, G the rows ∇Qᵀσ. The prior of a batch is the posterior of the one before:

        min_d Σ (δ − ∇Qᵀ(d − d_now))²/r + (d − m)ᵀΛ(d − m),  then Λ ← Λ + GᵀG/r, m ← d

    At γ = 1 both δ and ∇Q are those less their means over the batch: a fit with an intercept.
    This is done `relinearisations` times a batch, each at the θ of the last step: the iterated
    filter (Gauss–Newton on the posterior). The first batch also gives noise, widths and c_f.
    r is the noise of a sample times the samples that say as much as an independent one
    (`redundancy_of`).
    """

    learns_from_estimates = True

    Configuration = BatchQLearningConfiguration
    needs_points = True
    configuration: BatchQLearningConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._variance = 0.0  # r; zero until the first batch is full
        self._redundancy = 1.0  # samples that say as much as an independent one
        longest = max(self._length, self.configuration.batch_size)
        self._buffer = ReplayBuffer(self.controller, longest)
        self._start = self.controller.theta.copy()  # θ₀
        self._information: Matrix = np.eye(self._start.size)  # Λ
        self._mean: Vector = np.zeros(self._start.size)  # m

    def observe(self, transition: Transition) -> Update | None:
        """Learn from one sample; the last of a batch moves θ."""
        prediction = self._model(transition.s, transition.a)
        error = transition.next_s - prediction
        self._errors.add(error, transition.next_variances)
        expected = self._errors.expected_penalty(prediction)
        self._buffer.add(transition, error, expected - transition.next_penalty)
        if self._buffer.count < self._length:
            return None
        update = self._update()
        self._buffer.clear()
        return update

    @property
    def _length(self) -> int:
        """Samples of the open batch."""
        settings = self.configuration
        if self._variance == 0.0 and settings.first_batch is not None:
            return settings.first_batch
        return settings.batch_size

    def _update(self) -> Update:
        """Replay the batch and move θ, `relinearisations` times."""
        settings = self.configuration
        # Each pass replays at the θ of the last step: Gauss–Newton on the posterior.
        update: Update | None = None
        failures = 0
        information = self._information
        for _ in range(settings.relinearisations):
            replayed = self._buffer.replay()
            solved = replayed.solved
            failures += len(solved) - len(replayed.q)
            if not len(replayed.q):
                break
            cost = self._buffer.column("cost")[solved]
            correction = self._buffer.column("correction")[solved]
            gradient = replayed.gradient
            target = self._average_cost.target(cost, replayed.next_value)
            # The next penalty is replaced by its expectation.
            td_error = target - replayed.q + self._average_cost.discount * correction
            if not np.isfinite(td_error).all():
                raise DivergenceError("TD errors are not finite")
            # Once, from the first batch: noise, widths and c_f.
            if self._variance == 0.0:
                td_error = self._begin_filter(td_error)
            if settings.intercept:
                td_error, gradient = self._average_cost.centre(td_error, gradient)
            scaled_gradient = gradient * self._step.scale
            fit, information = self._posterior(td_error, scaled_gradient)
            fit = self._average_cost.absorb(fit)
            mean_square = np.mean(td_error**2)
            update = self._step.apply(fit, float(np.sqrt(mean_square)))
        if update is None:
            raise DivergenceError("no transition of a batch can be replayed")

        # The posterior of this batch is the prior of the next.
        self._information = information
        self._mean = self._present
        largest_square = settings.outlier * self._variance
        squares = np.minimum(td_error**2, largest_square)
        change = float(squares.mean()) - self._variance
        share = min(len(td_error) / settings.variance_memory, 1.0)
        self._variance += share * change
        return update._replace(failures=failures)

    def _posterior(self, td_error: Vector, gradient: Matrix) -> tuple[Fit, Matrix]:
        """The step from the present θ to the posterior's mean, and the posterior's information.

        Args:
            td_error: δ, (K,).
            gradient: G, (K, n_θ), scaled.
        """
        settings = self.configuration
        prior = self._information
        limit = settings.innovation_clip * self._variance**0.5
        # Noise that lasts tells the same again: the fit takes each sample for less.
        variance = self._redundancy * self._variance
        # As online: no single sample decides.
        innovation = np.clip(td_error, -limit, limit)
        of_batch = gradient.T @ gradient / variance
        information = prior + of_batch
        from_prior = self._present - self._mean
        slope = gradient.T @ innovation / variance
        slope -= prior @ from_prior
        step = cho_solve(cho_factor(information), slope)
        fit = Fit(slope, step, information.copy)
        # Of a step that is too long only a share is taken, and that share of the information.
        largest = settings.largest_step or np.inf
        longest = float(np.abs(step).max())
        share = 1.0 / max(longest / largest, 1.0)
        return fit.shrunk(share), prior + share * of_batch

    @property
    def _present(self) -> Vector:
        """d of the controller's θ."""
        present: Vector = (self.controller.theta - self._start) / self._step.scale
        return present

    def _begin_filter(self, td_error: Vector) -> Vector:
        """Take the noise, the widths, c_f and the mean cost from the samples of the first batch.

        Args:
            td_error: δ of the batch, (K,).

        Returns:
            δ with that mean cost, (K,).
        """
        td_error = self._average_cost.begin(td_error + self._average_cost.mean_cost)
        mean_square = float(np.mean(td_error**2))
        self._variance = max(mean_square, np.finfo(np.float64).tiny)
        states = self._buffer.column("s")
        errors = self._buffer.column("error")
        doubt = self.configuration.persistence_doubt
        self._redundancy = redundancy_of(states, errors, doubt)
        start = self._begin_with_prior(states, errors, self._variance**0.5)
        self.controller.theta = start.theta
        self._start = start.theta.copy()
        return td_error

    def retreat(self) -> None:
        """Take the θ to which the loop has gone back for the mean of the prior."""
        self._mean = self._present

    def state_dict(self) -> State:
        """State of `ValueRule`, the open batch, and the posterior."""
        return {
            **super().state_dict(),
            **prefixed("buffer", self._buffer.state_dict()),
            "start": self._start,
            "information": self._information,
            "mean": self._mean,
            "variance": self._variance,
            "redundancy": self._redundancy,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        super().load_state_dict(state)
        self._buffer.load_state_dict(part_of(state, "buffer"))
        self._start = state["start"]
        self._information = state["information"]
        self._mean = state["mean"]
        self._variance = state["variance"]
        self._redundancy = state["redundancy"]


class Replayed(NamedTuple):
    """The values of a buffer's K transitions at the controller's θ.

    Attributes:
        solved: which of them could be solved, (K,) of bool; L of them.
        q: Q(s, a) of these, (L,).
        next_value: V(s₊), (L,).
        gradient: ∇Q, unscaled, (L, n_θ).
    """

    solved: NDArray[np.bool_]
    q: Vector
    next_value: Vector
    gradient: Matrix


class ReplayBuffer:
    """Up to `capacity` transitions with their linearisation points.

    V and Q of a real-time iteration depend on the linearisation point, so a replay uses that of the
    loop, with the model and cost of the controller's θ. Values solved at the same θ are kept where
    the controller is `memoryless`; NaN stands for unknown ones.
    """

    def __init__(self, controller: RtiNmpc, capacity: int) -> None:
        self._controller = controller
        self._capacity = capacity
        self.count = 0
        self._columns: dict[str, NDArray[Any]] = {}  # arrays (capacity, …) by name
        self._theta = controller.theta  # of the values
        self._q = np.full(capacity, np.nan)
        self._next_value = np.full(capacity, np.nan)
        self._gradient = np.zeros((capacity, self._theta.size))

    def column(self, name: str) -> NDArray[Any]:
        """A quantity of the transitions kept, (K, …), in time's order."""
        return self._columns[name][: self.count]

    def clear(self) -> None:
        """Keep no transition."""
        self.count = 0
        self._forget_values()

    def _forget_values(self) -> None:
        self._q[:] = np.nan
        self._next_value[:] = np.nan

    def add(
        self,
        transition: Transition,
        error: Vector,
        correction: float,
    ) -> None:
        """Keep a transition, solved at the controller's θ.

        Args:
            transition: of a rule that `needs_points`.
            error: of its prediction, (n,).
            correction: the expectation of its next penalty less it.
        """
        # The rule needs points, so the loop has given them.
        point = transition.point
        next_point = transition.next_point
        assert point is not None and next_point is not None
        values: dict[str, Any] = {
            "number": transition.number,
            "s": transition.s,
            "a": transition.a,
            "explored": transition.explored,
            "cost": transition.cost,
            "next_s": transition.next_s,
            "error": error,
            "correction": correction,
            **prefixed("point", point._asdict()),
            **prefixed("next_point", next_point._asdict()),
        }
        row = self.count
        self.count += 1
        for name, value in values.items():
            array = np.asarray(value)
            # The first transition says how long its arrays are.
            if name not in self._columns:
                shape = (self._capacity, *array.shape)
                self._columns[name] = np.zeros(shape, array.dtype)
            self._columns[name][row] = array
        if not self._controller.memoryless:
            return
        # What the loop has solved at this θ need not be solved again.
        self._forget_values_of_another_theta()
        self._next_value[row] = transition.next_solution.value
        if not transition.explored:
            self._q[row] = transition.solution.value
            self._gradient[row] = transition.solution.value_gradient

    def replay(self) -> Replayed:
        """Solve the transitions at the controller's θ."""
        self._forget_values_of_another_theta()
        q = self._q[: self.count]
        next_value = self._next_value[: self.count]
        gradient = self._gradient[: self.count]
        unknown = np.isnan(q + next_value)
        self._solve(np.flatnonzero(unknown))
        # A QP that failed has left NaN.
        solved = np.isfinite(q) & np.isfinite(next_value)
        return Replayed(
            solved=solved,
            q=q[solved],
            next_value=next_value[solved],
            gradient=gradient[solved],
        )

    def _forget_values_of_another_theta(self) -> None:
        theta = self._controller.theta
        # Identity first: it is the common case, and the cheap one.
        same = theta is self._theta or np.array_equal(theta, self._theta)
        if not (same and self._controller.memoryless):
            self._forget_values()
        self._theta = theta

    def _solve(self, rows: NDArray[np.int64]) -> None:
        """Solve for unknown values of these rows, in time's order; a failing QP leaves NaN."""
        # V(s₊) of one transition is Q of the next: a successor shares the linearisation, and where
        # it was greedy the solution too.
        controller = self._controller
        columns = self._columns
        states = columns["s"]
        actions = columns["a"]
        next_states = columns["next_s"]
        # Plain numbers: reading them one by one out of arrays costs as much as a gradient.
        numbers = columns["number"][rows].tolist()
        explored = columns["explored"][rows].tolist()
        prepared_for: int | None = None  # the sample whose linearisation the controller has
        solution: RtiSolution | None = None  # its greedy one, if known
        for number, exploring, row in zip(numbers, explored, rows.tolist(), strict=True):
            try:
                if isnan(self._q[row]):
                    if prepared_for != number:
                        controller.prepare_at(self._point("point", row))
                        solution = None
                    if exploring:
                        solution = controller.feedback(states[row], actions[row])
                    elif solution is None:
                        solution = controller.feedback(states[row])
                    self._q[row] = solution.value
                    self._gradient[row] = solution.value_gradient
                if isnan(self._next_value[row]):
                    controller.prepare_at(self._point("next_point", row))
                    prepared_for = number + 1
                    solution = controller.feedback(next_states[row])
                    self._next_value[row] = solution.value
            except QpError:
                prepared_for = None

    def _point(self, name: str, row: int) -> LinearisationPoint:
        """The linearisation point `point` or `next_point` of a row."""
        x = self._columns[f"{name}.x"][row]
        u = self._columns[f"{name}.u"][row]
        costates = self._columns[f"{name}.costates"][row]
        return LinearisationPoint(x, u, costates)

    def state_dict(self) -> State:
        """The transitions, and the values solved at the present θ."""
        return {
            **prefixed("column", self._columns),
            "count": self.count,
            "theta": self._theta,
            "q": self._q,
            "next_value": self._next_value,
            "gradient": self._gradient,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._columns = part_of(state, "column")
        self.count = state["count"]
        self._theta = state["theta"]
        self._q = state["q"]
        self._next_value = state["next_value"]
        self._gradient = state["gradient"]
