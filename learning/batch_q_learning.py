"""Batch Q-learning: every few samples, the buffer's transitions judged anew at the present θ."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import cho_factor, cho_solve

from cosim.scenario import Scenario
from learning.configuration import Configuration, Count, NonNegative, Positive
from learning.exploration import Strategy
from learning.fit import Fit, least_squares
from learning.level import level
from learning.protocols import LearnableController, Sample, Update
from learning.replay import ReplayBuffer, Replayed
from learning.step import ParameterStep

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class Trial(NamedTuple):
    """A step that the next replay judges: θ before it, and by transition `number` the target y,
    the squared error before it and the squared error that the fit promised.
    """

    theta: Vector
    number: NDArray[np.int64]
    target: Vector
    error: Vector
    predicted: Vector


class BatchQLearningConfiguration(Configuration):
    """Hyperparameters of batch Q-learning."""

    exploration_probability: float = Field(
        0.3, ge=0, le=1, description="share of samples that explore, at the start"
    )
    exploration_deviation: tuple[NonNegative, ...] = Field(
        (10.0,), description="standard deviation of e in the units of u, one or one per action"
    )
    rule: Literal["first-order", "gauss-newton", "lstdq"] = Field(
        "gauss-newton",
        description="normalised gradient; Gauss–Newton on Q's fit; or the projected Bellman error",
    )
    discount: float | None = Field(
        None, gt=0, le=1, description="of the TD error: the scenario's if not given; 1 is mean cost"
    )
    batch_size: Count = Field(500, description="samples between two updates")
    buffer_size: Count = Field(1000, description="transitions that are replayed, the latest ones")
    iterations: Count = Field(1, description="replays and steps of θ per update")
    gain: Positive = Field(0.5, le=1, description="share of the step taken, at the start")
    gain_end: Positive | None = Field(
        0.05, le=1, description="the same at the end, approached geometrically"
    )
    ridge: NonNegative = Field(
        1e-2, description="Levenberg–Marquardt term relative to each entry's information"
    )
    radius: Positive = Field(1.0, description="trust region: largest scaled entry of a step")
    radius_minimum: Positive = Field(
        0.01, description="size below which the trust region does not shrink"
    )


class BatchQLearning:
    """Q-learning on the TD errors of a replayed buffer (paper.tex, eq. q_learning_fitting).

    One iteration replays the buffer at θ, stands on the target y = ℓ + γV_θ(s₊), and steps
    towards min Σ (y − Q_θ̄)²; under `lstdq` towards the zero of Σ ∇Q δ, the target moving too. The
    next replay tells whether the errors to the old target fell as predicted: else the trust region
    is halved, and θ goes back where they rose.
    """

    Configuration: ClassVar[type[Configuration]] = BatchQLearningConfiguration

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: BatchQLearningConfiguration,
        samples: int,
        strategy: Strategy,
    ) -> None:
        self._controller, self._configuration = controller, configuration
        self._samples = samples
        self._moving = configuration.rule == "lstdq"
        self._step = ParameterStep(controller, configuration)
        self._level = level(configuration.discount, scenario, self._step)
        self._buffer = ReplayBuffer(configuration.buffer_size)
        self._radius = configuration.radius
        self._trial: Trial | None = None
        self.needs_action_value = False
        self.needs_points = True

    def observe(self, sample: Sample) -> Update | None:
        """Take one sample; the last of a batch moves θ."""
        self._buffer.add(sample)
        if (sample.number + 1) % self._configuration.batch_size:
            return None
        settings = self._configuration
        end = settings.gain if settings.gain_end is None else settings.gain_end
        gain = settings.gain * (end / settings.gain) ** min(sample.number / self._samples, 1.0)
        update: Update | None = None
        for _ in range(settings.iterations):
            replayed = self._buffer.replay(self._controller, self._level)
            if not len(replayed.number):
                return None
            if self._trial is not None and self._rose(self._trial, replayed):
                self._controller.theta = self._trial.theta
                replayed = self._buffer.replay(self._controller, self._level)
            update = self._iterate(replayed, gain)
        return update

    def _iterate(self, replayed: Replayed, gain: float) -> Update:
        gradient = replayed.gradient * self._step.scale
        jacobian = gradient
        if self._moving:
            jacobian = gradient - self._level.discount * replayed.next_gradient * self._step.scale
        fit = RULES[self._configuration.rule](
            gradient, jacobian, replayed.td_error, self._configuration.ridge
        )
        before = self._controller.theta
        fit = self._level.take(fit.shrunk(gain).clipped(self._radius))
        update = self._step.take(fit, float(np.sqrt(np.mean(replayed.td_error**2))))
        step = (self._controller.theta - before) / self._step.scale
        predicted = replayed.td_error - jacobian @ step
        self._trial = Trial(
            before, replayed.number, replayed.target, replayed.td_error**2, predicted**2
        )
        return update

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
            self._radius = max(self._radius / 2, self._configuration.radius_minimum)
        elif actual > 0.75 * promised:
            self._radius = min(self._radius * 2, self._configuration.radius)
        return actual < 0

    def state(self) -> dict[str, NDArray[Any]]:
        """The buffer, the trust region and the step that is still to be judged."""
        trial = {} if self._trial is None else self._trial._asdict()
        return {
            "radius": np.array(self._radius),
            "mean_cost": np.array(self._level.mean_cost),
            **{f"buffer_{name}": values for name, values in self._buffer.state().items()},
            **{f"trial_{name}": values for name, values in trial.items()},
        }

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._radius = float(state["radius"])
        self._level.mean_cost = float(state["mean_cost"])
        part = {
            prefix: {
                name.removeprefix(f"{prefix}_"): values
                for name, values in state.items()
                if name.startswith(f"{prefix}_")
            }
            for prefix in ("buffer", "trial")
        }
        self._buffer.restore(part["buffer"])
        self._trial = Trial(**part["trial"]) if part["trial"] else None


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
    information = gradient.T @ gradient
    diagonal = np.diag(information)
    floor = max(float(diagonal.max()), np.finfo(float).tiny) * 1e-8
    factor = cho_factor(information + np.diag(ridge * diagonal + floor))
    cross = gradient.T @ jacobian
    weighted = cho_solve(factor, cross)
    return least_squares(cross.T @ weighted, weighted.T @ (gradient.T @ td_error), ridge)


RULES: dict[str, Callable[[Matrix, Matrix, Vector, float], Fit]] = {
    "first-order": steepest_descent,
    "gauss-newton": gauss_newton,
    "lstdq": projected_bellman,
}
