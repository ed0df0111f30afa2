"""Actor-critic: the deterministic policy gradient, with Gauss–Newton steps in a trust region."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from pydantic import Field
from scipy.linalg import eigh
from scipy.optimize import brentq

from controllers.model import discretise, economic_cost
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.protocols import Matrix, Vector
from cosim.core.scenario import NonNegative, Penalty, Positive, Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Configuration, Count, ExplorationProbability
from learning.errors import DivergenceError
from learning.gaussian_penalty import normal_penalties
from learning.prediction_errors import (
    PredictionErrors,
    SortedErrors,
    expected_penalties,
    linear_part,
)
from learning.q_learning import ValueConfiguration, prior_deviation, redundancy_of
from learning.step import ConstrainedStep, Fit, policy_gradient_fit

DIFFERENCE_SHARE = 0.25
"""Distance, in standard deviations of the errors, over which expected penalties are differenced."""
LEAST_MULTIPLIER = 1e-12
"""Accuracy of the trust region's multiplier, and its least value, relative to the curvatures."""


class ActorCriticConfiguration(Configuration):
    """Hyperparameters of the actor-critic."""

    exploration_probability: ExplorationProbability = 0.0
    batch_size: Count = Field(240, description="samples per step of θ, all at one θ")
    forgetting: float = Field(
        0.95,
        ge=0,
        lt=1,
        description="weight of a batch in the critic, relative to the next one at the same θ",
    )
    prediction_errors: Count = Field(
        1000,
        description="prediction errors over which the next value is expected; more where they are "
        "correlated in time",
    )
    persistence_doubt: NonNegative = Field(
        4.0,
        description="standard deviations by which errors must look correlated in time, or they "
        "count as independent",
    )
    advantage_width: Positive = Field(
        0.1,
        description="how far the nominal model's slope of Q may be wrong, as a share of its terms",
    )
    radius: Positive = Field(
        0.1,
        description="trust region: RMS change of the action in a step, as a share of its range",
    )
    largest_step: Positive = Field(
        1.0,
        description="trust region: length of a step in prior deviations of θ",
    )
    decay_after: Count = Field(
        1440,
        description="samples T after which the trust region shrinks, to T/k at the k-th",
    )


class ActionSlopes(NamedTuple):
    """The nominal model at K states and actions, and its slopes in the action.

    Attributes:
        following: f(s, a), (K, n).
        cost: ℓ(s, a), (K,).
        gain: ∂f/∂a, (K, n, m).
        cost_gradient: ∂ℓ/∂a, (K, m).
        cost_hessian: ∂²ℓ/∂a², (K, m, m).
    """

    following: Matrix
    cost: Vector
    gain: Matrix
    cost_gradient: Matrix
    cost_hessian: Matrix


class ValueSlopes(NamedTuple):
    """Slope and curvature of Q in the action at K samples, in the actions' ranges.

    Attributes:
        cost: slope of the stage cost, (K, m).
        value: slope of the expected next value, (K, m).
        curvature: of both together, (K, m, m).
        in_state: slope of the expected next value in the next state, (K, n).
    """

    cost: Matrix
    value: Matrix
    curvature: Matrix
    in_state: Matrix


class PolicyGradient(NamedTuple):
    """Estimates about the policy from a batch of K samples.

    θ counts in its prior deviations, actions in their ranges.

    Attributes:
        gradient: ∇J, (n_θ,).
        hessian: the Gauss–Newton Hessian E[∇π ∇²_a Q ∇πᵀ], (n_θ, n_θ).
        metric: E[∇π ∇πᵀ], (n_θ, n_θ).
        td_errors: (K,).
    """

    gradient: Vector
    hessian: Matrix
    metric: Matrix
    td_errors: Vector


class ActorCritic(Algorithm):
    """Actor-critic: descends the mean cost J along ∇J = E[∇π ∇_a Q] (paper.tex, eq. pg_update).

    θ stays for a batch. Then LSTD fits the smooth part W of the differential value V = p + W. The
    slope of Q is that of the nominal model with the next value in expectation, plus an advantage
    that is compatible with the policy and is fitted to the TD errors of the samples that explore:

        Q(s, a) = ℓ(s, a) + mean_i V(f(s, a) + e_i) + (a − π(s))ᵀ ∇π(s)ᵀ w

    with f and ℓ the controller's nominal model and e_i its latest prediction errors. w has a prior,
    so that it corrects the model where the samples say so. The step is that of Gauss and Newton
    with the Hessian E[∇π ∇²_a Q ∇πᵀ] (Brandner, Gros and Lucia, arXiv 2508.02441) in a trust
    region, which bounds the change of the action (docs/rules/actor-critic.md).
    """

    learns_from_estimates = True

    Configuration = ActorCriticConfiguration
    configuration: ActorCriticConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings = self.configuration
        scenario = self.scenario
        n = scenario.state_lower.size
        m = scenario.action_lower.size
        n_theta = self.controller.theta.size
        size = settings.batch_size
        self._model = NominalModel(scenario, self.controller.parameters)
        self._errors = PredictionErrors(scenario, settings.prediction_errors)
        self._critic = DifferentialValue(n)
        # Actions are counted in their ranges.
        self._range: Vector = scenario.action_upper - scenario.action_lower
        # A row a sample.
        self._batch: dict[str, Any] = {
            "s": np.zeros((size, n)),
            "next_s": np.zeros((size, n)),
            "next_variances": np.zeros((size, n)),
            "cost": np.zeros(size),
            "a": np.zeros((size, m)),
            "policy": np.zeros((size, m)),
            "explored": np.zeros(size, bool),
            "jacobian": np.zeros((size, m, n_theta)),
        }
        self._filled = 0  # rows of the open batch
        self._redundancy = 1.0  # of consecutive prediction errors, by the first batch
        self._has_coordinates = False
        self._step = ConstrainedStep(self.controller, settings)
        self._information: Matrix = np.zeros((n_theta, n_theta))  # Σψψᵀ/r, with forgetting
        self._moment: Vector = np.zeros(n_theta)  # Σψδ/r

    def observe(self, transition: Transition) -> Update | None:
        """Learn from one sample; the last of a batch moves θ."""
        batch = self._batch
        row = self._filled
        batch["s"][row] = transition.s
        batch["next_s"][row] = transition.next_s
        if transition.next_variances is not None:
            batch["next_variances"][row] = transition.next_variances
        batch["cost"][row] = transition.stage_cost
        batch["a"][row] = transition.a
        batch["policy"][row] = transition.solution.action
        batch["explored"][row] = transition.explored
        batch["jacobian"][row] = transition.solution.policy_jacobian
        self._filled += 1
        if self._filled < self.configuration.batch_size:
            return None
        # All rows are overwritten by the next batch.
        self._filled = 0
        return self._update(transition.number)

    def _update(self, number: int) -> Update:
        """The constrained step along −∇J, in a trust region; `number` is the sample's."""
        settings = self.configuration
        batch = self.gradient()
        # A step of length one is as long as the trust region allows, before it shrinks.
        in_actions = batch.metric / settings.radius**2
        in_theta = np.eye(len(batch.metric)) / settings.largest_step**2
        region = in_actions + in_theta
        radius = min(1.0, settings.decay_after / (number + 1))
        fit = trust_region_fit(batch.gradient, batch.hessian, region, radius)

        before = self.controller.theta
        squared_errors = batch.td_errors * batch.td_errors
        error_size = float(np.sqrt(np.mean(squared_errors)))
        update = self._step.apply(fit, error_size)
        change = self.controller.theta - before
        step = change / self._step.scale
        # What was seen of another policy says less of this one.
        length = float(step @ region @ step) ** 0.5
        similarity = 1.0 - min(length, 1.0)
        self._critic.forget(settings.forgetting * similarity)
        return update

    def gradient(self) -> PolicyGradient:
        """The policy gradient of a full batch, which counts in the critic from there on."""
        batch = self._batch
        states = batch["s"]
        deviation = self._deviation()
        at_policy = self._model(states, batch["policy"])
        following, prediction_errors, cost_surprise = self._predict(at_policy.following)

        # The critic: the cost of the policy's action, and what is expected after it. A disturbance
        # that lasts shifts realised costs and states together, which a fit would take for a slope
        # of the value in the state: the longer it lasts, the more the model's cost stands in.
        errors = self._errors.values
        penalty = ExpectedPenalty(self.scenario.state_penalty, errors, self._errors.variances)
        independent_share = 1.0 / self._redundancy
        cost = at_policy.cost + independent_share * cost_surprise
        reward = cost + penalty.value(following)
        if not np.isfinite(reward + cost_surprise).all():
            raise DivergenceError("the costs or the predictions are not finite")
        td_errors = self._critic.fit(states, following, errors, reward)
        # The rest speaks in the advantage, which only samples that explore inform.
        left_out = (1.0 - independent_share) * cost_surprise
        td_errors = td_errors + left_out - left_out.mean()

        # The chain rule through the policy: ∇J = E[∇π ∇_a Q] (paper.tex, eq. pg_update).
        mean_error = errors.mean(axis=0)
        slopes = self._slopes(at_policy, penalty, following, mean_error)
        action_slope = slopes.cost + slopes.value
        jacobian = batch["jacobian"] * self._step.scale
        jacobian = jacobian / self._range[:, None]
        count = len(states)
        metric = np.einsum("kmi,kmj->ij", jacobian, jacobian) / count
        gradient = np.einsum("kmi,km->i", jacobian, action_slope) / count
        hessian = np.einsum("kmi,kmn,knj->ij", jacobian, slopes.curvature, jacobian) / count

        # What realised costs and next states say of the slope beyond the model.
        surprise = prediction_errors - mean_error
        innovation = np.einsum("kn,kn->k", slopes.in_state, surprise)
        squared_terms = slopes.cost**2 + slopes.value**2
        terms = np.mean(np.sum(squared_terms, axis=1))
        features = np.einsum("kmi,km->ki", jacobian, deviation / self._range)
        weights = self._advantage(features, td_errors + innovation, metric, float(terms))
        gradient = gradient + metric @ weights
        return PolicyGradient(gradient, hessian, metric, td_errors)

    def _slopes(
        self,
        at_policy: ActionSlopes,
        penalty: ExpectedPenalty,
        following: Matrix,
        mean_error: Vector,
    ) -> ValueSlopes:
        """Slope and curvature of Q in the action, by the chain rule through the next state.

        Args:
            at_policy: the nominal model at the policy's actions.
            penalty: its expectation over the prediction errors.
            following: predictions of the next states, (K, n).
            mean_error: mean of the prediction errors, (n,).
        """
        penalty_slope, penalty_curvature = penalty.slopes(following)
        # W is quadratic: its mean slope over the errors is that at their mean.
        in_state = penalty_slope + self._critic.gradient(following + mean_error)
        curvature = penalty_curvature + self._critic.hessian()
        gain = at_policy.gain * self._range
        units = np.outer(self._range, self._range)
        of_cost = at_policy.cost_hessian * units
        of_value = np.einsum("kni,knl,klj->kij", gain, curvature, gain)
        return ValueSlopes(
            cost=at_policy.cost_gradient * self._range,
            value=np.einsum("knm,kn->km", gain, in_state),
            curvature=of_cost + of_value,
            in_state=in_state,
        )

    def _predict(self, at_policy: Matrix) -> tuple[Matrix, Matrix, Vector]:
        """Take in the batch's prediction errors.

        Args:
            at_policy: next states of the nominal model under the policy, (K, n).

        Returns:
            The predictions of the next states under the policy (K, n), the errors that are left of
            the predictions at the actions that were applied (K, n), and by how much those samples
            cost more than the model says (K,).
        """
        states = self._batch["s"]
        applied = self._model(states, self._batch["a"])
        errors = self._batch["next_s"] - applied.following
        if not self._has_coordinates:
            self._begin(states, errors)
        following = at_policy
        # An advantage that corrects the model needs a critic of the plant, not of the model.
        if self.strategy.probability > 0:
            systematic = linear_part(states, errors)
            following = following + systematic
            errors = errors - systematic
        variances = self._batch["next_variances"]
        # Where all are zero the states are known, and not estimated.
        are_estimates = bool(variances.any())
        for error, of_estimate in zip(errors, variances, strict=True):
            self._errors.add(error, of_estimate if are_estimates else None)
        return following, errors, self._batch["cost"] - applied.cost

    def _begin(self, states: Matrix, errors: Matrix) -> None:
        """Take the coordinates from the first batch: deviations of θ that have no unit.

        Of errors that are correlated in time more are kept, so that they say as much of the tails.
        """
        settings = self.configuration
        self._redundancy = redundancy_of(states, errors, settings.persistence_doubt)
        n_errors = round(settings.prediction_errors * self._redundancy)
        self._errors = PredictionErrors(self.scenario, n_errors)
        start = self.controller.parameters
        deviation = prior_deviation(
            start,
            state_deviation=states.std(axis=0),
            error_deviation=errors.std(axis=0),
            action_deviation=settings.exploration_share * self._range,
            level=abs(float(start["c_lambda"])),
            settings=ValueConfiguration.from_dict({}),
        )
        self._step = ConstrainedStep(self.controller, settings, deviation)
        self._has_coordinates = True

    def _deviation(self) -> Vector:
        """a − π(s) of the batch, (K, m), less its mean under saturation; zero in greedy samples."""
        policy = self._batch["policy"]
        explored = self._batch["explored"]
        deviation: Matrix = self._batch["a"] - policy
        deviation[~explored] = 0.0
        # At an actuator's bound the noise has a mean, which is no slope of the cost.
        bias = self.strategy.bias(policy[explored])
        deviation[explored] -= np.nan_to_num(bias)
        return deviation

    def _advantage(
        self,
        features: Matrix,
        td_errors: Vector,
        metric: Matrix,
        terms: float,
    ) -> Vector:
        """Weights w of the compatible advantage ψᵀw, (n_θ,), with the prior N(0, τ²I).

        Args:
            features: ψ = (a − π)ᵀ∇πᵀ of the batch, (K, n_θ).
            td_errors: what the advantage is to explain, (K,).
            metric: E[∇π ∇πᵀ], (n_θ, n_θ).
            terms: mean square of the slope's terms.
        """
        settings = self.configuration
        forgetting = settings.forgetting
        tiny = np.finfo(float).tiny
        noise = float(np.mean(td_errors**2)) + tiny
        information = features.T @ features / noise
        moment = features.T @ td_errors / noise
        self._information = forgetting * self._information + information
        self._moment = forgetting * self._moment + moment
        # E|∇πᵀw|² = τ² tr E[∇π ∇πᵀ] is a share of what the model's slope is made of.
        trace = max(metric.trace(), tiny)
        variance = settings.advantage_width**2 * terms / trace
        scaled = variance * self._information + np.eye(moment.size)
        weights: Vector = np.linalg.solve(scaled, variance * self._moment)
        return weights

    def retreat(self) -> None:
        """Begin a batch at the θ to which the loop has gone back.

        Critic and advantage were of the policy that was left. Errors of prediction are the plant's,
        and stay; the step is from the controller's θ in any case.
        """
        self._filled = 0
        self._critic.forget(0.0)
        self._information = np.zeros_like(self._information)
        self._moment = np.zeros_like(self._moment)

    def state_dict(self) -> State:
        """The open batch, coordinates, prediction errors, and the sums of critic and advantage."""
        return {
            **prefixed("batch", self._batch),
            **prefixed("errors", self._errors.state_dict()),
            **prefixed("critic", self._critic.state_dict()),
            **prefixed("step", self._step.state_dict()),
            "filled": self._filled,
            "redundancy": self._redundancy,
            "has_coordinates": self._has_coordinates,
            "information": self._information,
            "moment": self._moment,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._batch = part_of(state, "batch")
        self._errors.load_state_dict(part_of(state, "errors"))
        self._critic.load_state_dict(part_of(state, "critic"))
        self._step.load_state_dict(part_of(state, "step"))
        self._filled = state["filled"]
        self._redundancy = state["redundancy"]
        self._has_coordinates = state["has_coordinates"]
        self._information = state["information"]
        self._moment = state["moment"]


class NominalModel:
    """The controller's nominal model with its slopes in the action.

    Args:
        scenario: names the model.
        start: θ, whose model parameters are taken where it has any.

    Raises:
        ModelError: the scenario names no model.
    """

    def __init__(self, scenario: Scenario, start: Parameters) -> None:
        problem = Problem.from_scenario(scenario)
        model = problem.model
        d = ca.DM(model.nominal_disturbance)
        p = ca.DM(start.of_model(model))
        x = ca.SX.sym("x", problem.n_states)
        u = ca.SX.sym("u", problem.n_actions)
        simulate = discretise(model, problem.sampling_time, problem.substeps)
        following = simulate(x, u, d, p)
        gain = ca.jacobian(following, u)
        cost = economic_cost(model)(x, u, d, p)
        hessian, gradient = ca.hessian(cost, u)
        results = [following, cost, gain, gradient, hessian]
        self._function = ca.Function("slopes", [x, u], results)

    def __call__(self, states: Matrix, actions: Matrix) -> ActionSlopes:
        """The model at states (K, n) and actions (K, m)."""
        # CasADi takes a sample a column, and puts the samples' matrices beside each other.
        following, cost, gain, gradient, hessian = self._function(states.T, actions.T)
        count = len(states)
        return ActionSlopes(
            following=following.full().T,
            cost=cost.full().reshape(-1),
            gain=_by_sample(gain, count),
            cost_gradient=gradient.full().T,
            cost_hessian=_by_sample(hessian, count),
        )


def _by_sample(beside: ca.DM, count: int) -> Vector:
    """The matrices (K, rows, m) of K samples that stand beside each other, (rows, Km)."""
    matrix = beside.full()
    rows = len(matrix)
    by_row: Vector = matrix.reshape(rows, count, -1)
    by_sample: Vector = by_row.transpose(1, 0, 2)
    return by_sample


class ExpectedPenalty:
    """The expected penalty mean_i p(f + e_i) with its slope and curvature in f.

    Args:
        penalty: its weights and bounds.
        errors: e, (M, n).
        variances: of estimates, (M, n), whose own normal errors add to e; None: of known states.
    """

    def __init__(
        self,
        penalty: Penalty,
        errors: Matrix,
        variances: Matrix | None = None,
    ) -> None:
        self._penalty = penalty
        self._errors = SortedErrors(errors)
        self._errors_of_estimates = errors
        self._variances = variances
        # Errors that are all the same leave a kink: a distance that is tiny beside them.
        largest = np.abs(errors).max(axis=0)
        least = 1e-6 * (1.0 + largest)
        distance = DIFFERENCE_SHARE * errors.std(axis=0)
        self._distance = np.maximum(distance, least)

    def _by_state(self, predictions: Matrix) -> Matrix:
        """Expected penalty of each state's bounds, (n, K)."""
        if self._variances is not None:
            return self._by_estimated_state(predictions, self._variances)
        by_bound = expected_penalties(self._penalty, predictions, self._errors)
        by_state: Matrix = by_bound.sum(axis=1)
        return by_state

    def _by_estimated_state(self, predictions: Matrix, variances: Matrix) -> Matrix:
        """The same of estimates with `variances` (M, n), (n, K)."""
        count, n = predictions.shape
        by_state = np.empty((n, count))
        for k, prediction in enumerate(predictions):
            means = prediction + self._errors_of_estimates
            of_bounds = normal_penalties(self._penalty, means, variances).mean(axis=1)
            by_state[:, k] = of_bounds[:n] + of_bounds[n:]
        return by_state

    def value(self, predictions: Matrix) -> Vector:
        """Expected penalty of predictions f (K, n), (K,)."""
        value: Vector = self._by_state(predictions).sum(axis=0)
        return value

    def slopes(self, predictions: Matrix) -> tuple[Matrix, Matrix]:
        """Central differences in each state, (K, n), and the diagonal second ones, (K, n, n)."""
        count, n = predictions.shape
        distance = self._distance
        above = self._by_state(predictions + distance)
        here = self._by_state(predictions)
        below = self._by_state(predictions - distance)
        rise = above - below
        slope = rise.T / (2.0 * distance)
        # The penalty is convex: less than nothing is rounding.
        bend = np.maximum(above + below - 2.0 * here, 0.0)
        second = bend.T / distance**2
        curvature = np.zeros((count, n, n))
        diagonal = range(n)
        curvature[:, diagonal, diagonal] = second
        return slope, curvature


class DifferentialValue:
    """W(s) = vᵀφ(s), quadratic: the differential value less the known penalty, by LSTD.

    E[φ(s) (r − g + E[W(s₊)] − W(s))] = 0. The mean cost per sample g takes the place of the
    constant feature, so the TD errors have the mean zero, and a level of the cost is without
    effect.

    Args:
        n_states: n.
    """

    def __init__(self, n_states: int) -> None:
        self._rows, self._columns = np.triu_indices(n_states)
        size = 1 + n_states + self._rows.size
        self._centre: Vector = np.zeros(n_states)
        self._spread: Vector = np.zeros(n_states)  # zero before the first batch
        self._matrix: Matrix = np.zeros((size, size))  # Σφ(φ − φ₊)ᵀ
        self._moment: Vector = np.zeros(size)  # Σφr
        self.weights: Vector = np.zeros(size)

    def fit(
        self,
        states: Matrix,
        following: Matrix,
        errors: Matrix,
        reward: Vector,
    ) -> Vector:
        """Take in a batch.

        Args:
            states: s, (K, n).
            following: predictions f of s₊, (K, n).
            errors: e, over which the next features are expected at f + e, (M, n).
            reward: r, (K,).

        Returns:
            The TD errors r − g + E[W(s₊)] − W(s), (K,).
        """
        if not self._spread.any():
            self._centre = states.mean(axis=0)
            spread = states.std(axis=0)
            self._spread = np.where(spread > 0, spread, 1.0)
        features = self._features(states)
        # The mean of z zᵀ is that of its mean, and the covariance.
        mean_error = errors.mean(axis=0)
        scaled = errors / self._spread
        covariance = np.cov(scaled.T, bias=True)
        covariance = np.atleast_2d(covariance)
        expected = self._features(following + mean_error)
        n_products = self._rows.size
        expected[:, -n_products:] += covariance[self._rows, self._columns]
        change = features - expected
        # The constant feature stands for the mean cost.
        change[:, 0] = 1.0
        self._matrix = self._matrix + features.T @ change
        self._moment = self._moment + features.T @ reward
        weights, *_ = np.linalg.lstsq(self._matrix, self._moment)
        self.weights = weights.astype(np.float64)
        td_errors: Vector = reward - change @ self.weights
        return td_errors

    @property
    def n_samples(self) -> float:
        """Samples that count, those that are partly forgotten by their share."""
        return float(self._matrix[0, 0])

    def forget(self, share: float) -> None:
        """Let what has been taken in so far count by this share."""
        self._matrix = share * self._matrix
        self._moment = share * self._moment

    def _features(self, states: Matrix) -> Matrix:
        """1, z_i and z_i z_j (i ≤ j) of z = (s − centre) / spread, (K, 1+n+n(n+1)/2)."""
        z = (states - self._centre) / self._spread
        products = z[:, self._rows] * z[:, self._columns]
        return np.hstack([_ones(z), z, products])

    def hessian(self) -> Matrix:
        """∇²W, (n, n)."""
        n = self._centre.size
        half = np.zeros((n, n))
        half[self._rows, self._columns] = self.weights[1 + n :]
        units = np.outer(self._spread, self._spread)
        hessian: Matrix = (half + half.T) / units
        return hessian

    def gradient(self, states: Matrix) -> Matrix:
        """∇W at states (K, n), (K, n)."""
        n = self._centre.size
        slopes = self.weights[1 : 1 + n]
        at_centre = slopes / self._spread
        distance = states - self._centre
        gradient: Matrix = at_centre + distance @ self.hessian()
        return gradient

    def state_dict(self) -> State:
        """The features' units, the sums and the weights."""
        return {
            "centre": self._centre,
            "spread": self._spread,
            "matrix": self._matrix,
            "moment": self._moment,
            "weights": self.weights,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._centre = state["centre"]
        self._spread = state["spread"]
        self._matrix = state["matrix"]
        self._moment = state["moment"]
        self.weights = state["weights"]


def _ones(rows: Matrix) -> Matrix:
    """The constant feature of these rows, (K, 1)."""
    return np.ones((len(rows), 1))


def trust_region_fit(
    gradient: Vector,
    hessian: Matrix,
    region: Matrix,
    radius: float,
) -> Fit:
    """Fit min_d gᵀd + dᵀ(H + μR)d/2 with the least μ ≥ 0 at which dᵀRd ≤ radius².

    That is min_d gᵀd + dᵀHd/2 in the trust region. Only what is too long for it is shortened: of a
    step that is scaled as a whole, a direction that J hardly curves in would leave nothing else. H
    counts as the nearest positive semidefinite matrix.

    Args:
        gradient: g, (n,).
        hessian: H, (n, n), symmetric.
        region: R, (n, n), positive definite.
        radius: of the trust region.
    """
    # Coordinates in which R is one and H diagonal: d = Vx, and x is a division.
    curvatures, vectors = eigh(hessian, region)
    curvatures = np.maximum(curvatures, 0.0)
    slopes = vectors.T @ gradient

    def excess(multiplier: float) -> float:
        step = slopes / (curvatures + multiplier)
        return float(np.linalg.norm(step)) - radius

    def length(step: Vector) -> float:
        return float(np.sqrt(step @ region @ step))

    # Where J has no curvature, only the region bounds the step, by this multiplier.
    steepest = float(np.linalg.norm(slopes)) / radius
    largest = max(float(curvatures.max()), steepest)
    multiplier = LEAST_MULTIPLIER * largest + np.finfo(float).tiny
    if excess(multiplier) > 0:
        multiplier = brentq(
            excess,
            multiplier,
            multiplier + steepest,
            rtol=LEAST_MULTIPLIER,
        )
    # The Hessian without its negative curvatures, back in θ's coordinates: V⁻ᵀ is R V.
    dual = region @ vectors
    weighted = dual * curvatures
    convex = weighted @ dual.T
    metric = convex + multiplier * region
    # α = 2 makes the metric H + μR that of dᵀ(H + μR)d/2.
    fit = policy_gradient_fit(gradient, 2.0, metric)
    return fit.within(radius, length)
