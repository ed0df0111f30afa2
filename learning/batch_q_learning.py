"""Batch Q-learning: every few samples, the buffer's transitions judged anew at the present θ."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from cosim.scenario import Scenario
from learning.average_cost import AverageCost
from learning.batch_configuration import BatchQLearningConfiguration
from learning.checkpoint import group, prefixed
from learning.configuration import Configuration
from learning.constrained_step import ConstrainedStep
from learning.exploration import Strategy
from learning.fit import Fit, damped, least_squares
from learning.globalised import GlobalisedLearning
from learning.iterated_kalman import IteratedKalman
from learning.protocols import LearnableController, Rule, Transition, Update
from learning.replay import ReplayBuffer, Replayed

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Trial(NamedTuple):
    """A step that the next replay judges.

    `theta` and `mean_cost` were before it; by transition `number`, (K,) each: the `target` y, the
    squared `error` before the step and the one that the fit `predicted`.
    """

    theta: Vector
    mean_cost: Vector
    number: NDArray[np.int64]
    target: Vector
    error: Vector
    predicted: Vector


class ReplayedQLearning:
    """Q-learning on the TD errors of a replayed buffer (paper.tex, eq. q_learning_fitting).

    One iteration replays the buffer at θ, stands on the target y = ℓ + γV_θ(s₊), and steps
    towards min Σ (y − Q_θ̄)²; under `lstdq` towards the zero of Σ ∇Q δ, the target moving too. The
    next replay tells whether the errors fell as predicted: else the trust region is halved, and
    where they rose θ goes back, the mean cost g too.
    """

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: BatchQLearningConfiguration,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
        *,
        width: float = 1.0,
    ) -> None:
        self._controller, self._configuration = controller, configuration
        self._gain = configuration.gains(samples)
        self._moving = configuration.rule == "lstdq"
        self._step = ConstrainedStep(controller, configuration)
        self._average_cost = AverageCost.of(configuration.discount, scenario, self._step)
        self._buffer = ReplayBuffer(self._controller, configuration.buffer_size)
        self._largest = configuration.radius * width
        self._radius = self._largest
        self._trial: Trial | None = None
        self.needs_action_value = False
        self.needs_points = True

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; the last of a batch moves θ."""
        self._buffer.add(transition)
        if (transition.number + 1) % self._configuration.batch_size:
            return None
        update: Update | None = None
        for _ in range(self._configuration.iterations):
            replayed = self._buffer.replay(self._average_cost)
            if self._trial is not None and self._rose(self._trial, replayed):
                self._controller.theta = self._trial.theta
                self._average_cost.mean_cost = float(self._trial.mean_cost)
                replayed = self._buffer.replay(self._average_cost)
            if not len(replayed.number):
                break
            update = self._iterate(replayed, self._gain(transition.number))
        return update

    def _iterate(self, replayed: Replayed, gain: float) -> Update:
        gradient = replayed.gradient * self._step.scale
        change = gradient
        if self._moving:
            change = (
                gradient - self._average_cost.discount * replayed.next_gradient * self._step.scale
            )
        fit = RULES[self._configuration.rule](
            gradient,
            self._average_cost.descent(change),
            replayed.td_error,
            self._configuration.ridge,
        )
        theta, mean_cost = self._controller.theta, np.array(self._average_cost.mean_cost)
        fit = self._average_cost.take(fit.shrunk(gain).clipped(self._radius))
        update = self._step.take(fit, float(np.sqrt(np.mean(replayed.td_error**2))))
        predicted = replayed.td_error - change @ (
            (self._controller.theta - theta) / self._step.scale
        )
        if self._moving:
            predicted -= self._average_cost.mean_cost - mean_cost
        self._trial = Trial(
            theta, mean_cost, replayed.number, replayed.target, replayed.td_error**2, predicted**2
        )
        return update._replace(failures=replayed.failures)

    def _rose(self, trial: Trial, replayed: Replayed) -> bool:
        """Whether the last step raised the errors it was to lower; adapts the trust region."""
        _, old, new = np.intersect1d(
            trial.number, replayed.number, assume_unique=True, return_indices=True
        )
        if not len(old):
            return False
        target = replayed.target[new] if self._moving else trial.target[old]
        start = float(trial.error[old].sum())
        actual = start - float(((target - replayed.action_value[new]) ** 2).sum())
        promised = start - float(trial.predicted[old].sum())
        if actual < 0.25 * promised:
            self._radius = max(
                self._radius / 2, min(self._configuration.radius_minimum, self._largest)
            )
        elif actual > 0.75 * promised:
            self._radius = min(self._radius * 2, self._largest)
        return actual < 0

    def state(self) -> dict[str, NDArray[Any]]:
        """The buffer, the trust region and the step that is still to be judged."""
        trial = {} if self._trial is None else self._trial._asdict()
        return {
            "radius": np.array(self._radius),
            "mean_cost": np.array(self._average_cost.mean_cost),
            **prefixed("buffer_", self._buffer.state()),
            **{f"trial_{name}": np.asarray(value) for name, value in trial.items()},
        }

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._radius = float(state["radius"])
        self._average_cost.mean_cost = float(state["mean_cost"])
        self._buffer.restore(group(state, "buffer_"))
        trial = group(state, "trial_")
        self._trial = Trial(*(trial[name] for name in Trial._fields)) if trial else None


class BatchQLearning(GlobalisedLearning):
    """`IteratedKalman` or `ReplayedQLearning`, globalised unless the configuration says not."""

    Configuration: ClassVar[type[Configuration]] = BatchQLearningConfiguration

    def rule(self, samples: int, width: float) -> Rule:
        """The replaying rule, its prior or trust region `width` times as wide."""
        if self._configuration.rule == "kalman":
            return IteratedKalman(
                self._controller, self._scenario, self._configuration, width=width
            )
        return ReplayedQLearning(
            self._controller,
            self._scenario,
            self._configuration,
            samples,
            self._strategy,
            self._rng,
            width=width,
        )


def steepest_descent(gradient: Matrix, jacobian: Matrix, td_error: Vector, ridge: float) -> Fit:
    """First order: along b = Gᵀδ to the minimum of ‖δ − G d‖² on that line, (1+ρ) damped."""
    slope = gradient.T @ td_error
    along = gradient @ slope
    curvature = (1 + ridge) * float(along @ along) / max(float(slope @ slope), np.finfo(float).tiny)
    curvature = max(curvature, np.finfo(float).tiny)
    return Fit(slope, slope / curvature, lambda: curvature * np.eye(slope.size))


def gauss_newton(gradient: Matrix, jacobian: Matrix, td_error: Vector, ridge: float) -> Fit:
    """Second order: min ‖δ − G d‖², the target held."""
    return least_squares(gradient.T @ gradient, gradient.T @ td_error, ridge)


def projected_bellman(gradient: Matrix, jacobian: Matrix, td_error: Vector, ridge: float) -> Fit:
    """LSTDQ: zero of Gᵀ(δ − E d), E = ∇Q − γ∇V₊, as min of its norm in (GᵀG)⁻¹ (MSPBE)."""
    factor = cho_factor(damped(gradient.T @ gradient, ridge))
    cross = gradient.T @ jacobian
    weighted = cho_solve(factor, cross)
    return least_squares(cross.T @ weighted, weighted.T @ (gradient.T @ td_error), ridge)


RULES: dict[str, Callable[[Matrix, Matrix, Vector, float], Fit]] = {
    "first-order": steepest_descent,
    "gauss-newton": gauss_newton,
    "lstdq": projected_bellman,
}
