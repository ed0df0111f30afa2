"""Online Q-learning: θ steps as the transitions come, each with the present θ's Q and V."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from controllers.errors import QpError
from cosim.scenario import Scenario
from learning.average_cost import AverageCost
from learning.configuration import Configuration, Count, Positive
from learning.constrained_step import ConstrainedStep
from learning.exploration import Strategy
from learning.fit import Fit, least_squares, line_search, td_fit, td_step
from learning.globalised import GlobalisedLearning
from learning.kalman_q_learning import KalmanConfiguration, KalmanQLearning
from learning.protocols import LearnableController, Rule, Transition, Update

Vector = NDArray[np.float64]


AS_PRINTED: dict[str, Any] = {
    "rule": "fit",
    "step_size": 1e-3,
    "scaled": False,
    "exploration": "additive",
    "exploration_probability": 0.1,
    "exploration_deviation": [3.1622776601683795],
    "value_offset": "stage-cost",
    "parametrisation": "paper",
    "globalisation": "none",
}
"""Hyperparameters of the rule as the paper prints it (paper.tex, Simulations)."""
ONE_SAMPLE = {"td": td_step, "fit": td_fit}
"""The rules that step on one sample; `gauss-newton` steps on all that it remembers."""


class QLearningConfiguration(KalmanConfiguration):
    """Hyperparameters of online Q-learning; the defaults are the recommended variant.

    `AS_PRINTED` has those of the paper's rule.
    """

    OPTIONS: ClassVar[Mapping[tuple[str, ...], tuple[str, ...]]] = {
        ("td", "fit"): ("step_size", "line_search"),
        ("gauss-newton",): (
            "update_every", "gain", "gain_end", "memory", "ridge", "largest_step", "warm_up",
        ),
        ("kalman",): (
            "prior_width", "prior_samples", "measure_offset", "step_every", "innovation_clip",
            "variance_memory", "prediction_errors", "parameter_drift",
        ),
    }  # fmt: skip

    rule: Literal["kalman", "gauss-newton", "td", "fit"] = Field(
        "kalman",
        description="Kalman filter with a prior on θ; recursive Gauss–Newton with forgetting; "
        "αδ∇Q; or the fit's αδ∇Q/(1+α‖∇Q‖²)",
    )
    scaled: bool = Field(True, description="step in coordinates θ/scale, else in θ itself")
    step_size: Positive = Field(1e-3, description="rules td and fit: α")
    line_search: bool = Field(
        False, description="rules td and fit: shorten a step until its TD error does not rise"
    )
    update_every: Count = Field(20, description="gauss-newton: samples per step of θ")
    memory: Positive = Field(
        4000.0, description="gauss-newton: samples after which a sample's weight has fallen to 1/e"
    )
    largest_step: Positive = Field(
        1.0, description="gauss-newton: cap on each scaled entry of a step, before definiteness"
    )
    warm_up: int = Field(200, ge=0, description="gauss-newton: samples before the first step")

    @property
    def globalised(self) -> bool:
        """The Kalman form is validated unless it shall not be, the others only if they shall."""
        if self.globalisation is None:
            return self.rule == "kalman"
        return self.globalisation == "validated"


class QLearning(GlobalisedLearning):
    """Online Q-learning by the rule that the configuration names, globalised if it says so."""

    Configuration: ClassVar[type[Configuration]] = QLearningConfiguration

    def rule(self, samples: int, width: float) -> Rule:
        """The Kalman form, or the rules that step as transitions come."""
        settings: QLearningConfiguration = self._configuration
        arguments = (self._controller, self._scenario, settings, samples, self._strategy, self._rng)
        if settings.rule == "kalman":
            return KalmanQLearning(*arguments, width=width)
        return StepwiseQLearning(*arguments)


class StepwiseQLearning:
    """Q-learning on δ = ℓ + γV_θ(s₊) − Q_θ(s, a) (paper.tex, eq. Qlearning and q_solution).

    The rules `td` and `fit` step on each transition as it comes; `gauss-newton` keeps the
    information A = Σ λᵏ ∇Q∇Qᵀ and steps now and then by gain·(A+ρ)⁻¹ Σ δ∇Q, the sum since its last
    step.
    """

    def __init__(
        self,
        controller: LearnableController,
        scenario: Scenario,
        configuration: QLearningConfiguration,
        samples: int,
        strategy: Strategy,
        rng: np.random.Generator,
    ) -> None:
        self._controller, self._configuration = controller, configuration
        self._gain = configuration.gains(samples)
        self._step = ConstrainedStep(controller, configuration, scaled=configuration.scaled)
        self._average_cost = AverageCost.of(configuration.discount, scenario, self._step)
        size = self._step.scale.size
        self._information = np.zeros((size, size))
        self._gradient = np.zeros(size)
        self._squares, self._count = 0.0, 0
        self.needs_action_value = True
        self.needs_points = configuration.line_search

    def observe(self, transition: Transition) -> Update | None:
        """Take one sample; each moves θ, or one in `update_every` under gauss-newton."""
        target = self._average_cost.target(transition.cost, transition.next_policy.value)
        td_error = target - transition.action_value.value
        gradient = transition.action_value.value_gradient * self._step.scale
        settings = self._configuration
        if settings.rule == "gauss-newton":
            return self._recursive(transition.number, td_error, gradient)
        fit = ONE_SAMPLE[settings.rule](td_error, gradient, settings.step_size)
        if settings.line_search:
            fit = fit.shrunk(line_search(self._error_along(transition, target, fit)))
        return self._step.take(self._average_cost.take(fit), abs(td_error))

    def _recursive(self, number: int, td_error: float, gradient: Vector) -> Update | None:
        settings = self._configuration
        self._information *= 1.0 - 1.0 / settings.memory
        self._information += np.outer(gradient, gradient)
        self._gradient += td_error * gradient
        self._squares += td_error * td_error
        self._count += 1
        if (number + 1) % settings.update_every or number < settings.warm_up:
            return None
        fit = least_squares(self._information, self._gradient, settings.ridge)
        td_error = (self._squares / self._count) ** 0.5
        self._gradient[:] = 0.0
        self._squares, self._count = 0.0, 0
        fit = self._average_cost.take(fit.shrunk(self._gain(number)).clipped(settings.largest_step))
        return self._step.take(fit, td_error)

    def _error_along(
        self, transition: Transition, target: float, fit: Fit
    ) -> Callable[[float], float]:
        """TD error of a sample with the step scaled by t, its target and its QP's guess held."""
        controller, theta = self._controller, self._controller.theta
        point = transition.point
        assert point is not None

        def error(t: float) -> float:
            new, _ = self._step.proposal(fit.shrunk(t))
            try:
                controller.theta = new
                controller.prepare_at(point)
                return target - controller.feedback(transition.s, transition.a).value
            except QpError:
                return float("nan")
            finally:
                controller.theta = theta

        return error

    def state(self) -> dict[str, NDArray[Any]]:
        """Information matrix and the sums since the last step."""
        return {
            "information": self._information,
            "gradient": self._gradient,
            "sums": np.array([self._squares, self._count, self._average_cost.mean_cost]),
        }

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take back what `state` gave."""
        self._information, self._gradient = state["information"], state["gradient"]
        squares, count, self._average_cost.mean_cost = (float(value) for value in state["sums"])
        self._squares, self._count = squares, int(count)
