"""Online Q-learning: θ steps as the transitions come, each with the present θ's Q and V."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from controllers.theta import Parameters
from cosim.protocols import Matrix, Vector
from cosim.scenario import Scenario
from learning.algorithm import Algorithm, Transition, Update
from learning.configuration import (
    Configuration,
    Count,
    ExplorationProbability,
    ExplorationShare,
    NonNegative,
    Positive,
)
from learning.errors import DivergenceError
from learning.prediction_errors import OneStepModel, PredictionErrors
from learning.step import ConstrainedStep, Fit, prior_deviation, td_fit, td_step

Values = TypeVar("Values", float, NDArray[np.float64])
OUTLIER = 25.0
"""Squares of innovations beyond this many variances count as this many."""


class ValueConfiguration(Configuration):
    """Hyperparameters that Q-learning has online and in batches."""

    exploration_probability: ExplorationProbability = 0.3
    exploration_share: ExplorationShare = 1 / 30
    discount: float | None = Field(
        None,
        gt=0,
        le=1,
        description="discount of the TD error; if not given, 1 (the mean cost, which no sampling "
        "time alters), and the scenario's for the rules td and fit",
    )
    prior_width: Positive = Field(
        0.15, description="how far θ may be from its start, as a share of the start's cost"
    )
    measure_offset: bool = Field(
        True,
        description="c_f becomes the mean of the first prediction errors; false: it starts as it "
        "is, for a start that has learnt its offset",
    )
    innovation_clip: Positive = Field(
        3.0, description="innovations are cut at this many standard deviations"
    )
    variance_memory: Positive = Field(
        2000.0, description="samples over which the innovations' variance is taken"
    )
    prediction_errors: Count = Field(
        1000, description="prediction errors over which the next penalty is expected"
    )
    largest_step: NonNegative = Field(
        1.0, description="prior deviations by which a step may move an entry of θ; 0: no limit"
    )

    def criterion(self, scenario: Scenario) -> tuple[float, float]:
        """Discount of the TD error, and time constants over which the mean cost follows δ.

        With 0 the mean cost is fitted with θ.
        """
        return self.discount or 1.0, 0.0

    def narrowed(self, width: float) -> Self:
        """Copy whose prior is `width` times as wide."""
        return self.model_copy(update={"prior_width": width * self.prior_width})


class QLearningConfiguration(ValueConfiguration):
    """Hyperparameters of online Q-learning."""

    rule: Literal["kalman", "td", "fit"] = Field(
        "kalman", description="Kalman filter with a prior on θ; αδ∇Q; or the fit's αδ∇Q/(1+α‖∇Q‖²)"
    )
    prior_samples: Count = Field(
        500, description="first samples, at which θ rests: they give noise and widths"
    )
    step_every: Count = Field(50, description="samples per step of θ")
    variance_memory: Positive = Field(
        200.0, description="samples over which the innovations' variance is taken"
    )
    mean_cost_memory: NonNegative = Field(
        1.625,
        description="time over which the mean cost follows δ, in slowest time constants of the "
        "nominal model; 0: the mean cost is fitted with θ",
    )
    parameter_drift: NonNegative = Field(
        0.0,
        description="variance that each sample adds to θ, in units of the prior's, so that "
        "learning goes on where the plant changes",
    )
    step_size: Positive = Field(1e-3, description="rules td and fit: α")
    scaled: bool = Field(
        True, description="rules td and fit: step in coordinates θ/scale, else in θ itself"
    )

    def criterion(self, scenario: Scenario) -> tuple[float, float]:
        """As without this; δ of the rules td and fit has the scenario's discount."""
        if self.rule != "kalman":
            return self.discount or scenario.discount, 0.0
        return self.discount or 1.0, self.mean_cost_memory

    def without_part(self) -> Mapping[str, str]:
        """Hyperparameters of other rules than the chosen one."""
        if self.rule == "kalman":
            names = ["step_size", "scaled"]
        else:
            names = ["prior_width", "prior_samples", "measure_offset", "step_every"]
            names += ["innovation_clip", "variance_memory", "prediction_errors", "parameter_drift"]
            names += ["mean_cost_memory", "largest_step"]
        return dict.fromkeys(names, f"the rule {self.rule}")


class ValueRule(Algorithm):
    """Common part of online and batch Q-learning: prediction errors, a mean cost, coordinates."""

    KEPT: ClassVar[tuple[str, ...]] = ("_step", "_average_cost", "_errors")

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._model = OneStepModel(self.scenario)
        self._errors = PredictionErrors(self.scenario, self.configuration.prediction_errors)
        self._measure_in(np.ones(self.controller.theta.size))

    def _measure_in(self, scale: Vector) -> None:
        """Begin anew with this scale of each entry of θ in the steps' coordinates, (n_θ,)."""
        self._step = ConstrainedStep(self.controller, self.configuration, scale)
        discount, constants = self.configuration.criterion(self.scenario)
        position = self._step.blocks.slices["c_lambda"].start
        level, cost = float(scale[position]), self.scenario.controller.reference_cost
        memory = round(constants * self._model.slowest) if constants else 0
        self._average_cost = AverageCost(discount, position, level, cost, memory)

    def _begin(self, states: Matrix, errors: Matrix, noise: float) -> Parameters:
        """The prior's mean; its deviations become the coordinates.

        `states` and `errors` e (K, n) are those of the first samples, `noise` is the standard
        deviation of the TD errors, which c_lambda's level is not below.
        """
        settings, start = self.configuration, self.controller.parameters
        if settings.measure_offset:
            start = start.replace({"c_f": errors.mean(axis=0)})
        level, action = max(abs(float(start["c_lambda"])), noise), self.strategy.deviation
        s, e = states.std(axis=0), errors.std(axis=0)
        self._measure_in(prior_deviation(start, s, e, action, level, settings.prior_width))
        return start


class QLearning(ValueRule):
    """Online Q-learning by the configuration's rule.

    `td` and `fit` step on each sample's δ = ℓ + γV_θ(s₊) − Q_θ(s, a) (paper.tex, eq. Qlearning).

    `kalman` is an extended Kalman filter for Q with the target held and the next penalty in
    expectation: θ ~ N(θ₀, diag(σ²)) with the widths of `learning.step`. One TD error measures ∇Qᵀd
    with variance r (`KalmanRegression`):

        δ = ℓ + p(s) + γ[V_θ(s₊) − p(s₊) + mean_i p(f(s, a) + e_i)] − Q_θ(s, a)

    with f the controller's nominal model and e_i its latest prediction errors. Every `step_every`
    samples θ moves by d under its constraints, in the metric P⁻¹. The first `prior_samples` move
    only c_f, which becomes the mean of e (docs/method.md).
    """

    Configuration = QLearningConfiguration
    KEPT = (*ValueRule.KEPT, "_first", "_regression", "_count", "_squares")
    needs_action_value = True

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        settings = self.configuration
        if settings.rule != "kalman" and settings.scaled:
            self._measure_in(self.controller.parameters.blocks.scale)
        self._first: list[list[float]] = []  # rows (s, e, δ)
        self._regression = self._filter(1.0)
        self._count = 0
        self._squares = 0.0

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; every `step_every`-th moves θ, with `td` and `fit` each one does."""
        if self.configuration.rule != "kalman":
            return self._sample_step(transition)
        prediction = self._model(transition.s, transition.a)
        error = transition.next_s - prediction
        self._errors.add(error)
        expected = self._errors.expected_penalty(prediction)
        value = transition.next_policy.value - transition.next_penalty + expected
        solution = transition.action_value
        td_error = self._average_cost.target(transition.cost, value) - solution.value
        self._average_cost.follow(td_error)
        self._count += 1
        if (left := self.configuration.prior_samples - self._count) >= 0:
            self._first.append([*transition.s.tolist(), *error.tolist(), td_error])
            return None if left else self._begin_filter()
        gradient = self._average_cost.fitted(solution.value_gradient * self._step.scale)
        innovation = self._regression.update(td_error, gradient)
        self._squares += innovation * innovation
        every = self.configuration.step_every
        if self._count % every:
            return None
        error_size, self._squares = (self._squares / every) ** 0.5, 0.0
        fit = self._regression.take()
        return self._step.take(self._average_cost.take(fit), error_size)

    def _begin_filter(self) -> Update:
        """Take the noise, the widths and c_f from the first samples."""
        first, n = np.array(self._first), self._model.states
        self._first.clear()
        variance = float(np.mean(first[:, -1] ** 2))
        if not np.isfinite(variance):
            raise DivergenceError("TD errors are not finite")
        start = self._begin(first[:, :n], first[:, n:-1], variance**0.5)
        self._regression = self._filter(max(variance, np.finfo(np.float64).tiny))
        return self._step.move(start.theta, variance**0.5)

    def _filter(self, variance: float) -> KalmanRegression:
        settings, largest = self.configuration, self.configuration.largest_step or np.inf
        clip, memory = settings.innovation_clip, settings.variance_memory
        drift = settings.parameter_drift
        return KalmanRegression(self._step.scale.size, variance, clip, memory, drift, largest)

    def _sample_step(self, transition: Transition) -> Update:
        settings = self.configuration
        target = self._average_cost.target(transition.cost, transition.next_policy.value)
        td_error = target - transition.action_value.value
        gradient = transition.action_value.value_gradient * self._step.scale
        rule = td_fit if settings.rule == "fit" else td_step
        fit = self._average_cost.take(rule(td_error, gradient, settings.step_size))
        return self._step.take(fit, abs(td_error))


@dataclass
class KalmanRegression:
    """d ~ N(0, I) in scaled coordinates; each δ measures ∇Qᵀd with variance r.

        K = P∇Q/(r + ∇QᵀP∇Q),  d ← d + K·clip(δ − ∇Qᵀd),  P ← P − K∇QᵀP

    Without clip and with r constant this is the ridge regression min Σ(δ−∇Qᵀd)²/r + ‖d‖². The
    innovation is clipped at ±`clip`·√r; r follows its mean square with a memory of `memory`
    samples. `drift` is added to P's diagonal at each sample. A step has no entry beyond ±`largest`.
    """

    KEPT: ClassVar = ("mean", "covariance", "variance", "before")
    size: int
    variance: float
    clip: float
    memory: float
    drift: float = 0.0
    largest: float = np.inf

    def __post_init__(self) -> None:
        self.mean: Vector = np.zeros(self.size)
        self.covariance: Matrix = np.eye(self.size)
        self.before = self.covariance.copy()
        """P at the last step."""

    def update(self, td_error: float, gradient: Vector) -> float:
        """Take δ and ∇Q (n,), scaled; returns the innovation δ − ∇Qᵀd."""
        spread = self.covariance @ gradient
        scale = self.variance + float(gradient @ spread)
        innovation = td_error - float(gradient @ self.mean)
        limit = self.clip * self.variance**0.5
        gain = spread / scale
        self.mean += gain * min(max(innovation, -limit), limit)
        self.covariance -= gain[:, None] * spread
        if self.drift:
            self.covariance[np.diag_indices_from(self.covariance)] += self.drift
        square = min(innovation * innovation, OUTLIER * self.variance)
        self.variance += (square - self.variance) / self.memory
        return innovation

    def take(self) -> Fit:
        """The step d in the metric P⁻¹; d then starts from zero again.

        Of a step that is too long only a share is taken, and that share of P's decrease.
        """
        longest = float(np.abs(self.mean).max())
        if longest > self.largest:
            share = self.largest / longest
            self.mean *= share
            self.covariance = self.before + share * (self.covariance - self.before)
        self.before = self.covariance.copy()
        covariance = (self.covariance + self.covariance.T) / 2
        information: Matrix = np.linalg.inv(covariance).astype(np.float64)
        step, self.mean = self.mean, np.zeros_like(self.mean)
        return Fit(information @ step, step, lambda: information)


class AverageCost:
    """δ = ℓ + γV(s₊) − Q(s, a), and at γ = 1 δ = ℓ − g + V(s₊) − Q(s, a), with g learned.

    At γ = 1 the constant c_lambda cancels out of δ: its step goes to g, and c_lambda stays. With a
    `memory` g is no part of the fit, and each sample takes g ← g + δ/memory: differential
    Q-learning after Wan, Naik and Sutton (2021). `position` and `scale` are those of c_lambda in
    θ; `start` is the first guess of g.
    """

    KEPT = ("mean_cost", "_scale")

    def __init__(
        self, discount: float, position: int, scale: float, start: float, memory: int = 0
    ) -> None:
        self.discount = discount
        self.mean_cost = start if discount == 1.0 else 0.0
        self._position, self._scale = position, scale
        self._memory = memory if discount == 1.0 else 0

    def follow(self, td_error: float) -> None:
        """Move g by a sample's δ, where it is no part of the fit."""
        if self._memory:
            self.mean_cost += td_error / self._memory

    def fitted(self, gradient: Vector) -> Vector:
        """∇Q (n,) of the fitted entries: without c_lambda if g follows δ."""
        if not self._memory:
            return gradient
        kept = gradient.copy()
        kept[self._position] = 0.0
        return kept

    def target(self, cost: Values, next_value: Values) -> Values:
        """Target of Q(s, a), of one sample or of several, (K,)."""
        return cost - self.mean_cost + self.discount * next_value

    def take(self, fit: Fit) -> Fit:
        """Move g by its part of a fit's step; returns the rest, which is for θ."""
        if self.discount != 1.0:
            return fit
        minimiser = fit.minimiser.copy()
        self.mean_cost += float(minimiser[self._position]) * self._scale
        minimiser[self._position] = 0.0
        return replace(fit, gradient=fit.metric() @ minimiser, minimiser=minimiser)
