"""One-step prediction errors of the controller's model: how they persist, what they cost.

A disturbance that lasts for more than a sample makes errors that are correlated in time: they
persist, r₊ = Φ r + e, a first-order autoregression. Their mean over a window is then less certain
than that of as many independent ones, and what they were in one sample says something of the next.
"""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from controllers.functions import StackedFunction, define
from controllers.model import discretise
from controllers.problem import Problem, linear_model
from controllers.theta import Parameters
from cosim.core.protocols import Array, Matrix, Vector
from cosim.core.scenario import Penalty, Scenario
from learning.checkpoint import State
from learning.gaussian_penalty import normal_penalties

LONGEST_TIME_CONSTANT = 1000.0
"""Cap of the slowest time constant in samples; that of an integrating state is infinite."""
DOUBLINGS = 12
"""Rounds of the sum Γ, 2¹² terms: at the largest radius what is left out is below rounding."""


class OneStepModel:
    """f(s, a), the next state that the controller's own nominal model predicts, (n,).

    `predict` and `errors` take many samples, and the model parameters and c_f of θ. Raises
    ModelError where the scenario names no model.
    """

    def __init__(self, scenario: Scenario) -> None:
        problem = Problem.from_scenario(scenario)
        model = problem.model
        self._problem = problem
        self._model = model
        self.n_states = problem.n_states
        simulate = discretise(model, problem.sampling_time, problem.substeps)
        x = ca.SX.sym("x", problem.n_states)
        u = ca.SX.sym("u", problem.n_actions)
        p = ca.SX.sym("p", len(model.parameters))
        d = ca.DM(model.nominal_disturbance)
        p_nominal = ca.DM(model.nominal_parameters)
        # Two functions: that of the nominal parameters is called in every sample.
        y_nominal = simulate(x, u, d, p_nominal)
        y = simulate(x, u, d, p)
        inputs = {"x": x, "u": u}
        inputs_and_parameters = {"x": x, "u": u, "p": p}
        nominal = define("f", inputs, {"y": y_nominal})
        parametric = define("f", inputs_and_parameters, {"y": y})
        self._nominal = StackedFunction(nominal)
        self._parametric = StackedFunction(parametric)

    def __call__(self, s: Vector, a: Vector) -> Vector:
        """Prediction for state s (n,) and action a (m,)."""
        function = self._nominal
        function.inputs["x"][:] = s
        function.inputs["u"][:] = a
        function()
        return function.stack.copy()

    @cached_property
    def slowest(self) -> float:
        """Samples of f's slowest time constant at the reference, 1000 at most."""
        # A continuous pole −1/T is a discrete one of 1 − 1/T samples, to first order.
        A, _ = linear_model(self._problem)
        eigenvalues = np.linalg.eigvals(A)
        slowest_pole = np.abs(eigenvalues).max()
        rate = 1.0 - slowest_pole
        least = 1.0 / LONGEST_TIME_CONSTANT
        return float(1.0 / max(rate, least))

    def parameters(self, theta: Parameters) -> Vector:
        """All parameters of the model at θ, (n_p,): the nominal ones but for its block p."""
        return theta.of_model(self._model)

    def predict(
        self,
        states: Matrix,
        actions: Matrix,
        parameters: Vector,
    ) -> Matrix:
        """Predictions f(s, a) without offset.

        Args:
            states: s, (K, n).
            actions: a, (K, m).
            parameters: of the model, (n_p,), the same for all.

        Returns:
            s₊, (K, n).
        """
        states = np.atleast_2d(states)
        actions = np.atleast_2d(actions)
        predicted = np.empty(states.shape)
        function = self._parametric
        function.inputs["p"][:] = parameters
        # One call a sample, into the function's own memory: no allocation.
        for row, s, a in zip(predicted, states, actions, strict=True):
            function.inputs["x"][:] = s
            function.inputs["u"][:] = a
            function()
            row[:] = function.stack
        return predicted

    def errors(
        self,
        states: Matrix,
        actions: Matrix,
        next_states: Matrix,
        theta: Parameters,
    ) -> Matrix:
        """Prediction errors s₊ − f_θ(s, a), offset included.

        Args:
            states: s, (K, n).
            actions: a, (K, m).
            next_states: s₊, (K, n).
            theta: has the model's parameters and c_f.

        Returns:
            e, (K, n).
        """
        parameters = self.parameters(theta)
        predicted = self.predict(states, actions, parameters)
        predicted = predicted + theta["c_f"]
        return np.atleast_2d(next_states) - predicted


def known_penalty(penalty: Penalty, states: Matrix) -> Vector:
    """Penalty of many states.

    Args:
        penalty: its weights and bounds.
        states: (…, n).

    Returns:
        Penalties, (…).
    """
    # Linear and quadratic in the violation of each state.
    violation = penalty.violation(states)
    price = penalty.linear + penalty.quadratic * violation
    due = violation * price
    return np.asarray(due.sum(axis=-1))


class SortedErrors:
    """Errors (M, n), of each state in ascending order, for means beyond a threshold."""

    def __init__(self, errors: Matrix) -> None:
        self.errors = np.sort(errors, axis=0)
        # Running sums, so that a mean beyond any threshold is two look-ups.
        self._sum = _running_sums(self.errors)
        self._sum_of_squares = _running_sums(self.errors**2)

    def beyond(
        self,
        i: int,
        threshold: Vector,
        *,
        above: bool = False,
    ) -> tuple[Vector, Vector]:
        """Means of v and v² with v = max(t − e_i, 0), or max(e_i − t, 0).

        Args:
            i: the state.
            threshold: t, (K,).
            above: max(e_i − t, 0).

        Returns:
            Both means, (K,) each.
        """
        # Σ (t − e) = number·t − Σ e over the errors on this side of t; the square likewise.
        count = len(self.errors)
        below = np.searchsorted(self.errors[:, i], threshold)
        number = below
        total = self._sum[below, i]
        squares = self._sum_of_squares[below, i]
        sign = 1.0
        if above:
            number = count - below
            total = self._sum[-1, i] - total
            squares = self._sum_of_squares[-1, i] - squares
            sign = -1.0
        sum_of_distances = number * threshold - total
        sum_of_squares = number * threshold**2 - 2.0 * threshold * total + squares
        # Rounding may leave less than nothing.
        linear = np.maximum(sign * sum_of_distances / count, 0.0)
        quadratic = np.maximum(sum_of_squares / count, 0.0)
        return linear, quadratic


def _running_sums(values: Matrix) -> Matrix:
    """Sums of the first 0, 1, … M rows (M, n), (M+1, n)."""
    _, n = values.shape
    zero = np.zeros((1, n))
    sums = np.cumsum(values, axis=0)
    return np.concatenate([zero, sums])


def expected_penalties(
    penalty: Penalty,
    predictions: Matrix,
    errors: SortedErrors,
    scales: Matrix | None = None,
    bounds: tuple[Matrix, Matrix] | None = None,
) -> Matrix:
    """Expected penalty of each state's bounds, a mean over f + h e of all errors e.

    Args:
        penalty: its weights and bounds.
        predictions: f, (K, n).
        errors: e.
        scales: h, (K, n), one if not given.
        bounds: lower and upper bounds of the states where they move, (K, n) each; the penalty's
            if not given.

    Returns:
        Penalties of the lower and the upper bound, (n, 2, K).
    """
    if scales is None:
        scales = np.ones(predictions.shape)
    if bounds is None:
        bounds = (
            np.broadcast_to(penalty.lower, predictions.shape),
            np.broadcast_to(penalty.upper, predictions.shape),
        )
    count, n = predictions.shape
    costs = np.zeros((n, 2, count))
    for i in range(n):
        predicted = predictions[:, i]
        h = scales[:, i]
        for k, moving in enumerate(bounds):
            bound = moving[:, i]
            # One that is infinite is no bound, and does not move.
            if not np.isfinite(bound).all():
                continue
            # In units of h the errors are the same for all predictions.
            threshold = (bound - predicted) / h
            is_upper = k == 1
            first, second = errors.beyond(i, threshold, above=is_upper)
            linear = penalty.linear[i] * h * first
            quadratic = penalty.quadratic[i] * h**2 * second
            costs[i, k] = linear + quadratic
    return costs


class PredictionErrors:
    """The last `capacity` errors e = s₊ − f(s, a), and the mean penalty expected from them.

    The realised penalty p(s₊) is a rare spike; its expectation mean_i p(f(s, a) + e_i) is smooth in
    s and a. It needs plant data alone, and the errors include those of the model. Under sensors
    s₊ is an estimate, whose own error is normal: then mean_i E[p(f(s, a) + e_i + n_i)].
    """

    def __init__(self, scenario: Scenario, capacity: int) -> None:
        self._penalty = scenario.state_penalty
        # A row a state: NumPy is three times as fast along the errors as along a few states.
        n_states = scenario.state_lower.size
        self._errors = np.zeros((n_states, capacity))
        self._variances: Matrix | None = None  # of the estimates s₊, as the errors
        self.count = 0

    @property
    def values(self) -> Matrix:
        """The errors kept, (K, n), in no order."""
        return self._errors[:, : self.count].T

    @property
    def variances(self) -> Matrix | None:
        """Variances of the estimates s₊, (K, n), as `values`; None where states are known."""
        return None if self._variances is None else self._variances[:, : self.count].T

    def add(self, error: Vector, variances: Vector | None = None) -> None:
        """Keep an error in place of the oldest one.

        Args:
            error: e, (n,).
            variances: of the estimate s₊, (n,); None where the state is known, in all samples.
        """
        _, capacity = self._errors.shape
        oldest = self.count % capacity
        self._errors[:, oldest] = error
        if variances is not None:
            if self._variances is None:
                self._variances = np.zeros(self._errors.shape)
            self._variances[:, oldest] = variances
        self.count += 1

    def expected_penalty(self, prediction: Vector, moved: Penalty | None = None) -> float:
        """mean_i p(f + e_i); NaN before the first error.

        Args:
            prediction: f, (n,).
            moved: penalty of the bounds where they have moved; None: the scenario's.
        """
        values = self.values
        if not len(values):
            return float("nan")
        penalty = self._penalty if moved is None else moved
        states = prediction + values
        if self.variances is None:
            due = known_penalty(penalty, states)
        else:
            due = normal_penalties(penalty, states, self.variances).sum(axis=0)
        return float(due.mean())

    def state_dict(self) -> State:
        """The errors, and how many there have been."""
        state: State = {"errors": self._errors, "count": self.count}
        if self._variances is not None:
            state["variances"] = self._variances
        return state

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._errors = state["errors"]
        self._variances = state.get("variances")
        self.count = state["count"]


def estimate_persistence(
    later: Array,
    before: Array,
    earlier: Array,
    n_earlier: int,
    *,
    doubt: float,
    largest: float = 0.99,
    smallest: float = 0.03,
) -> Array:
    """Φ by least squares; zero where independent errors would look like it.

    The likelihood ratio of Φ = 0 is a χ² of K² degrees of freedom where the errors are independent:
    of mean K² and variance 2K².

    Args:
        later: r₊, (M, K).
        before: r, (M, K).
        earlier: an earlier estimate of Φ, (K, K), which counts as if it came from these errors.
        n_earlier: number of errors of which that was one.
        doubt: standard deviations by which the ratio must exceed its mean.
        largest: largest spectral radius of Φ; errors that last longer are a mean.
        smallest: combinations of outputs whose errors are below this share of the largest count as
            free of errors.

    Returns:
        Φ, (K, K).
    """
    later = later - later.mean(axis=0)
    before = before - before.mean(axis=0)
    count, K = before.shape
    # In units of their size; an output without errors has none that persist.
    size = before.std(axis=0)
    size = np.where(size > 0, size, 1.0)
    scaled_later = later / size
    scaled_before = before / size
    # A combination of outputs that hardly errs says nothing of the next errors. One disturbance of
    # many states makes such: what is left is the model's curvature, and Φ would be huge in it.
    solution, *_ = np.linalg.lstsq(scaled_before, scaled_later, rcond=smallest)
    weight = n_earlier / (count + n_earlier)
    # Rows of errors multiply from the left: Φᵀ, in the units of the scaled errors.
    scaled_earlier = earlier.T * size[:, None] / size
    solution = (1 - weight) * solution + weight * scaled_earlier

    # Log-likelihoods of normal errors, with and without what persists.
    innovations = scaled_later - scaled_before @ solution
    without = _log_determinant(scaled_later)
    with_persistence = _log_determinant(innovations)
    gain = without - with_persistence
    ratio = count * gain
    degrees = K**2
    deviation = (2 * degrees) ** 0.5
    # An earlier estimate has passed this test.
    looks_independent = ratio <= degrees + doubt * deviation
    if looks_independent and not weight:
        return np.zeros((K, K))

    in_own_units = solution / size[:, None] * size
    persistence: Array = in_own_units.T
    radius = max(_radius(persistence), 1e-9)
    shrinkage = min(1.0, largest / radius)
    return persistence * shrinkage


def _log_determinant(values: Array) -> float:
    """Log of the determinant of the covariance of values (M, K), of mean zero."""
    covariance = values.T @ values / len(values)
    floor = 1e-12 * np.eye(len(covariance))
    _, logarithm = np.linalg.slogdet(covariance + floor)
    return float(logarithm)


def _radius(persistence: Array) -> float:
    """The spectral radius."""
    eigenvalues = np.linalg.eigvals(persistence)
    return float(np.abs(eigenvalues).max())


def error_covariance(persistence: Array, innovations: Array) -> Array:
    """Covariance of r, (K, K), which solves Γ = Φ Γ Φᵀ + Σ.

    Args:
        persistence: Φ, (K, K).
        innovations: Σ, the covariance of e, (K, K).
    """
    if not persistence.any():
        return innovations
    # Γ = Σ_k Φᵏ Σ Φᵏᵀ, twice as many terms in each round. The equation itself is ill-conditioned
    # where an output has hardly any noise: Φ then has entries of any size.
    covariance = innovations
    power = persistence
    for _ in range(DOUBLINGS):
        covariance = covariance + power @ covariance @ power.T
        power = power @ power
    return covariance


def mean_error_covariance(
    persistence: Array,
    innovations: Array,
    count: int,
) -> Array:
    """Covariance of the mean of consecutive r: Γ/T + Σ_k (1 − k/T) (Φᵏ Γ + Γ Φᵏᵀ)/T, k from 1.

    Args:
        persistence: Φ, (K, K).
        innovations: Σ, the covariance of e, (K, K).
        count: T, the number of r.

    Returns:
        The covariance, (K, K); of independent errors Σ/T.
    """
    if not persistence.any():
        return innovations / count
    gamma = error_covariance(persistence, innovations)
    # Σ_k (1 − k/T) Φᵏ in closed form.
    one = np.eye(len(persistence))
    inverse = np.linalg.inv(one - persistence)
    power = np.linalg.matrix_power(persistence, count)
    remainder = persistence @ (one - power) @ inverse @ inverse / count
    total = persistence @ inverse - remainder
    later = total @ gamma
    earlier = gamma @ total.T
    covariance: Array = (gamma + later + earlier) / count
    return covariance


def effective_number(persistence: Array, count: int) -> float:
    """Number of independent errors that say as much as so many consecutive ones.

    That of a scalar autoregression with the spectral radius ρ of Φ, count (1 − ρ)/(1 + ρ).

    Args:
        persistence: Φ, (K, K).
        count: of errors.
    """
    radius = _radius(persistence) if persistence.any() else 0.0
    return count * (1 - radius) / (1 + radius)


def linear_part(states: Matrix, errors: Matrix) -> Matrix:
    """The part of errors that is affine in the states, by least squares.

    Args:
        states: s, (K, n).
        errors: e, (K, n).

    Returns:
        The affine part, (K, n).
    """
    spread = states.std(axis=0)
    unit = np.where(spread > 0, spread, 1.0)
    z = (states - states.mean(axis=0)) / unit
    ones = np.ones((len(z), 1))
    features = np.hstack([ones, z])
    coefficients, *_ = np.linalg.lstsq(features, errors)
    part: Matrix = features @ coefficients
    return part
