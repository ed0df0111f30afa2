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
from cosim.core.scenario import Penalty, Positive, Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Configuration, Count, ExplorationProbability
from learning.errors import DivergenceError
from learning.prediction_errors import PredictionErrors, SortedErrors, expected_penalties
from learning.q_learning import ValueConfiguration, prior_deviation
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
        description="prediction errors over which the next value is expected",
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
        gain: ∂f/∂a, (K, n, m).
        cost_gradient: ∂ℓ/∂a, (K, m).
        cost_hessian: ∂²ℓ/∂a², (K, m, m).
    """

    following: Matrix
    gain: Matrix
    cost_gradient: Matrix
    cost_hessian: Matrix


class ActorCritic(Algorithm):
    """Actor-critic: descends the mean cost J along ∇J = E[∇π ∇_a Q] (paper.tex, eq. pg_update).

    θ stays for a batch. Then LSTD fits the smooth part W of the differential value V = p + W. The
    slope of Q is that of the nominal model with the next value in expectation, plus an advantage
    that is compatible with the policy and is fitted to the TD errors of the samples that explore:

        Q(s, a) = ℓ(s, a) + mean_i V(f(s, a) + e_i) + (a − π(s))ᵀ ∇π(s)ᵀ w

    with f and ℓ the controller's nominal model and e_i its latest prediction errors. w has a prior,
    so that it corrects the model where the samples say so. The step is that of Gauss and Newton
    with the Hessian E[∇π ∇²_a Q ∇πᵀ] (Brandner, Gros and Lucia, arXiv 2508.02441) in a trust
    region, which bounds the change of the action (docs/method.md).
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
        self._batch: dict[str, Any] = {
            "s": np.zeros((size, n)),
            "next_s": np.zeros((size, n)),
            "cost": np.zeros(size),
            "a": np.zeros((size, m)),
            "policy": np.zeros((size, m)),
            "explored": np.zeros(size, bool),
            "jacobian": np.zeros((size, m, n_theta)),
        }
        self._filled = 0  # rows of the open batch
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
        gradient, hessian, metric, errors = self.gradient()
        # A step of length one is as long as the trust region allows, before it shrinks.
        region = metric / settings.radius**2 + np.eye(len(metric)) / settings.largest_step**2
        radius = min(1.0, settings.decay_after / (number + 1))
        fit = trust_region_fit(gradient, hessian, region, radius)
        before = self.controller.theta
        error_size = float(np.sqrt(np.mean(errors * errors)))
        update = self._step.apply(fit, error_size)
        step = (self.controller.theta - before) / self._step.scale
        # What was seen of another policy says less of this one.
        length = min(float(step @ region @ step) ** 0.5, 1.0)
        self._critic.forget(settings.forgetting * (1.0 - length))
        return update

    def gradient(self) -> tuple[Vector, Matrix, Matrix, Vector]:
        """The policy gradient of a full batch, which counts in the critic from there on.

        Returns:
            ∇J (n_θ,), the Gauss–Newton Hessian E[∇π ∇²_a Q ∇πᵀ] and the metric E[∇π ∇πᵀ] (n_θ, n_θ)
            in θ's prior deviations and the actions' ranges, and the TD errors, (K,).
        """
        batch = self._batch
        states = batch["s"]
        deviation = self._deviation()
        # Errors of the nominal model at the actions that were applied.
        applied = self._model(states, batch["a"])
        prediction_errors = batch["next_s"] - applied.following
        if not self._has_coordinates:
            self._begin(states, prediction_errors)
        at_policy = self._model(states, batch["policy"])
        following = at_policy.following
        # An advantage that corrects the model needs a critic of the plant, not of the model.
        if self.strategy.probability > 0:
            systematic = linear_part(states, prediction_errors)
            following = following + systematic
            prediction_errors = prediction_errors - systematic
        for error in prediction_errors:
            self._errors.add(error)

        # The critic: the cost of the policy's action, and what is expected after it.
        errors = self._errors.values
        penalty = ExpectedPenalty(self.scenario.state_penalty, errors)
        greedy_cost = batch["cost"] - np.einsum("km,km->k", at_policy.cost_gradient, deviation)
        reward = greedy_cost + penalty.value(following)
        if not np.isfinite(reward).all():
            raise DivergenceError("the costs or the predictions are not finite")
        td_errors = self._critic.fit(states, following, errors, reward)

        # Slope and curvature of the expected next value, in the state and then in the action.
        penalty_slope, penalty_curvature = penalty.slopes(following)
        mean_error = errors.mean(axis=0)
        slope = penalty_slope + self._critic.gradient(following + mean_error)
        curvature = penalty_curvature + self._critic.hessian()
        gain = at_policy.gain * self._range
        cost_slope = at_policy.cost_gradient * self._range
        value_slope = np.einsum("knm,kn->km", gain, slope)
        cost_curvature = at_policy.cost_hessian * np.outer(self._range, self._range)
        value_curvature = np.einsum("kni,knl,klj->kij", gain, curvature, gain)

        # The chain rule through the policy.
        jacobian = batch["jacobian"] * self._step.scale / self._range[:, None]
        count = len(states)
        metric = np.einsum("kmi,kmj->ij", jacobian, jacobian) / count
        gradient = np.einsum("kmi,km->i", jacobian, cost_slope + value_slope) / count
        action_curvature = cost_curvature + value_curvature
        hessian = np.einsum("kmi,kmn,knj->ij", jacobian, action_curvature, jacobian) / count

        # What realised costs and next states say of the slope beyond the model.
        innovation = np.einsum("kn,kn->k", slope, prediction_errors - mean_error)
        terms = np.mean(np.sum(cost_slope**2 + value_slope**2, axis=1))
        features = np.einsum("kmi,km->ki", jacobian, deviation / self._range)
        weights = self._advantage(features, td_errors + innovation, metric, float(terms))
        return gradient + metric @ weights, hessian, metric, td_errors

    def _begin(self, states: Matrix, errors: Matrix) -> None:
        """Take the coordinates from the first batch: deviations of θ that have no unit."""
        settings = self.configuration
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
        explored = self._batch["explored"]
        # At an actuator's bound the noise has a mean, which is no slope of the cost.
        bias = self.strategy.bias(self._batch["policy"][explored])
        deviation = np.where(explored[:, None], self._batch["a"] - self._batch["policy"], 0.0)
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
        noise = float(np.mean(td_errors**2)) + np.finfo(float).tiny
        information = features.T @ features / noise
        moment = features.T @ td_errors / noise
        self._information = settings.forgetting * self._information + information
        self._moment = settings.forgetting * self._moment + moment
        # E|∇πᵀw|² = τ² tr E[∇π ∇πᵀ] is a share of what the model's slope is made of.
        variance = settings.advantage_width**2 * terms / max(metric.trace(), np.finfo(float).tiny)
        scaled = variance * self._information + np.eye(self._moment.size)
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
        following = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
        cost = economic_cost(model)(x, u, d, p)
        hessian, gradient = ca.hessian(cost, u)
        self._function = ca.Function(
            "slopes", [x, u], [following, ca.jacobian(following, u), gradient, hessian]
        )

    def __call__(self, states: Matrix, actions: Matrix) -> ActionSlopes:
        """The model at states (K, n) and actions (K, m)."""
        count, n = states.shape
        m = actions.shape[1]
        # CasADi takes a sample a column, and puts the samples' matrices beside each other.
        following, gain, gradient, hessian = self._function(states.T, actions.T)
        return ActionSlopes(
            following=following.full().T,
            gain=gain.full().reshape(n, count, m).transpose(1, 0, 2),
            cost_gradient=gradient.full().T,
            cost_hessian=hessian.full().reshape(m, count, m).transpose(1, 0, 2),
        )


class ExpectedPenalty:
    """The expected penalty mean_i p(f + e_i) with its slope and curvature in f.

    Args:
        penalty: its weights and bounds.
        errors: e, (M, n).
    """

    def __init__(self, penalty: Penalty, errors: Matrix) -> None:
        self._penalty = penalty
        self._errors = SortedErrors(errors)
        # Errors that are all the same leave a kink: a distance that is tiny beside them.
        least = 1e-6 * (1.0 + np.abs(errors).max(axis=0))
        self._distance = np.maximum(DIFFERENCE_SHARE * errors.std(axis=0), least)

    def _by_state(self, predictions: Matrix) -> Matrix:
        """Expected penalty of each state's bounds, (n, K)."""
        by_bound = expected_penalties(self._penalty, predictions, self._errors)
        by_state: Matrix = by_bound.sum(axis=1)
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
        slope = (above - below).T / (2.0 * distance)
        # The penalty is convex: less than nothing is rounding.
        second = np.maximum(above + below - 2.0 * here, 0.0).T / distance**2
        curvature = np.zeros((count, n, n))
        curvature[:, range(n), range(n)] = second
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
        scaled = errors / self._spread
        covariance = np.atleast_2d(np.cov(scaled.T, bias=True))
        expected = self._features(following + errors.mean(axis=0))
        expected[:, -self._rows.size :] += covariance[self._rows, self._columns]
        change = features - expected
        # The constant feature stands for the mean cost.
        change[:, 0] = 1.0
        self._matrix = self._matrix + features.T @ change
        self._moment = self._moment + features.T @ reward
        weights: Vector = np.linalg.lstsq(self._matrix, self._moment)[0].astype(np.float64)
        self.weights = weights
        td_errors: Vector = reward - change @ self.weights
        return td_errors

    def forget(self, share: float) -> None:
        """Let what has been taken in so far count by this share."""
        self._matrix = share * self._matrix
        self._moment = share * self._moment

    def _features(self, states: Matrix) -> Matrix:
        """1, z_i and z_i z_j (i ≤ j) of z = (s − centre) / spread, (K, 1+n+n(n+1)/2)."""
        z = (states - self._centre) / self._spread
        products = z[:, self._rows] * z[:, self._columns]
        return np.hstack([np.ones((len(z), 1)), z, products])

    def hessian(self) -> Matrix:
        """∇²W, (n, n)."""
        n = self._centre.size
        scaled = np.zeros((n, n))
        scaled[self._rows, self._columns] = self.weights[1 + n :]
        hessian: Matrix = (scaled + scaled.T) / np.outer(self._spread, self._spread)
        return hessian

    def gradient(self, states: Matrix) -> Matrix:
        """∇W at states (K, n), (K, n)."""
        n = self._centre.size
        at_centre = self.weights[1 : 1 + n] / self._spread
        gradient: Matrix = at_centre + (states - self._centre) @ self.hessian()
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


def linear_part(states: Matrix, errors: Matrix) -> Matrix:
    """The part of errors (K, n) that is affine in the states (K, n), by least squares, (K, n)."""
    spread = states.std(axis=0)
    z = (states - states.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    features = np.hstack([np.ones((len(z), 1)), z])
    part: Matrix = features @ np.linalg.lstsq(features, errors)[0]
    return part


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
        return float(np.linalg.norm(slopes / (curvatures + multiplier))) - radius

    def length(step: Vector) -> float:
        return float(np.sqrt(step @ region @ step))

    # Where J has no curvature, only the region bounds the step, by this multiplier.
    steepest = float(np.linalg.norm(slopes)) / radius
    multiplier = LEAST_MULTIPLIER * max(float(curvatures.max()), steepest) + np.finfo(float).tiny
    if excess(multiplier) > 0:
        multiplier = brentq(excess, multiplier, multiplier + steepest, rtol=LEAST_MULTIPLIER)
    dual = region @ vectors
    convex = (dual * curvatures) @ dual.T
    # α = 2 makes the metric H + μR that of dᵀ(H + μR)d/2.
    fit = policy_gradient_fit(gradient, 2.0, convex + multiplier * region)
    return fit.within(radius, length)
