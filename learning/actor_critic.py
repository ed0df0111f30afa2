"""Actor-critic: the deterministic policy gradient with a compatible advantage, batch by batch."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from pydantic import Field
from scipy.linalg import cho_factor, cho_solve

from cosim.protocols import Matrix, Vector
from learning.algorithm import Algorithm, Transition, Update
from learning.configuration import Configuration, Count, Positive
from learning.step import ConstrainedStep, policy_gradient_fit


class ActorCriticConfiguration(Configuration):
    """Hyperparameters of the actor-critic."""

    batch_size: Count = Field(1000, description="samples per step of θ, all at one θ")
    forgetting: float = Field(
        0.8, ge=0, lt=1, description="weight of a batch in the advantage, relative to the next one"
    )
    ridge: Positive = Field(
        1e-4, description="ridge of regression and metric, relative to the mean of their diagonals"
    )
    step_size: Positive = Field(0.08, description="α of the fit, before the trust region")
    radius: Positive = Field(
        0.4,
        description="trust region at the start: RMS change of the action, in the exploration's "
        "standard deviations",
    )
    radius_end: Positive = Field(
        0.04, description="trust region at the end, approached geometrically"
    )

    def narrowed(self, width: float) -> Self:
        """Copy whose trust region is `width` times as wide."""
        return self.model_copy(
            update={"radius": width * self.radius, "radius_end": width * self.radius_end}
        )


class ActorCritic(Algorithm):
    """Actor-critic: descends J along ∇J = E[∇π ∇πᵀ] w (paper.tex, eq. pg_update and pg_solution).

    θ stays for a batch. Then LSTDV fits the smooth part W of V = penalty + W, and LSTDQ the weights
    w of the advantage A(s, a) = (a − π(s) − bias)ᵀ ∇π(s)ᵀ w. `bias` is the exploration's mean under
    saturation. The policy is greedy in s₊, where A vanishes, so LSTDQ with V held is a regression
    of LSTDV's TD errors on ψ = (a − π(s) − bias)ᵀ ∇π(s)ᵀ. Each earlier batch counts `forgetting`
    times as much in it as the next one, which lowers the gradient's noise. The known penalty is
    moved to the next state, r = ℓ + γ·penalty(s₊), so that the critic meets no kink. Its discount γ
    is 1, that of the mean cost.
    """

    Configuration = ActorCriticConfiguration
    KEPT = ("_batch", "_information", "_moment", "_filled")
    configuration: ActorCriticConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings, scenario = self.configuration, self.scenario
        self._step = ConstrainedStep(self.controller, settings)
        # Actions are in units of the exploration's standard deviation.
        self._unit = np.broadcast_to(self.strategy.deviation, scenario.action_lower.shape)
        size, n, m = self._step.scale.size, scenario.state_lower.size, scenario.action_lower.size
        columns = [
            ("s", float, n), ("next_s", float, n), ("reward", float), ("policy", float, m),
            ("deviation", float, m), ("explored", bool), ("jacobian", float, (m, size)),
        ]  # fmt: skip
        self._batch = np.zeros(settings.batch_size, columns)
        self._information: Matrix = np.zeros((size, size))
        self._moment: Vector = np.zeros(size)
        self._filled = 0

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; the last of a batch moves θ."""
        policy, reward = transition.policy, transition.stage_cost + transition.next_penalty
        self._batch[self._filled] = (
            *(transition.s, transition.next_s, reward, policy.action),
            *(transition.a - policy.action, transition.explored, policy.policy_jacobian),
        )
        self._filled += 1
        if self._filled < self.configuration.batch_size:
            return None
        self._filled = 0
        return self._update(transition.number)

    def _deviation(self) -> Vector:
        """a − π(s) of the batch, (K, m), less its mean under saturation; zero in greedy samples."""
        explored = self._batch["explored"]
        bias = self.strategy.bias(self._batch["policy"][explored])
        deviation = np.where(explored[:, None], self._batch["deviation"], 0.0)
        deviation[explored] -= np.nan_to_num(bias)
        return deviation / self._unit

    def gradient(self) -> tuple[Vector, Matrix, Vector]:
        """∇J and E[∇π ∇πᵀ] in units of θ's scale, (n_θ,) and (n_θ, n_θ), of a full batch (K,).

        Also the TD errors, (K,). The batch counts in the advantage from there on.
        """
        batch, settings = self._batch, self.configuration
        errors = lstdv(*(batch[name].copy() for name in ("s", "next_s", "reward")))
        jacobian = batch["jacobian"] * self._step.scale / self._unit[:, None]
        psi = np.einsum("kmi,km->ki", jacobian, self._deviation())
        self._information = settings.forgetting * self._information + psi.T @ psi
        self._moment = settings.forgetting * self._moment + psi.T @ errors
        fisher = np.einsum("kmi,kmj->ij", jacobian, jacobian) / len(errors)
        weights = regression(self._information, self._moment, settings.ridge)
        return fisher @ weights, fisher, errors

    def _update(self, number: int) -> Update:
        settings = self.configuration
        gradient, fisher, errors = self.gradient()
        floor = settings.ridge * float(fisher.trace()) / gradient.size
        metric = fisher + (floor + np.finfo(float).tiny) * np.eye(gradient.size)
        fit = policy_gradient_fit(gradient, settings.step_size, metric)
        # A step without effect on the policy has no length here, and is not taken.
        if not fit.minimiser @ fisher @ fit.minimiser > 0:
            fit = fit.shrunk(0.0)
        # The radius changes from the first to the last by equal ratios.
        share = min(number / self.samples, 1.0)
        radius = settings.radius * (settings.radius_end / settings.radius) ** share
        fit = fit.within(radius, lambda d: max(float(d @ fisher @ d), 0.0) ** 0.5)
        return self._step.take(fit, float(np.sqrt(np.mean(errors * errors))))


def quadratic_features(states: Matrix, centre: Vector, spread: Vector) -> Matrix:
    """1, z_i and z_i z_j (i ≤ j) of z = (s − centre) / spread; (K, n) → (K, 1+n+n(n+1)/2)."""
    z = (states - centre) / spread
    rows, columns = np.triu_indices(states.shape[1])
    return np.hstack([np.ones((len(z), 1)), z, z[:, rows] * z[:, columns]])


def lstdv(states: Matrix, next_states: Matrix, reward: Vector) -> Vector:
    """TD errors of the quadratic value function that LSTD fits to transitions, (K,).

    W(s) = vᵀφ(s) with E[φ (r − g + W(s₊) − W(s))] = 0, the differential value: the mean cost per
    sample g takes the place of the constant feature.
    """
    centre, spread = states.mean(axis=0), states.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    features = quadratic_features(states, centre, spread)
    change = features - quadratic_features(next_states, centre, spread)
    change[:, 0] = 1.0
    weights = np.linalg.lstsq(features.T @ change, features.T @ reward)[0]
    errors: Vector = reward - change @ weights
    return errors


def regression(information: Matrix, moment: Vector, ridge: float) -> Vector:
    """Weights (n,) of Σψψᵀ and Σψδ; the ridge is relative to the mean of the first's diagonal."""
    floor = max(float(np.trace(information)), np.finfo(float).tiny) / moment.size
    factor = cho_factor(information + ridge * floor * np.eye(moment.size))
    weights: Vector = cho_solve(factor, moment)
    return weights
