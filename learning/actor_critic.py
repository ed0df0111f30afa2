"""Actor-critic: the deterministic policy gradient with a compatible advantage, batch by batch."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field
from scipy.linalg import cho_factor, cho_solve

from cosim.core.protocols import Matrix, Vector
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Configuration, Count, Positive
from learning.step import ConstrainedStep, policy_gradient_fit


class ActorCriticConfiguration(Configuration):
    """Hyperparameters of the actor-critic."""

    batch_size: Count = Field(1000, description="samples per step of θ, all at one θ")
    forgetting: float = Field(
        0.8,
        ge=0,
        lt=1,
        description="weight of a batch in the advantage, relative to the next one",
    )
    ridge: Positive = Field(
        1e-4,
        description="ridge of regression and metric, relative to the mean of their diagonals",
    )
    step_size: Positive = Field(0.08, description="α of the fit, before the trust region")
    radius: Positive = Field(
        0.4,
        description="trust region at the start: RMS change of the action, in the exploration's "
        "standard deviations",
    )
    radius_end: Positive = Field(
        0.04,
        description="trust region at the end, approached geometrically",
    )


class ActorCritic(Algorithm):
    """Actor-critic: descends J along ∇J = E[∇π ∇πᵀ] w (paper.tex, eq. pg_update and pg_solution).

    θ stays for a batch. Then LSTDV fits the smooth part W of V = penalty + W, and LSTDQ the weights
    w of the advantage A(s, a) = (a − π(s) − bias)ᵀ ∇π(s)ᵀ w. `bias` is the exploration's mean under
    saturation. The policy is greedy in s₊, where A vanishes, so LSTDQ with V fixed is a regression
    of LSTDV's TD errors on ψ = (a − π(s) − bias)ᵀ ∇π(s)ᵀ. Each earlier batch counts `forgetting`
    times as much in it as the next one, which lowers the gradient's noise. The known penalty is
    moved to the next state, r = ℓ + γ·penalty(s₊), so that the critic meets no kink. Its discount γ
    is 1, that of the mean cost.
    """

    learns_from_estimates = True

    Configuration = ActorCriticConfiguration
    configuration: ActorCriticConfiguration

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._step = ConstrainedStep(self.controller, self.configuration)
        n = self.scenario.state_lower.size
        m = self.scenario.action_lower.size
        n_theta = self._step.scale.size
        # Actions are in units of the exploration's standard deviation.
        self._unit = np.broadcast_to(self.strategy.deviation, (m,))
        size = self.configuration.batch_size
        self._batch: dict[str, Any] = {
            "s": np.zeros((size, n)),
            "next_s": np.zeros((size, n)),
            "reward": np.zeros(size),
            "policy": np.zeros((size, m)),
            "deviation": np.zeros((size, m)),
            "explored": np.zeros(size, bool),
            "jacobian": np.zeros((size, m, n_theta)),
        }
        self._filled = 0  # rows of the open batch
        self._information: Matrix = np.zeros((n_theta, n_theta))  # Σψψᵀ, with forgetting
        self._moment: Vector = np.zeros(n_theta)  # Σψδ

    def observe(self, transition: Transition) -> Update | None:
        """Learn from one sample; the last of a batch moves θ."""
        batch = self._batch
        row = self._filled
        solution = transition.solution
        batch["s"][row] = transition.s
        batch["next_s"][row] = transition.next_s
        batch["reward"][row] = transition.stage_cost + transition.next_penalty
        batch["policy"][row] = solution.action
        batch["deviation"][row] = transition.a - solution.action
        batch["explored"][row] = transition.explored
        batch["jacobian"][row] = solution.policy_jacobian
        self._filled += 1
        if self._filled < self.configuration.batch_size:
            return None
        # All rows are overwritten by the next batch.
        self._filled = 0
        return self._update(transition.number)

    def _deviation(self) -> Vector:
        """a − π(s) of the batch, (K, m), less its mean under saturation; zero in greedy samples."""
        explored = self._batch["explored"]
        # At an actuator's bound the noise has a mean, which is no slope of the cost.
        bias = self.strategy.bias(self._batch["policy"][explored])
        deviation = np.where(explored[:, None], self._batch["deviation"], 0.0)
        deviation[explored] -= np.nan_to_num(bias)
        return deviation / self._unit

    def gradient(self) -> tuple[Vector, Matrix, Vector]:
        """The policy gradient of a full batch, which counts in the advantage from there on.

        Returns:
            ∇J (n_θ,) and E[∇π ∇πᵀ] (n_θ, n_θ) in units of θ's scale, and the TD errors, (K,).
        """
        batch = self._batch
        settings = self.configuration
        # The critic first: its TD errors are what the advantage explains.
        errors = lstdv(batch["s"], batch["next_s"], batch["reward"])
        jacobian = batch["jacobian"] * self._step.scale / self._unit[:, None]
        # Features of the compatible advantage, (a − π)ᵀ∇πᵀ.
        psi = np.einsum("kmi,km->ki", jacobian, self._deviation())
        older_information = settings.forgetting * self._information
        older_moment = settings.forgetting * self._moment
        self._information = older_information + psi.T @ psi
        self._moment = older_moment + psi.T @ errors
        # The natural metric: how far a step of θ moves the policy.
        fisher = np.einsum("kmi,kmj->ij", jacobian, jacobian) / len(errors)
        weights = regression(self._information, self._moment, settings.ridge)
        return fisher @ weights, fisher, errors

    def _update(self, number: int) -> Update:
        """The constrained step along −∇J, in a trust region; `number` is the sample's."""
        settings = self.configuration
        gradient, fisher, errors = self.gradient()
        # θ has directions in which the policy does not move.
        floor = settings.ridge * float(fisher.trace()) / gradient.size
        ridge = (floor + np.finfo(float).tiny) * np.eye(gradient.size)
        metric = fisher + ridge
        fit = policy_gradient_fit(gradient, settings.step_size, metric)
        # A step without effect on the policy has no length here, and is not taken.
        change = fit.minimiser @ fisher @ fit.minimiser
        if not change > 0:
            fit = fit.shrunk(0.0)

        def change_of_action(d: Vector) -> float:
            length: float = max(float(d @ fisher @ d), 0.0) ** 0.5
            return length

        # The radius changes from the first to the last by equal ratios.
        share = min(number / self.samples, 1.0)
        ratio = settings.radius_end / settings.radius
        radius = settings.radius * ratio**share
        fit = fit.within(radius, change_of_action)
        error_size = float(np.sqrt(np.mean(errors * errors)))
        return self._step.apply(fit, error_size)

    def state_dict(self) -> State:
        """The open batch, and what earlier batches say of the advantage."""
        return {
            **prefixed("batch", self._batch),
            "filled": self._filled,
            "information": self._information,
            "moment": self._moment,
        }

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned."""
        self._batch = part_of(state, "batch")
        self._filled = state["filled"]
        self._information = state["information"]
        self._moment = state["moment"]


def quadratic_features(
    states: Matrix,
    centre: Vector,
    spread: Vector,
) -> Matrix:
    """1, z_i and z_i z_j (i ≤ j) of z = (s − centre) / spread.

    Args:
        states: s, (K, n).
        centre: (n,).
        spread: (n,).

    Returns:
        Features, (K, 1+n+n(n+1)/2).
    """
    z = (states - centre) / spread
    rows, columns = np.triu_indices(states.shape[1])
    constant = np.ones((len(z), 1))
    products = z[:, rows] * z[:, columns]
    return np.hstack([constant, z, products])


def lstdv(
    states: Matrix,
    next_states: Matrix,
    reward: Vector,
) -> Vector:
    """TD errors of the quadratic value function that LSTD fits to transitions.

    W(s) = vᵀφ(s) with E[φ (r − g + W(s₊) − W(s))] = 0, the differential value: the mean cost per
    sample g takes the place of the constant feature.

    Args:
        states: s, (K, n).
        next_states: s₊, (K, n).
        reward: r, (K,).

    Returns:
        The errors, (K,).
    """
    centre = states.mean(axis=0)
    spread = states.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    features = quadratic_features(states, centre, spread)
    # The differential value: features of s less those of s₊.
    change = features - quadratic_features(next_states, centre, spread)
    # The constant feature stands for the mean cost.
    change[:, 0] = 1.0
    weights = np.linalg.lstsq(features.T @ change, features.T @ reward)[0]
    errors: Vector = reward - change @ weights
    return errors


def regression(
    information: Matrix,
    moment: Vector,
    ridge: float,
) -> Vector:
    """Weights of a ridge regression.

    Args:
        information: Σψψᵀ, (n, n).
        moment: Σψδ, (n,).
        ridge: relative to the mean of the information's diagonal.

    Returns:
        The weights, (n,).
    """
    trace = max(float(np.trace(information)), np.finfo(float).tiny)
    floor = trace / moment.size
    factor = cho_factor(information + ridge * floor * np.eye(moment.size))
    weights: Vector = cho_solve(factor, moment)
    return weights
