"""One-step prediction errors of the controller's model, and the penalty that they make likely."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from controllers.economic import linear_model
from controllers.functions import StackedFunction
from controllers.model import discretise
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector
from cosim.scenario import Penalty, Scenario

SLOWEST = 1000.0
"""Cap of the slowest time constant in samples; that of an integrating state is infinite."""


class OneStepModel:
    """f(s, a), the next state that the controller's own nominal model predicts, (n,).

    `predict` and `errors` take many samples, and the model parameters and c_f of θ. Raises
    ModelError where the scenario names no model.
    """

    def __init__(self, scenario: Scenario) -> None:
        problem = Problem.from_scenario(scenario)
        self.states, self.inputs = problem.n_states, problem.n_states + problem.n_actions
        model = problem.model
        step = discretise(model, problem.sampling_time, problem.substeps)
        x, u = ca.SX.sym("x", problem.n_states), ca.SX.sym("u", problem.n_actions)
        d, p = ca.DM(model.nominal_disturbance), ca.DM(model.nominal_parameters)
        self._function = StackedFunction("f", {"x": x, "u": u}, {"y": step(x, u, d, p)})
        self._problem, self._model = problem, model
        free = ca.SX.sym("p", len(model.parameters))
        given = {"x": x, "u": u, "p": free}
        self._parametric = StackedFunction("f", given, {"y": step(x, u, d, free)})

    def __call__(self, s: Vector, a: Vector) -> Vector:
        """Prediction for state s (n,) and action a (m,)."""
        function = self._function
        function.inputs["x"][:], function.inputs["u"][:] = s, a
        function()
        return function.stack.copy()

    @cached_property
    def slowest(self) -> float:
        """Samples of f's slowest time constant at the reference, `SLOWEST` at most."""
        largest = np.abs(np.linalg.eigvals(linear_model(self._problem)[0])).max()
        return float(1.0 / max(1.0 - largest, 1.0 / SLOWEST))

    def parameters(self, theta: Parameters) -> Vector:
        """All parameters of the model at θ, (n_p,): the nominal ones but for its block p."""
        values = self._model.nominal_parameters
        if "p" in theta.blocks:
            values[self._model.parameter_indices(theta.blocks.block("p").labels)] = theta["p"]
        return values

    def predict(self, states: Matrix, actions: Matrix, parameters: Vector) -> Matrix:
        """f(s, a), (K, n), without offset, for K states and actions and one (n_p,) for all."""
        states, actions = np.atleast_2d(states), np.atleast_2d(actions)
        function, found = self._parametric, np.empty(states.shape)
        function.inputs["p"][:] = parameters
        for row, s, a in zip(found, states, actions, strict=True):
            function.inputs["x"][:], function.inputs["u"][:] = s, a
            function()
            row[:] = function.stack
        return found

    def errors(
        self, states: Matrix, actions: Matrix, next_states: Matrix, theta: Parameters
    ) -> Matrix:
        """s₊ − f_θ(s, a), (K, n), offset included."""
        predicted = self.predict(states, actions, self.parameters(theta)) + theta["c_f"]
        return np.atleast_2d(next_states) - predicted


def known_penalty(penalty: Penalty, states: Matrix) -> Vector:
    """Penalty of many states (…, n), shape (…)."""
    violation = penalty.violation(states)
    due = violation * (penalty.linear + penalty.quadratic * violation)
    return np.asarray(due.sum(axis=-1))


class SortedErrors:
    """Errors (M, n), of each state in ascending order, for means beyond a threshold."""

    KEPT = ("errors", "_sum", "_squares")

    def __init__(self, errors: Matrix) -> None:
        self.errors = np.sort(errors, axis=0)
        zero = np.zeros((1, self.errors.shape[1]))
        self._sum = np.concatenate([zero, np.cumsum(self.errors, axis=0)])
        self._squares = np.concatenate([zero, np.cumsum(self.errors**2, axis=0)])

    def beyond(self, i: int, threshold: Vector, *, above: bool = False) -> tuple[Vector, Vector]:
        """Means of v and v² with v = max(t − e_i, 0), or max(e_i − t, 0), for each t of (K,)."""
        count = np.searchsorted(self.errors[:, i], threshold)
        number, first, second = count, self._sum[count, i], self._squares[count, i]
        if above:
            number = len(self.errors) - count
            first, second = self._sum[-1, i] - first, self._squares[-1, i] - second
        sign = -1.0 if above else 1.0
        linear = sign * (number * threshold - first) / len(self.errors)
        quadratic = (number * threshold**2 - 2.0 * threshold * first + second) / len(self.errors)
        return np.maximum(linear, 0.0), np.maximum(quadratic, 0.0)


def expected_penalties(
    penalty: Penalty, predictions: Matrix, errors: SortedErrors, scales: Matrix | None = None
) -> Matrix:
    """Penalty of each state's lower and upper bound, (n, 2, K), a mean over f + h e of all errors.

    `predictions` f and `scales` h are (K, n), h one if not given.
    """
    costs = np.zeros((predictions.shape[1], 2, len(predictions)))
    for i, predicted in enumerate(predictions.T):
        h = np.ones(len(predicted)) if scales is None else scales[:, i]
        for k, bound in enumerate((penalty.lower[i], penalty.upper[i])):
            if np.isfinite(bound):
                first, second = errors.beyond(i, (bound - predicted) / h, above=bool(k))
                due = penalty.linear[i] * h * first + penalty.quadratic[i] * h**2 * second
                costs[i, k] = due
    return costs


class PredictionErrors:
    """The last `capacity` errors e = s₊ − f(s, a), and the mean penalty expected from them.

    The realised penalty p(s₊) is a rare spike; its expectation mean_i p(f(s, a) + e_i) is smooth in
    s and a. It needs plant data alone, and the errors include those of the model.
    """

    KEPT = ("_errors", "count")

    def __init__(self, scenario: Scenario, capacity: int) -> None:
        self._penalty = scenario.state_penalty
        # A row a state: NumPy is three times as fast along the errors as along a few states.
        self._errors = np.zeros((scenario.state_lower.size, capacity))
        self.count = 0

    @property
    def values(self) -> Matrix:
        """The errors kept, (K, n), in no order."""
        return self._errors[:, : self.count].T

    def add(self, error: Vector) -> None:
        """Keep an error (n,) in place of the oldest one."""
        self._errors[:, self.count % self._errors.shape[1]] = error
        self.count += 1

    def expected_penalty(self, prediction: Vector) -> float:
        """mean_i p(f + e_i) for a prediction f (n,); NaN before the first error."""
        values = self.values
        due = known_penalty(self._penalty, prediction + values)
        return float(due.mean()) if len(values) else float("nan")
